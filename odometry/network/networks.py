"""The networks by name."""

from torch import nn

from odometry.config import NetworkConfig
from odometry.network.correlation import CorrelationNetwork
from odometry.network.delora import DeloraNetwork


def make_network(config: NetworkConfig) -> nn.Module:
    """The configured network, a `PairNetwork`, with its first random weights."""
    return DeloraNetwork() if config.name == "delora" else CorrelationNetwork()
