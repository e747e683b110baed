"""Runs a network with torch, on any device."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from odometry.networks import PairNetwork
from odometry.runner import Floats, Guess


class TorchRunner:
    """A network in torch; implements `odometry.runner.NetworkRunner`.

    Args:
        network: trained, in evaluation mode, on the device.
        device: torch's name of it.
        threads: of torch; with mapping at work beside it, more would wait for one another.
        bfloat16: encode with half the digits.
    """

    def __init__(self, network: PairNetwork, device: str = "cpu", threads: int = 1, bfloat16: bool = False) -> None:
        self._network = network
        self._device = torch.device(device)
        self._threads = threads
        self._bfloat16 = bfloat16

    def encode(self, points: Floats, normals: Floats) -> Floats:
        """See `NetworkRunner`."""
        with torch.inference_mode(), _threads(self._threads):
            images = (torch.from_numpy(part).to(self._device) for part in (points, normals))
            with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bfloat16):
                features = self._network.encode(*images)
            return np.asarray(features.float().numpy(force=True), dtype=np.float32)

    def compare(self, previous: Floats, current: Floats) -> Guess:
        """See `NetworkRunner`."""
        with torch.inference_mode(), _threads(self._threads):
            estimate = self._network(*(torch.from_numpy(part).to(self._device) for part in (previous, current)))
            motion, sigma = estimate.T_prev_curr[0].double(), estimate.log_sigma[0].double().exp()
            return Guess(motion.numpy(force=True), sigma.numpy(force=True))


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """So many threads for torch."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
