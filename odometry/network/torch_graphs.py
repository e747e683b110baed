"""The networks in torch for inference, with one's own weights and on accelerators."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import nn

from lidarslam.odometry.images.projection import Floats
from lidarslam.odometry.network.candidates import CorrelationParts, CorrelationSearch, Graph, Search, WholePairs
from lidarslam.odometry.network.correlation import CorrelationNetwork
from lidarslam.odometry.network.pair_network import PairImages


def torch_search(network: nn.Module, device: torch.device | str = "cpu", threads: int = 1) -> Search:
    """The search for candidates with a network in evaluation mode, which is moved to the device.

    torch would use all threads and slow down what works beside it.
    """
    network = network.to(device)

    def graph(part: Callable[..., Any]) -> Graph:
        @torch.inference_mode()
        def run(*inputs: Floats) -> list[Floats]:
            before = torch.get_num_threads()
            torch.set_num_threads(threads)
            try:
                outputs = part(*(torch.from_numpy(values).to(device) for values in inputs))
            finally:
                torch.set_num_threads(before)
            outputs = outputs if isinstance(outputs, tuple) else (outputs,)
            return [np.ascontiguousarray(values.float().numpy(force=True)) for values in outputs]

        return run

    if isinstance(network, CorrelationNetwork):
        parts = (network.columns, network.turn_scores, network.bird, network.peaks)
        return CorrelationSearch(CorrelationParts(*(graph(part) for part in parts)))

    def pair(previous: torch.Tensor, current: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        estimate = network(PairImages(previous, current))
        return estimate.T_prev_curr, estimate.log_sigma

    return WholePairs(graph(pair))
