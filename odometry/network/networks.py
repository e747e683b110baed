"""Which networks there are."""

from typing import Protocol

import torch
from torch import Tensor, nn

from odometry.network.correlation import CorrelationNetwork, Estimate, PairImages
from odometry.network.delora import DeloraNetwork
from odometry.network.network_config import NetworkConfig

# The paper's network has no standard deviations: what is written for it, radians and metres.
_UNKNOWN_SIGMA = 0.1


class PairNetwork(Protocol):
    """A network that estimates how the sensor moved between two scans."""

    def __call__(self, pairs: PairImages) -> Estimate:
        """The motions of B pairs."""


class DeloraPairs(nn.Module):
    """DeLORA's network, shown points and ranges; it has no standard deviations."""

    def __init__(self) -> None:
        super().__init__()
        self.network = DeloraNetwork()

    def forward(self, pairs: PairImages) -> Estimate:
        """The motions, with constant standard deviations."""
        T_prev_curr: Tensor = self.network(_with_ranges(pairs.previous), _with_ranges(pairs.current))
        size = T_prev_curr.shape[0]
        unknown = T_prev_curr.new_full((size, 6), _UNKNOWN_SIGMA).log()
        return Estimate(T_prev_curr, unknown, unknown.new_zeros(size, 0), unknown.new_zeros(size, 0, 0))


def _with_ranges(images: Tensor) -> Tensor:
    """(B, 4, H, W) of points and normals (B, 6, H, W)."""
    points = images[:, :3]
    return torch.cat([points, points.square().sum(1, keepdim=True).sqrt()], dim=1)


def make_network(config: NetworkConfig) -> nn.Module:
    """The configured network, a `PairNetwork`, with its first random weights."""
    if config.name == "delora":
        return DeloraPairs()
    return CorrelationNetwork(config.correlation)
