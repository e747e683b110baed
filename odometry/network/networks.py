"""The networks by name."""

from torch import nn

from lidarslam.odometry.config import NetworkConfig
from lidarslam.odometry.network.correlation import CorrelationNetwork
from lidarslam.odometry.network.delora import DeloraNetwork


def make_network(config: NetworkConfig) -> nn.Module:
    """The configured network, a `PairNetwork`, with its first random weights."""
    return DeloraNetwork() if config.name == "delora" else CorrelationNetwork()
