"""Comparison of the same motion as measured by LiDAR and IMU: axes and units, clocks, signs.

Turns show rotation and clock (Wahba's problem; Gauss-Newton on the rotation vectors), accelerations the accelerometer:
three positions give the velocity's change without a velocity (as in Qin and Shen's alignment, IROS 2017).
"""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, log, make_transform, skew
from lidarslam.core.imu import GRAVITY_RANGE, ImuSamples
from lidarslam.mapping.inertial.window import Preintegration

# Turns and velocities are compared over this time: long enough for errors of registered poses to matter little.
_SPAN_S = 0.5
_FEWEST, _LONGEST_S = 20, 3.0
# Errors of a turn at least, radians, and of the change of a velocity, m/s.
_TURN_ERROR, _VELOCITY_ERROR = np.deg2rad(0.1), 0.05
# The rotation is observable when its worst axis is this certain; turns agree when at most this share of them remains.
_MOST_SIGMA, _MOST_REMAINING = np.deg2rad(1.0), 0.3
# Deviations before the comparison: of the clock, seconds, of the rotation, radians, and of the bias, rad/s.
_CLOCK_S, _ROTATION, _BIAS = 0.1, np.deg2rad(5.0), 0.1
_SHIFT_S = 1e-3
# Errors of clock and rotation are corrected above these values, and beyond this many standard deviations.
_LEAST_OFFSET_S, _LEAST_ROTATION, _SIGNIFICANT = 0.003, np.deg2rad(1.0), 4.0
# Turns and changes of the velocity that are kept; turns that a correction needs, and how often one is made at most.
_KEPT, FEWEST_COMPARED, MOST_CORRECTIONS = 600, 30, 3
# The clock is certain to this then, seconds.
_CLOCK_SIGMA_S = 0.001
# Turns about an axis are observed where their power is this many times that of errors; axes that agree correlate.
_CLEAR, _CORRELATED = 100.0, 0.8
# Accelerations are reversed where their ratio is below minus this, and below zero by this many standard deviations.
_REVERSED, _DEVIATIONS = 0.3, 4.0
_REWEIGHTED = 8
_AXES = np.array(["x", "y", "z"])


def no_gravity(samples: ImuSamples) -> str | None:
    """Why the specific forces cannot contain gravity; None where they do."""
    size = float(np.median(np.linalg.norm(samples.accelerations, axis=1)))
    if GRAVITY_RANGE[0] < size < GRAVITY_RANGE[1]:
        return None
    return f"the IMU's accelerations have a median of {size:.3g} m/s^2, which is not gravity"


class MountingError(ValueError):
    """The rotation is not observable by the turns; the message has the reason."""


@dataclass(frozen=True, eq=False)
class Mounting:
    """A rotation that was found."""

    R_lidar_imu: FloatArray  # (3, 3)
    sigma: float  # standard deviation about the worst axis, radians


@dataclass(frozen=True, eq=False)
class Alignment:
    """Errors of an IMU's clock and rotation."""

    offset_s: float  # by which its stamps are late
    offset_sigma_s: float
    rotation: FloatArray  # (3,) rotation vector from its axes, as they were given, to the LiDAR's
    rotation_sigma: float  # of its worst axis, radians
    agrees: bool  # whether the turns agree after the correction; else some poses are wrong, or the IMU

    @property
    def is_certain(self) -> bool:
        """Whether more turns would hardly change the error of the clock."""
        return self.offset_sigma_s < _CLOCK_SIGMA_S

    @property
    def significant_offset_s(self) -> float:
        """The error of the clock where it is clear; else zero."""
        is_clear = abs(self.offset_s) > max(_LEAST_OFFSET_S, _SIGNIFICANT * self.offset_sigma_s)
        return self.offset_s if is_clear and self.agrees else 0.0

    @property
    def significant_rotation(self) -> FloatArray:
        """(3,) the rotation where it is clear; else zero."""
        is_clear = np.linalg.norm(self.rotation) > max(_LEAST_ROTATION, _SIGNIFICANT * self.rotation_sigma)
        return self.rotation if is_clear and self.agrees else np.zeros(3)

    def corrected(self, T_lidar_imu: FloatArray) -> FloatArray:
        """The extrinsic calibration (4, 4) without an error of the rotation that is clear."""
        turn = exp(np.pad(self.significant_rotation, (0, 3)))[:3, :3]
        return make_transform(turn @ T_lidar_imu[:3, :3], T_lidar_imu[:3, 3])

    def sentences(self) -> list[str]:
        """The errors that are clear, one sentence each."""
        sentences, degrees = [], np.rad2deg(np.linalg.norm(self.significant_rotation))
        if self.significant_offset_s:
            late = "late" if self.offset_s > 0.0 else "early"
            sentences.append(f"the IMU's stamps are {1e3 * abs(self.offset_s):.0f} ms {late}; corrected")
        if degrees:
            sentences.append(f"the IMU is turned by {degrees:.1f} degrees against its extrinsic calibration; corrected")
        return sentences


class Comparison:
    """The motion since half a second before each registered pose, by both; an unknown calibration is the identity."""

    def __init__(self, samples: ImuSamples, T_lidar_imu: FloatArray) -> None:
        self._T_lidar_imu = T_lidar_imu
        self.use(samples)
        self._recent: deque[tuple[float, FloatArray]] = deque()
        # Rows (13,): rotation vectors of LiDAR and IMU, the latter's change per second of the clock, the time, and the
        # integral of the angular velocity.
        self._turns: deque[FloatArray] = deque(maxlen=_KEPT)
        # Rotations (3, 3) and changes of the velocity (3,) by LiDAR and IMU, of the world.
        self._velocities: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque(maxlen=_KEPT)

    def __len__(self) -> int:
        return len(self._turns)

    def use(self, samples: ImuSamples) -> None:
        """Continue with other samples of the same IMU, such as the latest ones."""
        self._imu = Preintegration(samples, self._T_lidar_imu[:3, :3])

    def add(self, stamp: float, T_world_lidar: FloatArray, is_connected: bool) -> None:
        """Add a registered pose (4, 4); one that does not follow from those before restarts the comparison."""
        if not is_connected:
            self._recent.clear()
        self._recent.append((stamp, T_world_lidar))
        first = self._before(stamp - _SPAN_S)
        if first is None or not self._imu.covers(first[0] - _SHIFT_S, stamp + _SHIFT_S):
            return
        self._compare_turns(first, (stamp, T_world_lidar))
        earlier = self._before(first[0] - _SPAN_S)
        if earlier is not None and self._imu.covers(earlier[0], stamp):
            self._compare_velocities(earlier, first, (stamp, T_world_lidar))
        while self._recent and self._recent[0][0] < stamp - _LONGEST_S:
            self._recent.popleft()

    def mounting(self) -> Mounting:
        """The rotation between both frames (Wahba's problem, by SVD); the gyroscope's bias is in the mean.

        A MountingError is raised where the turns are too few, about one axis only, or do not agree.
        """
        if len(self) < _FEWEST:
            raise MountingError(f"only {len(self)} turns could be compared")
        turns = np.array(self._turns)
        a, b = (_about_mean(of, turns[:, 9:10]) for of in (turns[:, :3], turns[:, 3:6]))
        U, _, Vt = np.linalg.svd(a.T @ b)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        remaining = a - b @ R.T
        error = max(_TURN_ERROR, float(np.sqrt((remaining**2).mean())))
        information = np.eye(3) * float((a**2).sum()) - a.T @ a
        sigma = error / float(np.sqrt(max(np.linalg.eigvalsh(information)[0], 1e-12)))
        if sigma > _MOST_SIGMA:
            raise MountingError(
                f"it turns too little, or about one axis only: uncertain by {min(180.0, np.rad2deg(sigma)):.0f} degrees"
            )
        if _share(remaining, a) > _MOST_REMAINING:
            raise MountingError("the turns of LiDAR and IMU do not agree: different clocks, or axes of another kind")
        return Mounting(np.asarray(R, dtype=np.float64), sigma)

    def alignment(self) -> Alignment:
        """The errors of clock and rotation, with the gyroscope's bias; as good as the turns show them."""
        rows = np.array(self._turns).reshape(-1, 13)
        a, b, change, spans = rows[:, :3], rows[:, 3:6], rows[:, 6:9], rows[:, 9]
        J = np.zeros((len(rows), 3, 7))
        J[:, :, 0], J[:, :, 1:4] = change, -skew(b)
        J[:, :, 4:] = -spans[:, None, None] * np.eye(3)
        prior = np.diag(np.array([_CLOCK_S, *3 * [_ROTATION], *3 * [_BIAS]]) ** -2.0)
        x, covariance = _robust_fit(J, a - b, prior, _TURN_ERROR)
        worst = float(np.sqrt(np.linalg.eigvalsh(covariance[1:4, 1:4])[-1]))
        remaining = a - b - J @ x
        agrees = len(rows) >= _FEWEST and bool(
            (remaining**2).mean() < _TURN_ERROR**2 or _share(remaining, a) < _MOST_REMAINING
        )
        return Alignment(float(x[0]), float(np.sqrt(covariance[0, 0])), x[1:4], worst, agrees)

    def contradiction(self) -> str | None:
        """Observed errors of axes, signs or units; None where there are none."""
        if len(self) < _FEWEST:
            return None
        return self._contradicting_turns() or self._contradicting_velocities()

    def _contradicting_turns(self) -> str | None:
        """Turns differ, and others of the IMU's axes agree with those of the LiDAR."""
        turns = np.array(self._turns)
        lidar, imu = (_about_mean(of, turns[:, 9:10]) for of in (turns[:, :3], turns[:, 10:]))
        powers = (lidar**2).sum(axis=0)
        seen = powers > _CLEAR * _TURN_ERROR**2 * len(lidar)
        wrong = seen & (((imu - lidar) ** 2).sum(axis=0) > (2.0 * _MOST_REMAINING) ** 2 * powers)
        correlations = lidar.T @ imu / np.sqrt(np.outer(powers, (imu**2).sum(axis=0)).clip(1e-12))
        axes = np.abs(correlations).argmax(axis=1)
        best = correlations[range(3), axes]
        if not wrong.any() or np.abs(best[wrong]).min() < _CORRELATED:
            return None
        if (axes[seen] == np.flatnonzero(seen)).all() and (best[seen] > 0.0).all():
            size = float(np.sqrt((imu[:, seen] ** 2).sum() / powers[seen].sum()))
            return f"the gyroscope measures {size:.2g} times the turns of the LiDAR: its unit is not rad/s"
        names = ", ".join(f"{'-' if best[axis] < 0.0 else '+'}{_AXES[axes[axis]]}" for axis in np.flatnonzero(seen))
        return (
            f"turns of the LiDAR about {', '.join(_AXES[seen])} are {names} of the gyroscope, by its extrinsic"
            " calibration: a sign, the order of its axes, or the calibration is wrong"
        )

    def _contradicting_velocities(self) -> str | None:
        """Velocities change by a negative multiple of the measured acceleration, apart from gravity and a bias."""
        if len(self._velocities) < _FEWEST:
            return None
        rotations, lidar, imu = (np.stack(column) for column in zip(*self._velocities, strict=True))
        gravity = np.broadcast_to(np.eye(3), rotations.shape)
        ratio, sigma = _robust_fit(
            np.concatenate([imu[:, :, None], gravity, rotations], axis=2),
            lidar,
            np.diag([1e-4, *3 * [1e-4], *3 * [1.0]]),
            _VELOCITY_ERROR,
        )
        if ratio[0] > -_REVERSED or ratio[0] > -_DEVIATIONS * np.sqrt(sigma[0, 0]):
            return None
        return (
            "accelerations of the LiDAR's positions are opposed to those of the accelerometer, by its extrinsic"
            " calibration: a sign, the order of its axes, or the calibration is wrong"
        )

    def _before(self, stamp: float) -> tuple[float, FloatArray] | None:
        """The last recent pose that is not after a stamp."""
        return next((pose for pose in reversed(self._recent) if pose[0] <= stamp + 1e-3), None)

    def _compare_turns(self, first: tuple[float, FloatArray], last: tuple[float, FloatArray]) -> None:
        begin, end = first[0], last[0]
        none = np.zeros(3)
        imu = _vector(self._imu.turn(begin, end, none))
        later = _vector(self._imu.turn(begin + _SHIFT_S, end + _SHIFT_S, none))
        lidar = _vector(first[1][:3, :3].T @ last[1][:3, :3])
        integral = self._imu.means(np.array([begin, end]))[0, :3] * (end - begin)
        self._turns.append(np.concatenate([lidar, imu, (later - imu) / _SHIFT_S, [end - begin], integral]))

    def _compare_velocities(self, *poses: tuple[float, FloatArray]) -> None:
        """The velocity's change from the middle of one span to that of the next; gravity is a term of its own."""
        stamps = np.array([stamp for stamp, _ in poses])
        rotations = np.stack([T[:3, :3] for _, T in poses])
        positions = np.stack([T[:3, 3] + T[:3, :3] @ self._T_lidar_imu[:3, 3] for _, T in poses])
        first, second = np.diff(stamps)
        pims = [self._imu.between(a, b, np.zeros(6)) for a, b in pairwise(stamps)]
        lidar = (positions[2] - positions[1]) / second - (positions[1] - positions[0]) / first
        imu = (
            rotations[0] @ (pims[0].deltaVij() - pims[0].deltaPij() / first)
            + rotations[1] @ pims[1].deltaPij() / second
        )
        self._velocities.append((rotations[1], lidar, imu))


def _robust_fit(J: FloatArray, y: FloatArray, prior: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """Solution (K,) and covariance of `J x = y` for J (N, 3, K) and y (N, 3), reweighted by Cauchy's kernel.

    The prior is the information (K, K) of zero; errors of y are estimated, and have at least a standard deviation.
    """
    weight, error = np.ones(len(y)), least
    x: FloatArray = np.zeros(len(prior))
    covariance: FloatArray = np.asarray(np.linalg.inv(prior), dtype=np.float64)
    for _ in range(_REWEIGHTED if len(y) else 0):
        covariance = np.asarray(np.linalg.inv(np.einsum("n,nij,nik->jk", weight, J, J) / error**2 + prior))
        x = covariance @ np.einsum("n,nij,ni->j", weight, J, y) / error**2
        squares = ((y - J @ x) ** 2).mean(axis=1)
        error = max(least, 1.2 * float(np.sqrt(np.median(squares))))
        weight = 1.0 / (1.0 + squares / (2.0 * error) ** 2)
    return x, covariance


def _about_mean(turns: FloatArray, spans: FloatArray) -> FloatArray:
    """Turns (N, 3) without their mean rate, of which a constant bias is a part."""
    return np.asarray(turns - spans * (turns.sum(axis=0) / spans.sum()), dtype=np.float64)


def _share(remaining: FloatArray, of: FloatArray) -> float:
    return float(np.sqrt((remaining**2).sum() / (of**2).sum()))


def _vector(R: FloatArray) -> FloatArray:
    return log(make_transform(R, np.zeros(3)))[:3]
