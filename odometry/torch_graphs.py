"""The networks in torch behind the interfaces of inference, for weights of one's own and for accelerators."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from odometry.candidates import Candidate, CorrelationSearch, Described, Search
from odometry.correlation import CorrelationNetwork, PairImages

Floats = NDArray[np.float32]


class TorchGraphs:
    """The parts of the network `correlation`; implements `odometry.candidates.Graphs`.

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


class WholePairs:
    """A network that sees nothing but pairs, with its one motion as the only candidate; implements `Search`."""

    def __init__(self, network: nn.Module, device: torch.device | str = "cpu", threads: int = 1) -> None:
        self._network = network.to(device)
        self._device = device
        self._threads = threads

    def describe(self, points: Floats, normals: Floats, heading: float = 0.0) -> Described:
        """The image itself."""
        return Described(np.concatenate([points, normals])[None], np.zeros((0, 0, 0), dtype=np.complex64), heading)

    @torch.inference_mode()
    def compare(self, previous: Described, points: Floats, normals: Floats) -> tuple[tuple[Candidate, ...], Described]:
        """See `Search`."""
        current = self.describe(points, normals)
        images = (torch.from_numpy(scan.columns).to(self._device) for scan in (previous, current))
        with using_threads(self._threads):
            estimate = self._network(PairImages(*images))
        T_prev_curr = estimate.T_prev_curr[0].double().numpy(force=True)
        variances = (2.0 * estimate.log_sigma[0].double()).exp().numpy(force=True)
        return (Candidate(T_prev_curr, np.diag(variances), 0.0),), current


def torch_search(network: nn.Module, device: torch.device | str = "cpu", threads: int = 1) -> Search:
    """The search for candidates that a network in evaluation mode is made for."""
    if isinstance(network, CorrelationNetwork):
        return CorrelationSearch(TorchGraphs(network, device, threads))
    return WholePairs(network, device, threads)


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
