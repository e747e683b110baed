"""The networks in torch behind the interfaces of inference, for weights of one's own and for accelerators."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from odometry.network.candidates import CorrelationSearch, Search, WholePairs
from odometry.network.correlation import CorrelationNetwork, PairImages

Floats = NDArray[np.float32]


class TorchGraphs:
    """The parts of the network `correlation`; implements `odometry.network.candidates.Graphs`.

    Args:
        network: in evaluation mode; it is moved to the device.
        device: torch's name of it.
        threads: of torch, which would use all and slow down what works beside it.
    """

    def __init__(self, network: CorrelationNetwork, device: torch.device | str = "cpu", threads: int = 1) -> None:
        self._network = network.to(device)
        self._device = device
        self._threads = threads

    def columns(self, points: Floats, normals: Floats) -> Floats:
        """See `Graphs`."""
        return _array(self._run(self._network.columns, points, normals))

    def turn_scores(self, previous: Floats, current: Floats) -> Floats:
        """See `Graphs`."""
        return _array(self._run(self._network.turn_scores, previous, current))

    def bird(self, grid: Floats) -> Floats:
        """See `Graphs`."""
        return _array(self._run(self._network.bird, grid))

    def peaks(self, turn_scores: Floats, shift_scores: Floats) -> tuple[float, Floats, Floats]:
        """See `Graphs`."""
        angle, shift, log_sigma = self._run(self._network.peaks, turn_scores, shift_scores)
        return float(angle), _array(shift)[0], _array(log_sigma)[0]

    @torch.inference_mode()
    def _run(self, part: nn.Module | Callable[..., Tensor], *inputs: Floats) -> Tensor:
        with using_threads(self._threads):
            result: Tensor = part(*(torch.from_numpy(values).to(self._device) for values in inputs))
        return result


def torch_search(network: nn.Module, device: torch.device | str = "cpu", threads: int = 1) -> Search:
    """The search for candidates that a network in evaluation mode is made for."""
    if isinstance(network, CorrelationNetwork):
        return CorrelationSearch(TorchGraphs(network, device, threads))
    moved = network.to(device)

    @torch.inference_mode()
    def pairs(previous: Floats, current: Floats) -> tuple[Floats, Floats]:
        with using_threads(threads):
            estimate = moved(PairImages(*(torch.from_numpy(images).to(device) for images in (previous, current))))
        return _array(estimate.T_prev_curr), _array(estimate.log_sigma)

    return WholePairs(pairs)


@contextmanager
def using_threads(count: int) -> Iterator[None]:
    """So many threads for torch."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _array(values: Tensor) -> Floats:
    return np.ascontiguousarray(values.float().numpy(force=True))
