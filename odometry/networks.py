"""Which networks there are; all of them look at scans one by one first, and then at pairs."""

from typing import Protocol

import torch
from torch import Tensor, nn

from odometry.correlation import CorrelationNetwork, Estimate
from odometry.delora import DeloraNetwork
from odometry.network_config import NetworkConfig

# The paper's network says nothing of its confidence: what is written for it, radians and metres.
_UNKNOWN_SIGMA = 0.1


class PairNetwork(Protocol):
    """A network that says how the sensor moved between two scans."""

    def encode(self, points: Tensor, normals: Tensor) -> Tensor:
        """What is kept of scans (B, 3, H, W) twice, for all pairs they are part of."""

    def __call__(self, previous: Tensor, current: Tensor) -> Estimate:
        """The motion between scans of which `encode` gave these."""


class DeloraPairs(nn.Module):
    """DeLORA's network, which has nothing to say of a single scan."""

    def __init__(self) -> None:
        super().__init__()
        self.network = DeloraNetwork()

    def encode(self, points: Tensor, normals: Tensor) -> Tensor:  # noqa: ARG002
        """The image itself, with its ranges (B, 4, H, W)."""
        return torch.cat([points, points.square().sum(1, keepdim=True).sqrt()], dim=1)

    def forward(self, previous: Tensor, current: Tensor) -> Estimate:
        """The motion, with a confidence that is a guess."""
        T_prev_curr: Tensor = self.network(previous, current)
        unknown = torch.full((previous.shape[0], 6), _UNKNOWN_SIGMA, device=previous.device).log()
        return Estimate(T_prev_curr, unknown, previous.new_zeros(previous.shape[0], 0))


def make_network(config: NetworkConfig) -> nn.Module:
    """The configured network, a `PairNetwork`, with its first random weights."""
    if config.name == "delora":
        return DeloraPairs()
    return CorrelationNetwork(config.correlation)
