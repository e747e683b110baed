"""The learned odometry: the network's candidates, the best of them refined by alignment, with a covariance.

Each scan becomes an image and is encoded once. The network compares it with the one before; alignment chooses among its
candidates and refines one. Along degenerate directions the motion continues as before, with a growing covariance; the
candidate counts there only as long as no motion before is known. A pair of scans that fits too badly is a failure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.state import Shape
from lidarslam.odometry.alignment.alignment import (
    DOUBTFUL,
    INFORMATION_PER_M2,
    Alignment,
    InitialEstimate,
    align,
    align_best,
    find_degeneracy,
    joined_information,
    replaced_along,
)
from lidarslam.odometry.alignment.sweep_motion import StampInterpolator, SweepMotion, SweepPair
from lidarslam.odometry.config import ImageConfig
from lidarslam.odometry.images.sweep_images import Imager, ScanImages
from lidarslam.odometry.interface import Motion, StatefulOdometry
from lidarslam.odometry.network.candidates import Candidate, Described, Search

# Below this the scan does not fit the last one: see `Alignment.explained`, and inliers.
_LEAST_EXPLAINED, _LEAST_INLIERS = 0.3, 60
# Where neither the images nor the network constrain the motion its information still has an inverse.
_LEAST_INFORMATION = 1e-6
# Added to the covariance by the residuals: radians and metres; and a part of the translation, by which rings of points
# on the ground, which move with the sensor, bias alignment. Chosen on the drive with an independent truth,
# KITTI odometry's 04: 74, 96 and 98 % of its errors lie within one, two and three standard deviations.
_LEAST_SIGMA = np.array([np.deg2rad(0.02)] * 3 + [0.002] * 3)
_HELD_BACK = 0.004
# Part of the change of velocity within a pair of sweeps that may not be uniform.
_UNEVEN_SHARE = 0.05
# By how many standard deviations a continued motion is less likely than the network's best candidate.
_SIGMAS_OF_GOING_ON = 1.0
# Standard deviation of accelerations, m/s^2, and by how many of them a candidate is less likely at most: where a scene
# repeats itself, as a row of houses does, motions continue; where only the candidate fits, the motion before was wrong.
_ACCELERATING_M_S2, _MOST_SIGMAS = 4.0, 6.0
# Acceleration along degenerate directions, standard deviation: rad/s^2 and m/s^2.
_ACCELERATION = np.array([2.0] * 3 + [2.0] * 3)
# Information, of radians or metres, that keeps a motion where it is.
_HELD = 1e8


@dataclass(frozen=True, eq=False)
class _Sweep:
    """A scan as input of the network and of alignment; `middle` is the instant of the sweep's middle, seconds."""

    images: ScanImages
    heading: float
    stamp: float
    middle: float


class LearnedOdometry(StatefulOdometry):
    """Motions between consecutive scans by the candidates of a trained network, whose images have the size `images`.

    Not aligned, the first candidate is the motion as it is.
    """

    _last: _Sweep | None
    _imager: Imager
    _interpolator: StampInterpolator
    _last_covariance: Annotated[FloatArray, Shape(6, 6)] | None  # of the motion before, for a change from the left
    _skipped: Scan | None  # the scan before, if its motion was not asked for

    def __init__(self, search: Search, images: ImageConfig, is_aligned: bool = True) -> None:
        self._search = search
        self._imager = Imager(images)
        self._is_aligned = is_aligned
        self._last = None
        self._described: Described | None = None  # the last sweep
        self._interpolator = StampInterpolator()
        self._last_covariance = None
        self._skipped = None
        self._expected: FloatArray | None = None  # velocity (6,) before the first motion, in the LiDAR's axes

    def _after_restore(self) -> None:
        self._expected = None
        if self._last is not None:
            shown = self._last.images.network
            self._described = self._search.describe(shown.points, shown.normals, self._last.heading)

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the last scan that had points."""
        if not len(scan):
            return Motion(np.eye(4), 0, "the scan is empty")
        if self._skipped is not None:
            self._forget()
            self._begin(self._skipped, self._imager.images(self._skipped))
            self._skipped = None
        images = self._imager.images(scan)
        motion = self._estimate(scan, images)
        has_own_axes = np.array_equal(images.R_image_lidar, np.eye(3))
        return motion if has_own_axes else motion.in_axes(images.R_image_lidar.T)

    def expect(self, velocity: FloatArray) -> None:
        """Take a velocity before the first scan; see `ExpectingOdometry`."""
        self._expected = velocity

    def skip(self, scan: Scan) -> None:
        """Take a scan with points whose motion is not asked for; see `SkippingOdometry`."""
        self._skipped = scan

    def _begin(self, scan: Scan, images: ScanImages) -> None:
        """The next motion is relative to this scan, whose own is not estimated."""
        self._described = self._search.describe(images.network.points, images.network.normals)
        self._last = _Sweep(images, self._described.heading, scan.stamp, scan.stamp + scan.middle_offset_s)

    def _estimate(self, scan: Scan, images: ScanImages) -> Motion:
        """The motion in the images' axes."""
        middle, last = scan.stamp + scan.middle_offset_s, self._last
        if last is not None and not np.array_equal(last.images.R_image_lidar, images.R_image_lidar):
            self._forget()
            self._begin(scan, images)
            return Motion(np.eye(4), 0, "the axes of the images changed, as the scan before had few points")
        if last is None or self._described is None:
            self._begin(scan, images)
            return Motion(np.eye(4), images.alignment.with_normal())
        if middle <= last.middle:
            self._begin(scan, images)
            return Motion(np.eye(4), 0, "the scan is not later than the one before")
        shown = images.network
        candidates, self._described = self._search.compare(self._described, shown.points, shown.normals)
        self._last = sweep = _Sweep(images, self._described.heading, scan.stamp, middle)
        if not all(candidate.is_motion() for candidate in candidates):
            self._forget()
            return Motion(np.eye(4), 0, "the network's answer is not a motion; try other weights")
        if self._is_aligned:
            return self._refined(candidates, last, sweep)
        first, used = candidates[0], shown.with_normal()
        return self._motion(first.T_prev_curr, first.covariance, np.zeros(6), last, sweep, used)

    def _refined(self, candidates: Sequence[Candidate], last: _Sweep, sweep: _Sweep) -> Motion:
        """The candidates, or the motion before, refined by alignment."""
        interval_s = sweep.middle - last.middle
        previous = self._interpolator.last
        sweeps = SweepPair(sweep.images.alignment, last.images.alignment, interval_s, previous)
        best, sweeps = self._best(candidates, sweeps, sweep.images.R_image_lidar)
        degeneracy = find_degeneracy(best.information, best.inliers, sweep.images.alignment)
        if len(degeneracy):
            covariance = candidates[0].covariance
            if previous is not None and self._last_covariance is not None:
                scale = (interval_s / previous.interval_s) ** 2
                covariance = scale * self._last_covariance + np.diag((_ACCELERATION * interval_s**2) ** 2)
                held = _HELD * degeneracy.projector()
                continued = exp(previous.velocity * interval_s)
                start = replaced_along(best.T_prev_curr, continued, degeneracy)
                best = align(InitialEstimate(start, held, held), sweeps)
            information = joined_information(INFORMATION_PER_M2 * best.information, covariance, degeneracy)
        else:
            information = INFORMATION_PER_M2 * best.information + best.prior_information
        if best.explained < _LEAST_EXPLAINED or best.inliers < _LEAST_INLIERS:
            self._forget()
            misfit = f"{best.inliers} inliers, {100.0 * best.explained:.0f} % of the information about one direction"
            return Motion(np.eye(4), 0, f"the scan does not fit the last one: {misfit}")
        covariance = np.asarray(np.linalg.inv(information + _LEAST_INFORMATION * np.eye(6)), dtype=np.float64)
        motion = self._motion(best.T_prev_curr, covariance, best.velocity_change, last, sweep, best.inliers)
        return replace(motion, degenerate=degeneracy.names)

    def _best(
        self, candidates: Sequence[Candidate], sweeps: SweepPair, R_image_lidar: FloatArray
    ) -> tuple[Alignment, SweepPair]:
        """The best alignment, and the sweeps with the motion before: at the first pair the expected one, if it fits."""
        expected, self._expected = self._expected, None
        if expected is None or sweeps.last is not None:
            return align_best(_initial_estimates(candidates, sweeps), sweeps), sweeps
        before = SweepMotion(np.kron(np.eye(2), R_image_lidar) @ expected, np.zeros(6), sweeps.interval_s)
        begun = replace(sweeps, last=before)
        best = align_best(_initial_estimates(candidates, begun), begun)
        if best.explained >= DOUBTFUL:
            return best, begun
        other = align_best(_initial_estimates(candidates, sweeps), sweeps)
        return (best, begun) if best.explained > other.explained else (other, sweeps)

    def _motion(
        self, T_prev_curr: FloatArray, covariance: FloatArray, change: FloatArray, last: _Sweep, sweep: _Sweep,
        points_used: int,
    ) -> Motion:  # fmt: skip
        """The motion between the stamps by that between the middles, whose covariance is of a change from the left."""
        self._last_covariance = covariance
        interval_s = sweep.middle - last.middle
        stamps, middles = (last.stamp, sweep.stamp), (last.middle, sweep.middle)
        between = self._interpolator.between_stamps(T_prev_curr, change, middles, stamps)
        return Motion(between, points_used, covariance=_right_covariance(T_prev_curr, covariance, change * interval_s))

    def _forget(self) -> None:
        """The next motion does not follow on the last."""
        self._interpolator.forget()
        self._last_covariance = None


def _initial_estimates(candidates: Sequence[Candidate], sweeps: SweepPair) -> list[InitialEstimate]:
    """The candidates, less likely by their scores and by the acceleration to them, and the motion before, continued."""
    squared = [2.0 * max(0.0, candidates[0].log_probability - one.log_probability) for one in candidates]
    continued: list[InitialEstimate] = []
    if sweeps.last is not None:
        expected, apart_s = exp(sweeps.last.velocity * sweeps.interval_s), sweeps.interval_s + sweeps.last.interval_s
        least_m = 0.5 * _ACCELERATING_M_S2 * sweeps.interval_s * apart_s
        for n, candidate in enumerate(candidates):
            change_m = float(np.linalg.norm(candidate.T_prev_curr[:3, 3] - expected[:3, 3]))
            squared[n] += min(change_m / least_m, _MOST_SIGMAS) ** 2
        continued = [InitialEstimate(expected, sigmas=_SIGMAS_OF_GOING_ON)]
    starts = []
    for candidate, square in zip(candidates, squared, strict=True):
        information = np.asarray(np.linalg.inv(candidate.covariance), dtype=np.float64)
        starts.append(InitialEstimate(candidate.T_prev_curr, information, sigmas=float(np.sqrt(square))))
    return [*starts, *continued]


def _right_covariance(T_prev_curr: FloatArray, left: FloatArray, change: FloatArray) -> FloatArray:
    """(6, 6) of the error `xi` in T_true = T_prev_curr @ exp(xi), rotation first.

    `left` is that of a change from the left. A part of the change of motion (6,) within a pair of sweeps, which is
    taken as uniform, is added to it.
    """
    A = adjoint(inverse(T_prev_curr))
    covariance = A @ left @ A.T + np.diag(_LEAST_SIGMA**2)
    covariance[3:, 3:] += np.eye(3) * (_HELD_BACK * np.linalg.norm(T_prev_curr[:3, 3])) ** 2
    return np.asarray(covariance + np.diag((_UNEVEN_SHARE * change) ** 2), dtype=np.float64)
