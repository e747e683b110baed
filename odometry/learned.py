"""The learned odometry: a network's guess, laid on the previous scan by alignment, and how far to believe it.

Each scan is made into an image and encoded once. The network compares it with the one before; alignment refines its
guess, keeping it along directions of which the scans say nothing. A pair that lies badly on one another is tried from
the last motion as well, and reported as a failure when that does not help: what follows then goes on as it sees fit.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse, log, orthonormalize
from lidarslam.core.scan import Scan
from odometry.alignment import Aligned, SweepImages
from odometry.alignment_search import align_best
from odometry.image_config import ImageConfig
from odometry.interface import Motion
from odometry.learned_config import LearnedConfig
from odometry.networks import PairNetwork
from odometry.sweep_images import Imager, middle_offset_s

# No motion is better than this, whatever the residuals say: rotation in radians, translation in metres. What bends one
# sweep bends the next, and whoever fuses motions takes their errors as independent.
_LEAST_SIGMA = np.array([np.deg2rad(0.5)] * 3 + [0.03] * 3)
# Rings of points on the ground go along with the sensor and hold alignment back, by a part of the way.
_HELD_BACK = 0.2
# Part of a change of motion from one pair to the next that may hide within a sweep.
_HIDDEN_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class _Sweep:
    """A scan as the network and alignment know it; `middle` is the instant of the sweep's middle, seconds."""

    images: SweepImages
    features: Tensor
    stamp: float
    middle: float


class LearnedOdometry:
    """Motions between consecutive scans from a trained network.

    Args:
        network: trained, in evaluation mode.
        images: how its images are made.
        config: how its answers are refined and judged.
    """

    def __init__(self, network: PairNetwork, images: ImageConfig, config: LearnedConfig) -> None:
        self._network = network
        self._imager = Imager(images, config.device)
        self._config = config
        self._last: _Sweep | None = None
        self._velocity: FloatArray | None = None  # (6,) from the middle of the last sweep but one to that of the last
        self._T_middle_stamp = np.eye(4)  # of the last scan: from its stamp to the middle of its sweep

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the last scan that had points."""
        if not len(scan):
            return Motion(np.eye(4), 0, "the scan is empty")
        with torch.inference_mode(), _threads(self._config.threads):
            return self._estimate(self._sweep(scan))

    def close(self) -> None:
        """Nothing is held."""

    def _sweep(self, scan: Scan) -> _Sweep:
        images = self._imager.images([scan])
        with torch.autocast(images.points.device.type, torch.bfloat16, enabled=self._config.bfloat16):
            features = self._network.encode(images.points, images.normals)
        return _Sweep(images, features.float(), scan.stamp, scan.stamp + middle_offset_s(scan))

    def _estimate(self, sweep: _Sweep) -> Motion:
        last, self._last = self._last, sweep
        if last is None:
            return Motion(np.eye(4), int((sweep.images.normals != 0.0).any(1).sum()))
        interval_s = sweep.middle - last.middle
        if interval_s <= 0.0:
            return Motion(np.eye(4), 0, "the scan is not later than the one before")
        aligned, information = self._align(last, sweep, interval_s)
        T_prev_curr = orthonormalize(aligned.T_prev_curr[0].double().numpy(force=True))
        matched, explained = int(aligned.matched), float(aligned.explained)
        if explained < self._config.least_explained or matched < self._config.least_points:
            self._velocity, self._T_middle_stamp = None, np.eye(4)
            return Motion(np.eye(4), 0, f"the scan does not fit the last one: {_misfit(matched, explained)}")
        as_before = None if self._velocity is None else exp(self._velocity * interval_s)
        covariance = _covariance(T_prev_curr, information, as_before)
        motion = self._between_stamps(last, sweep, T_prev_curr)
        self._velocity = log(T_prev_curr) / interval_s
        return Motion(motion, matched, covariance=covariance)

    def _align(self, last: _Sweep, sweep: _Sweep, interval_s: float) -> tuple[Aligned, Tensor]:
        """From the network's guess, or going on as before, or further afield; and the information about it."""
        guess = self._network(last.features, sweep.features)
        information = torch.diag_embed((-2.0 * guess.log_sigma).exp()) / self._config.caution**2
        guesses = guess.T_prev_curr
        if self._velocity is not None:
            as_before = torch.from_numpy(exp(self._velocity * interval_s)).to(guesses)
            guesses = torch.cat([guesses, as_before[None]])
        config = self._config.alignment
        interval = guesses.new_tensor([interval_s])
        aligned, is_guessed = align_best(guesses, sweep.images, last.images, interval, config, information)
        seen = aligned.information * (config.independent_share / config.residual_m**2)
        return aligned, (seen + information if is_guessed else seen)[0]

    def _between_stamps(self, last: _Sweep, sweep: _Sweep, T_prev_curr: FloatArray) -> FloatArray:
        """The motion between the scans' stamps, from that between the middles of their sweeps.

        What two scans show of a motion belongs to the middles of their sweeps. Poses are interpolated between those
        at the stamps, so that stamps at the start of sweeps do not make the odometry run half a sweep ahead.
        """
        twist = log(T_prev_curr) / (sweep.middle - last.middle)
        if self._velocity is None:  # nothing is known of the motion before
            self._T_middle_stamp = exp(twist * (last.stamp - last.middle))
        T_middle_stamp = self._T_middle_stamp
        # The stamp mostly lies between the two middles, on the way from one to the other.
        T_last_middle_stamp = exp(twist * (sweep.stamp - last.middle))
        self._T_middle_stamp = inverse(T_prev_curr) @ T_last_middle_stamp
        return np.asarray(inverse(T_middle_stamp) @ T_last_middle_stamp, dtype=np.float64)


def _misfit(matched: int, explained: float) -> str:
    return f"{matched} points do, which is {100.0 * explained:.0f} % of what it says of one direction"


def _covariance(T_prev_curr: FloatArray, information: Tensor, as_before: FloatArray | None) -> FloatArray:
    """(6, 6) of the error `xi` in T_true = T_prev_curr @ exp(xi), rotation first.

    The information is that of a change from the left. To its inverse comes what a change of motion may hide within
    a sweep, which alignment takes as even.
    """
    left = np.linalg.inv(information.double().numpy(force=True) + 1e-6 * np.eye(6))
    A = adjoint(inverse(T_prev_curr))
    covariance = A @ left @ A.T + np.diag(_LEAST_SIGMA**2)
    covariance[3:, 3:] += np.eye(3) * (_HELD_BACK * np.linalg.norm(T_prev_curr[:3, 3])) ** 2
    if as_before is not None:
        covariance += np.diag((_HIDDEN_SHARE * log(inverse(as_before) @ T_prev_curr)) ** 2)
    return np.asarray(covariance, dtype=np.float64)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """So many threads for torch: with mapping at work beside it, more would wait for one another."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
