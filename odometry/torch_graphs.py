"""The networks in torch behind the interfaces of inference, for weights of one's own and for accelerators."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from odometry.correlation import CorrelationNetwork, PairImages
from odometry.hypotheses import CorrelationSearch, Described, Hypothesis, Search

Floats = NDArray[np.float32]


class TorchGraphs:
    """The parts of the network `correlation`; implements `odometry.hypotheses.Graphs`.

    Args:
        network: in evaluation mode; it is moved to the device.
        device: torch's name of it.
    """

    def __init__(self, network: CorrelationNetwork, device: torch.device | str = "cpu") -> None:
        self._network = network.to(device)
        self._device = device

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
        result: Tensor = part(*(torch.from_numpy(values).to(self._device) for values in inputs))
        return result


class WholePairs:
    """A network that sees nothing but pairs, with its one motion as the only hypothesis; implements `Search`."""

    def __init__(self, network: nn.Module, device: torch.device | str = "cpu") -> None:
        self._network = network.to(device)
        self._device = device

    def describe(self, points: Floats, normals: Floats, heading: float = 0.0) -> Described:
        """The image itself."""
        return Described(np.concatenate([points, normals])[None], np.zeros((0, 0, 0), dtype=np.complex64), heading)

    @torch.inference_mode()
    def compare(self, previous: Described, points: Floats, normals: Floats) -> tuple[tuple[Hypothesis, ...], Described]:
        """See `Search`."""
        current = self.describe(points, normals)
        images = (torch.from_numpy(scan.columns).to(self._device) for scan in (previous, current))
        estimate = self._network(PairImages(*images))
        T_prev_curr = estimate.T_prev_curr[0].double().numpy(force=True)
        variances = (2.0 * estimate.log_sigma[0].double()).exp().numpy(force=True)
        return (Hypothesis(T_prev_curr, np.diag(variances), 0.0),), current


def torch_search(network: nn.Module, device: torch.device | str = "cpu") -> Search:
    """The search for hypotheses that a network in evaluation mode is made for."""
    if isinstance(network, CorrelationNetwork):
        return CorrelationSearch(TorchGraphs(network, device))
    return WholePairs(network, device)


def _array(values: Tensor) -> Floats:
    return np.ascontiguousarray(values.float().numpy(force=True))
