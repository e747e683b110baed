"""The learned odometry: a network's guess, laid on the previous scan by alignment, and how far to believe it.

Each scan is made into an image and encoded once. The network compares it with the one before; alignment refines its
guess. Along directions of which the scans say nothing the motion goes on as before, less and less surely; the guess
counts there only as long as nothing is known of the motion before. A pair that lies badly on one another is tried from
the last motion as well, and reported as a failure when that does not help: what follows then goes on as it sees fit.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidarslam.core.degeneracy import Degeneracy
from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse, orthonormalize
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from odometry.alignment import Aligned, align
from odometry.alignment_search import align_best
from odometry.correlation import Estimate
from odometry.degeneracy import Expected, gone_on, holding, joined_information, left_open
from odometry.image_config import ImageConfig
from odometry.interface import Motion
from odometry.learned_config import LearnedConfig
from odometry.networks import PairNetwork
from odometry.retiming import Retimer
from odometry.sweep_images import Imager, middle_offset_s
from odometry.sweeps import LastMotion, SweepImages, SweepPairs

# Where neither the images nor the network say anything a matrix still has an inverse.
_LEAST_INFORMATION = 1e-6
# What comes on top of what the residuals say, radians and metres, so that about 90, 98 and 99.5 % of errors lie within
# one, two and three standard deviations: they have longer tails than a normal distribution's.
_LEAST_SIGMA = np.array([np.deg2rad(0.05)] * 3 + [0.003] * 3)
# Rings of points on the ground go along with the sensor and hold alignment back, by a part of the way.
_HELD_BACK = 0.02
# Part of the change of motion within a pair of sweeps that may not be even.
_HIDDEN_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class _Laid:
    """How a scan lies on the one before.

    Attributes:
        aligned: where.
        information: (6, 6) about the motion, for a change from the left.
        degeneracy: the directions that the two scans leave open.
    """

    aligned: Aligned
    information: FloatArray
    degeneracy: Degeneracy


@dataclass(frozen=True, eq=False)
class _Sweep:
    """A scan as the network and alignment know it; `middle` is the instant of the sweep's middle, seconds."""

    images: SweepImages
    features: Tensor
    stamp: float
    middle: float

    def state(self) -> State:
        """All of it."""
        tensors = {**vars(self.images), "features": self.features}
        arrays = {name: tensor.numpy(force=True) for name, tensor in tensors.items()}
        return {**arrays, "stamp": self.stamp, "middle": self.middle}

    @classmethod
    def restored(cls, saved: Saved, device: str) -> "_Sweep":
        """The sweep with a state."""

        def tensor(name: str, *shape: int | None) -> Tensor:
            return torch.from_numpy(saved.array(name, shape, np.float32)).to(device)

        points = tensor("points", 1, 3, None, None)
        height, width = points.shape[2:]
        offsets, normals = tensor("offsets", 1, height, width), tensor("normals", 1, 3, height, width)
        images = SweepImages(points, normals, offsets, tensor("low", 1), tensor("high", 1))
        features = tensor("features", 1, None, None, None)
        return cls(images, features, saved.number("stamp"), saved.number("middle"))


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
        self._way = Retimer()
        self._last_covariance: FloatArray | None = None  # (6, 6) of the motion before, for a change from the left

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the last scan that had points."""
        if not len(scan):
            return Motion(np.eye(4), 0, "the scan is empty")
        with torch.inference_mode(), _threads(self._config.threads):
            return self._estimate(self._sweep(scan))

    def state(self) -> State:
        """The last sweep, the rows of images, and the motion up to there with its covariance."""
        last = None if self._last is None else self._last.state()
        return {
            "last": last,
            "imager": self._imager.state(),
            "way": self._way.state(),
            "covariance": self._last_covariance,
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first scan."""
        self._last = saved.optional("last", lambda last: _Sweep.restored(last, self._config.device))
        self._imager.restore(saved.part("imager"))
        self._way.restore(saved.part("way"))
        self._last_covariance = saved.optional_array("covariance", (6, 6))

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
        guess = self._network(last.features, sweep.features)
        if not _is_finite(guess):
            self._forget()
            return Motion(np.eye(4), 0, "the network's answer is not a motion; try other weights")
        laid = self._align(guess, last, sweep, interval_s)
        aligned = laid.aligned
        T_prev_curr = orthonormalize(_array(aligned.T_prev_curr[0]))
        matched, explained = int(aligned.matched), float(aligned.explained)
        if explained < self._config.least_explained or matched < self._config.least_points:
            self._forget()
            return Motion(np.eye(4), 0, f"the scan does not fit the last one: {_misfit(matched, explained)}")
        bend = _array(aligned.bend[0])
        left = np.asarray(np.linalg.inv(laid.information + _LEAST_INFORMATION * np.eye(6)), dtype=np.float64)
        self._last_covariance, covariance = left, _covariance(T_prev_curr, left, bend * interval_s)
        stamps = (last.stamp, sweep.stamp)
        motion = self._way.between_stamps(T_prev_curr, bend, (last.middle, sweep.middle), stamps)
        return Motion(motion, matched, covariance=covariance, degenerate=laid.degeneracy.names)

    def _align(self, guess: Estimate, last: _Sweep, sweep: _Sweep, interval_s: float) -> _Laid:
        """From the network's guess, or going on as before, or further afield."""
        caution = guess.log_sigma.new_tensor([self._config.turn_caution] * 3 + [self._config.caution] * 3)
        information = torch.diag_embed((caution * guess.log_sigma.exp()) ** -2)
        guesses = guess.T_prev_curr
        expected = self._expected(interval_s)
        interval, before = guesses.new_tensor([interval_s]), None
        if self._way.last is not None and expected is not None:
            velocity = torch.from_numpy(self._way.last.velocity).to(guesses)[None]
            before = LastMotion(velocity, guesses.new_tensor([self._way.last.interval_s]))
            guesses = torch.cat([guesses, torch.from_numpy(expected.T_prev_curr).to(guesses)[None]])
        sweeps = SweepPairs(sweep.images, last.images, interval, before)
        aligned, is_guessed = align_best(guesses, sweeps, self._config.alignment, information)
        degeneracy = left_open(_array(aligned.information[0]), int(aligned.matched), sweep.images)
        if len(degeneracy) and expected is not None:
            return self._go_on(aligned, degeneracy, expected, sweeps)
        seen = self._seen(aligned)
        return _Laid(aligned, seen + _array(information[0]) if is_guessed else seen, degeneracy)

    def _go_on(self, aligned: Aligned, degeneracy: Degeneracy, expected: Expected, sweeps: SweepPairs) -> _Laid:
        """As expected along the open directions, and as aligned across them."""
        like = aligned.T_prev_curr
        motion = gone_on(_array(like[0]), expected.T_prev_curr, degeneracy)
        held = torch.from_numpy(holding(degeneracy))[None]
        aligned = align(torch.from_numpy(motion).to(like)[None], sweeps, self._config.alignment, held, held)
        return _Laid(aligned, joined_information(self._seen(aligned), expected.covariance, degeneracy), degeneracy)

    def _seen(self, aligned: Aligned) -> FloatArray:
        return _array(aligned.information[0]) * self._config.alignment.information_per_m2

    def _expected(self, interval_s: float) -> Expected | None:
        """The motion that goes on as before; None where nothing is known of that."""
        last = self._way.last
        if last is None or self._last_covariance is None:
            return None
        changes = [self._config.changing_rad_s2] * 3 + [self._config.changing_m_s2] * 3
        new = np.diag((np.array(changes) * interval_s**2) ** 2)
        scale = (interval_s / last.interval_s) ** 2
        return Expected(exp(last.velocity * interval_s), scale * self._last_covariance + new)

    def _forget(self) -> None:
        """The way on is not known."""
        self._way.forget()
        self._last_covariance = None


def _array(values: Tensor) -> FloatArray:
    return values.double().numpy(force=True)


def _is_finite(guess: Estimate) -> bool:
    """Whether a motion follows from the guess; weights can be finite, and what they make of a scan is not."""
    information = (-2.0 * guess.log_sigma).exp()
    return bool(guess.T_prev_curr.isfinite().all() and information.isfinite().all() and (information > 0.0).all())


def _misfit(matched: int, explained: float) -> str:
    return f"{matched} points do, which is {100.0 * explained:.0f} % of what it says of one direction"


def _covariance(T_prev_curr: FloatArray, left: FloatArray, bent: FloatArray) -> FloatArray:
    """(6, 6) of the error `xi` in T_true = T_prev_curr @ exp(xi), rotation first.

    `left` is that of a change from the left. To it comes a part of the change of motion (6,) within a pair of sweeps,
    which is taken as even.
    """
    A = adjoint(inverse(T_prev_curr))
    covariance = A @ left @ A.T + np.diag(_LEAST_SIGMA**2)
    covariance[3:, 3:] += np.eye(3) * (_HELD_BACK * np.linalg.norm(T_prev_curr[:3, 3])) ** 2
    return np.asarray(covariance + np.diag((_HIDDEN_SHARE * bent) ** 2), dtype=np.float64)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """So many threads for torch: with mapping at work beside it, more would wait for one another."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
