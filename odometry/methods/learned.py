"""The learned odometry: the network's candidates, the best of them refined by alignment, with a covariance.

Each scan is made into an image and encoded once. The network compares it with the one before; alignment chooses among
its candidates and refines one. Along directions that the scans do not constrain the motion goes on as before, with a
growing covariance; the candidate counts there only as long as no motion before is known. A pair of scans of which too
little fits is tried from the last motion as well, and reported as a failure when that does not help.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarslam.core.degeneracy import Degeneracy
from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse, orthonormalize
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from odometry.alignment.alignment import Aligned, Guess, align
from odometry.alignment.degeneracy import Expected, gone_on, holding, joined_information, left_open
from odometry.alignment.search import align_best
from odometry.images.image_config import ImageConfig
from odometry.images.stamp_interpolation import Retimer
from odometry.images.sweep_images import Imager, ScanImages, middle_offset_s
from odometry.images.sweeps import LastMotion, SweepImages, SweepPair
from odometry.interface import Motion
from odometry.methods.learned_config import LearnedConfig
from odometry.network.candidates import Candidate, Described, Search

# Where neither the images nor the network say anything a matrix still has an inverse.
_LEAST_INFORMATION = 1e-6
# What comes on top of the covariance by the residuals, radians and metres, and as a part of the way, by which rings of
# points on the ground, which go along with the sensor, bias alignment. Chosen on the drive with an independent truth,
# KITTI odometry's 04: 74, 96 and 98 % of its errors lie within one, two and three standard deviations.
_LEAST_SIGMA = np.array([np.deg2rad(0.02)] * 3 + [0.002] * 3)
_HELD_BACK = 0.004
# How much less likely than the network's best candidate it is that the motion goes on, in standard deviations.
_ODDS_OF_GOING_ON = 1.0
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

    images: ScanImages
    described: Described
    stamp: float
    middle: float

    def state(self) -> State:
        """All but what follows from it."""
        images = {"network": dict(vars(self.images.network)), "alignment": dict(vars(self.images.alignment))}
        return {**images, "heading": self.described.heading, "stamp": self.stamp, "middle": self.middle}

    @classmethod
    def restored(cls, saved: Saved, search: Search) -> "_Sweep":
        """The sweep with a state."""
        images = ScanImages(_images(saved.part("network")), _images(saved.part("alignment")))
        shown = images.network
        described = search.describe(shown.points, shown.normals, saved.number("heading"))
        return cls(images, described, saved.number("stamp"), saved.number("middle"))


def _images(saved: Saved) -> SweepImages:
    points = saved.array("points", (3, None, None), np.float32)
    offsets = saved.array("offsets", points.shape[1:], np.float32)
    normals = saved.array("normals", points.shape, np.float32)
    return SweepImages(points, normals, offsets, saved.number("low"), saved.number("high"))


class LearnedOdometry:
    """Motions between consecutive scans from a trained network.

    Args:
        search: finds candidates with the trained network.
        images: how its images are made.
        config: how its answers are refined and judged.
    """

    def __init__(self, search: Search, images: ImageConfig, config: LearnedConfig) -> None:
        self._search = search
        self._imager = Imager(images, config.alignment_rows)
        self._config = config
        self._last: _Sweep | None = None
        self._way = Retimer()
        self._last_covariance: FloatArray | None = None  # (6, 6) of the motion before, for a change from the left

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the last scan that had points."""
        if not len(scan):
            return Motion(np.eye(4), 0, "the scan is empty")
        return self._estimate(scan)

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
        self._last = saved.optional("last", lambda last: _Sweep.restored(last, self._search))
        self._imager.restore(saved.part("imager"))
        self._way.restore(saved.part("way"))
        self._last_covariance = saved.optional_array("covariance", (6, 6))

    def close(self) -> None:
        """Nothing is held."""

    def _estimate(self, scan: Scan) -> Motion:
        images, middle, last = self._imager.images(scan), scan.stamp + middle_offset_s(scan), self._last
        shown = images.network
        interval_s = 0.0 if last is None else middle - last.middle
        if last is None or interval_s <= 0.0:
            self._last = _Sweep(images, self._search.describe(shown.points, shown.normals), scan.stamp, middle)
            if last is None:
                return Motion(np.eye(4), int((images.alignment.normals != 0.0).any(axis=0).sum()))
            return Motion(np.eye(4), 0, "the scan is not later than the one before")
        candidates, described = self._search.compare(last.described, shown.points, shown.normals)
        self._last = sweep = _Sweep(images, described, scan.stamp, middle)
        if not all(candidate.is_motion() for candidate in candidates):
            self._forget()
            return Motion(np.eye(4), 0, "the network's answer is not a motion; try other weights")
        laid = self._align(candidates, last, sweep, interval_s)
        T_prev_curr = orthonormalize(laid.aligned.T_prev_curr)
        matched, explained, bend = laid.aligned.matched, laid.aligned.explained, laid.aligned.bend
        if explained < self._config.least_explained or matched < self._config.least_points:
            self._forget()
            return Motion(np.eye(4), 0, f"the scan does not fit the last one: {_misfit(matched, explained)}")
        left = np.asarray(np.linalg.inv(laid.information + _LEAST_INFORMATION * np.eye(6)), dtype=np.float64)
        self._last_covariance, covariance = left, _covariance(T_prev_curr, left, bend * interval_s)
        stamps = (last.stamp, sweep.stamp)
        motion = self._way.between_stamps(T_prev_curr, bend, (last.middle, sweep.middle), stamps)
        return Motion(motion, matched, covariance=covariance, degenerate=laid.degeneracy.names)

    def _align(self, candidates: Sequence[Candidate], last: _Sweep, sweep: _Sweep, interval_s: float) -> _Laid:
        """From the network's candidates, or going on as before, or further afield."""
        guesses = []
        for candidate in candidates:
            information = np.asarray(np.linalg.inv(candidate.covariance), dtype=np.float64)
            guesses.append(Guess(candidate.T_prev_curr, information, odds=_odds(candidate, candidates[0])))
        expected, leg, before = self._expected(interval_s), self._way.last, None
        if leg is not None and expected is not None:
            before = LastMotion(leg.velocity, leg.interval_s)
            guesses.append(Guess(expected.T_prev_curr, odds=_ODDS_OF_GOING_ON))
        sweeps = SweepPair(sweep.images.alignment, last.images.alignment, interval_s, before)
        aligned = align_best(guesses, sweeps, self._config.alignment)
        degeneracy = left_open(aligned.information, aligned.matched, sweep.images.alignment)
        if len(degeneracy) and expected is not None:
            return self._go_on(aligned, degeneracy, expected, sweeps)
        return _Laid(aligned, self._seen(aligned) + aligned.guess_information, degeneracy)

    def _go_on(self, aligned: Aligned, degeneracy: Degeneracy, expected: Expected, sweeps: SweepPair) -> _Laid:
        """As expected along the open directions, and as aligned across them."""
        motion = gone_on(aligned.T_prev_curr, expected.T_prev_curr, degeneracy)
        held = holding(degeneracy)
        aligned = align(Guess(motion, held, held), sweeps, self._config.alignment)
        return _Laid(aligned, joined_information(self._seen(aligned), expected.covariance, degeneracy), degeneracy)

    def _seen(self, aligned: Aligned) -> FloatArray:
        return aligned.information * self._config.alignment.information_per_m2

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


def _odds(candidate: Candidate, best: Candidate) -> float:
    """How much less likely a candidate is than the best one, as the number of standard deviations of a normal one."""
    return float(np.sqrt(max(0.0, 2.0 * (best.log_probability - candidate.log_probability))))


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
