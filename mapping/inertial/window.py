"""Pose, velocity, biases and gravity over the latest scans: a window of preintegrated IMU and registered poses.

A square-root information smoother: the factors are GTSAM's, the oldest state is marginalised (Dong-Si and Mourikis,
ICRA 2011; Leutenegger et al., IJRR 2015). The world's pose in a levelled frame is part of the state: its tilt is the
direction of gravity. So are the lever arm, and the ratio of the measured accelerations, without gravity, to those of
the LiDAR's positions.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated

import gtsam
import numpy as np
from gtsam import PreintegratedCombinedMeasurements, PreintegrationCombinedParams
from gtsam.imuBias import ConstantBias
from gtsam.symbol_shorthand import B, V, X
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse, log, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.state import TRANSFORM, Shape, Stateful

# Longest step of the integration of a turn: within it the axis of rotation is taken as constant.
_TURN_STEP_S = 0.0025
# A gap between samples is longer than this many usual intervals, and than this time, seconds.
_GAP_INTERVALS, _LEAST_GAP_S = 3.0, 0.02
STANDARD_GRAVITY = 9.81  # m/s^2
# Least white noise: rad/s/sqrt(Hz) and m/s^2/sqrt(Hz); walk of the biases, rad/s/sqrt(s) and m/s^2/sqrt(s).
_GYROSCOPE, _ACCELEROMETER = 5e-4, 5e-3
_GYROSCOPE_WALK, _ACCELEROMETER_WALK = 1e-4, 1e-3
# Error of scale and axes, as a share of the turn and of the acceleration; error of the clock, seconds.
_AXES_ERROR, _CLOCK_S = 0.001, 0.001
_INTEGRATION = 1e-4  # m/s/sqrt(Hz)
# Longest step of the preintegration.
_STEP_S = 0.01
# Scans of the window, and iterations after each.
_SCANS, _ITERATIONS = 10, 4
_CONVERGED = 0.005
# Degrees of freedom: pose, velocity, biases, pose of the world, logarithm of the scale, lever arm.
_SIZE = 25
_POSE, _VELOCITY, _BIASES, _WORLD = slice(0, 6), slice(6, 9), slice(9, 15), slice(15, 21)
SCALE, LEVER = 21, slice(22, 25)
# Samples are steady where their variance is at most this many times that of their white noise, and their mean rate,
# which has the bias, at most this, rad/s.
_STEADY, _STEADY_RATE, _FEWEST_STEADY = 3.0, 0.05, 20
# Standard deviation of the velocity at rest, m/s.
_REST = 0.01
# Standard deviations of the first state: velocity, m/s; biases of accelerometer and gyroscope; tilt; scale.
_SPEED, _FORCE_BIAS, _RATE_BIAS, _TILT, _SCALE = 15.0, 0.15, 0.01, np.deg2rad(5.0), 0.1
# Walk of gravity in the world, which follows the drift of the map: rad/sqrt(s); nothing else of the calibration walks.
_TILT_WALK, _FIXED = np.deg2rad(0.01), 1e-5
# Registrations off by more deviations count less.
_HUBER = 4.0
# Columns of two knots that GTSAM's factor has in order: poses and velocities, then biases, and the right-hand side.
_OF_IMU = np.r_[0:9, _SIZE : _SIZE + 9, 9:15, _SIZE + 9 : _SIZE + 15, 2 * _SIZE]


class Preintegration:
    """An IMU's samples and their noise in the LiDAR's axes, linear between stamps, by the extrinsic rotation (3, 3)."""

    def __init__(self, samples: ImuSamples, R_lidar_imu: FloatArray) -> None:
        from scipy.interpolate import make_interp_spline  # takes a while to load

        self._stamps = samples.stamps
        self._rows = np.hstack([samples.angular_velocities @ R_lidar_imu.T, samples.accelerations @ R_lidar_imu.T])
        # From the first stamp on: of clocks that count from 1970 half the digits would be lost.
        self._curve = make_interp_spline(self._stamps - self._stamps[0], self._rows, k=1).antiderivative()
        self._longest_s = max(_GAP_INTERVALS * float(np.median(np.diff(samples.stamps))), _LEAST_GAP_S)
        # Second differences of samples show noise and vibration, which the integration takes for motion.
        second = np.diff(self._rows, n=2, axis=0).reshape(-1, 2, 3)
        self._variances = np.cumsum(np.pad((second**2).mean(axis=2) / 6.0, ((2, 0), (0, 0))), axis=0)

    def _integrals(self, instants: FloatArray) -> FloatArray:
        """(M - 1, 6) of angular velocity and specific force, from each of M instants to the next."""
        return np.diff(self._curve(instants - self._stamps[0]), axis=0)

    def _samples(self, instants: FloatArray) -> FloatArray:
        """(M, 6) at M instants."""
        return np.asarray(self._curve(instants - self._stamps[0], 1), dtype=np.float64)

    def means(self, instants: FloatArray) -> FloatArray:
        """(M - 1, 6) mean angular velocity and specific force between M instants."""
        inside = np.clip(instants, self._stamps[0], self._stamps[-1])
        steps = np.diff(inside)
        with np.errstate(divide="ignore", invalid="ignore"):
            means = self._integrals(inside) / steps[:, None]
        return np.where(steps[:, None] > 0.0, means, self._samples(inside[1:]))

    def covers(self, first_s: float, last_s: float) -> bool:
        """Whether samples without a gap surround a time."""
        before, after = np.searchsorted(self._stamps, (first_s, last_s), "right")
        near = self._stamps[max(0, before - 1) : after + 1]
        at_ends = first_s >= near[0] - self._longest_s and last_s <= near[-1] + self._longest_s if len(near) else False
        return bool(at_ends and (np.diff(near) <= self._longest_s).all())

    def is_steady(self, first_s: float, last_s: float) -> bool:
        """Whether samples scatter as their white noise does, and do not turn: at rest, or at a constant velocity.

        The white noise is that of their second differences.
        """
        begin, end = np.searchsorted(self._stamps, (first_s, last_s))
        rows = self._rows[begin:end].reshape(-1, 2, 3)
        if len(rows) < _FEWEST_STEADY or np.linalg.norm(rows[:, 0].mean(axis=0)) > _STEADY_RATE:
            return False
        noise = (self._variances[end - 1] - self._variances[begin + 1]) / (len(rows) - 2)
        return bool((rows.var(axis=0).mean(axis=1) <= _STEADY * noise).all())

    def within(self, first_s: float, last_s: float, step_s: float) -> FloatArray:
        """(M,) even instants of a time that samples cover, as far as they do."""
        first_s, last_s = np.clip([first_s, last_s], self._stamps[0], self._stamps[-1])
        return np.linspace(first_s, last_s, max(2, int(np.ceil((last_s - first_s) / step_s)) + 1))

    def turn(self, first_s: float, last_s: float, bias: FloatArray) -> FloatArray:
        """(3, 3) R_first_last of the LiDAR between two instants; the bias (3,) is of the LiDAR's axes, rad/s."""
        steps = max(1, int(np.ceil(abs(last_s - first_s) / _TURN_STEP_S)))
        return np.asarray(self.rotations(np.linspace(first_s, last_s, steps + 1), bias)[-1], dtype=np.float64)

    def rotations(self, instants: FloatArray, bias: FloatArray) -> FloatArray:
        """(N, 3, 3) R_first_t of the LiDAR at N instants, the first of which is the reference."""
        inside = np.clip(instants, self._stamps[0], self._stamps[-1])  # the last rate is held for the rest
        angles = self._integrals(inside)[:, :3]
        beyond = np.diff(instants) - np.diff(inside)
        if beyond.any():
            angles = angles + beyond[:, None] * self._samples(inside[1:])[:, :3]
        steps = exp(np.pad(angles - np.diff(instants)[:, None] * bias, ((0, 0), (0, 3)))).reshape(-1, 4, 4)[:, :3, :3]
        rotations: FloatArray = np.empty((len(instants), 3, 3))
        rotations[0] = np.eye(3)
        for n, step in enumerate(steps):
            rotations[n + 1] = rotations[n] @ step
        return rotations

    def mean_rate(self, scan: Scan) -> FloatArray | None:
        """(3,) the constant rate during a sweep, rad/s, with the bias; None where sweep or samples have no times."""
        turns = self._turns(scan)
        return None if turns is None else turns[2]

    def evened(self, scan: Scan) -> Scan:
        """The sweep as if the sensor had turned at `mean_rate` all the time.

        Methods that compensate a sweep with one angular velocity then compensate it for the whole turn. The bias, a
        constant rate, has no part in it.
        """
        turns = self._turns(scan)
        if turns is None or scan.time_offsets is None:
            return scan
        times, T_stamp_t, rate = turns
        steady = exp(np.pad(times[:, None] * rate, ((0, 0), (0, 3))))
        remaining = log(inverse(steady) @ T_stamp_t)[:, :3]
        vectors = np.stack([np.interp(scan.time_offsets, times, axis) for axis in remaining.T], axis=1)
        return replace(scan, points=_rotated(scan.points, vectors))

    def _turns(self, scan: Scan) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Times (N,) during a sweep, the turns (N, 4, 4) since its stamp, and the nearest constant rate (3,)."""
        if scan.time_offsets is None or not len(scan):
            return None
        begin, end = min(0.0, float(scan.time_offsets.min())), max(0.0, float(scan.time_offsets.max()))
        if end <= begin or not self.covers(scan.stamp + begin, scan.stamp + end):
            return None
        times = np.union1d(np.linspace(begin, end, max(2, int(np.ceil((end - begin) / _TURN_STEP_S)) + 1)), [0.0])
        rotations = self.rotations(scan.stamp + times, np.zeros(3))
        T_stamp_t = make_transform(rotations[np.searchsorted(times, 0.0)].T @ rotations, np.zeros(3))
        return times, T_stamp_t, np.asarray(times @ log(T_stamp_t)[:, :3] / (times @ times), dtype=np.float64)

    def between(self, first_s: float, last_s: float, bias: FloatArray) -> PreintegratedCombinedMeasurements:
        """The measurements between two stamps, about a bias (6,), accelerometer first."""
        inside = self._stamps[np.searchsorted(self._stamps, first_s, "right") : np.searchsorted(self._stamps, last_s)]
        even = np.linspace(first_s, last_s, max(2, int(np.ceil((last_s - first_s) / _STEP_S)) + 1))
        instants = (
            np.union1d(inside, even) if len(inside) < len(even) else np.concatenate([[first_s], inside, [last_s]])
        )
        steps = np.diff(instants)
        means = self.means(instants)
        pim = PreintegratedCombinedMeasurements(
            self._noise(first_s, last_s, len(inside)), ConstantBias(bias[:3], bias[3:])
        )
        for step, mean in zip(steps, means, strict=True):
            if step > 0.0:
                pim.integrateMeasurement(mean[3:], mean[:3], step)
        return pim

    def _noise(self, first_s: float, last_s: float, count: int) -> PreintegrationCombinedParams:
        interval_s = last_s - first_s
        begin, end = np.searchsorted(self._stamps, (first_s, last_s)).clip(0, len(self._stamps) - 1)
        variances = (self._variances[end] - self._variances[begin]) / max(end - begin, 1)
        densities2 = variances * interval_s / max(count, 1) + np.array([_GYROSCOPE, _ACCELEROMETER]) ** 2
        ends = self._samples(np.clip([first_s, last_s], self._stamps[0], self._stamps[-1]))
        change = (ends[1] - ends[0]).reshape(2, 3)
        mean = self.means(np.array([first_s, last_s]))[0].reshape(2, 3)
        mean[1] -= STANDARD_GRAVITY * mean[1] / max(float(np.linalg.norm(mean[1])), 1e-9)
        systematic = _AXES_ERROR**2 * (mean**2).sum(axis=1) * interval_s**2 + _CLOCK_S**2 * (change**2).sum(axis=1)
        densities2 = densities2 + systematic / interval_s
        params = PreintegrationCombinedParams.MakeSharedU(STANDARD_GRAVITY)
        params.setGyroscopeCovariance(densities2[0] * np.eye(3))
        params.setAccelerometerCovariance(densities2[1] * np.eye(3))
        params.setIntegrationCovariance(_INTEGRATION**2 * np.eye(3))
        params.setBiasOmegaCovariance(_GYROSCOPE_WALK**2 * np.eye(3))
        params.setBiasAccCovariance(_ACCELEROMETER_WALK**2 * np.eye(3))
        return params


@dataclass(frozen=True, eq=False)
class Knot:
    """State at the stamp of a scan."""

    stamp: float  # seconds
    T_nav_imu: Annotated[FloatArray, TRANSFORM]  # (4, 4); the navigation frame has its z axis upwards
    velocity: Annotated[FloatArray, Shape(3)]  # (3,) in the navigation frame, m/s
    bias: Annotated[FloatArray, Shape(6)]  # (6,) of accelerometer, m/s^2, and gyroscope, rad/s
    T_nav_world: Annotated[FloatArray, TRANSFORM]  # (4, 4)
    integrated_at: Annotated[FloatArray, Shape(6)]  # (6,) bias at which samples since the last are integrated
    scale: float  # ratio of the measured accelerations, without gravity, to those of the LiDAR's positions
    lever: Annotated[FloatArray, Shape(3)]  # (3,) position of the IMU in the LiDAR frame, whose axes are the IMU's, too
    T_world_lidar: Annotated[FloatArray, TRANSFORM]  # (4, 4) as registered
    sqrt_information: Annotated[FloatArray, Shape(6, 6)]  # of the registration; zero where there was none
    is_at_rest: bool = False

    @property
    def T_imu_lidar(self) -> FloatArray:
        """(4, 4) of the lever arm."""
        return make_transform(np.eye(3), -self.lever)

    @property
    def T_world_estimated(self) -> FloatArray:
        """(4, 4) pose of the LiDAR in the world."""
        return np.asarray(inverse(self.T_nav_world) @ self.T_nav_imu @ self.T_imu_lidar, dtype=np.float64)

    def moved(self, step: FloatArray) -> "Knot":
        """The state after a step (25,)."""
        return replace(
            self,
            T_nav_imu=_matrix(gtsam.Pose3(self.T_nav_imu).retract(step[_POSE])),
            velocity=self.velocity + step[_VELOCITY],
            bias=self.bias + step[_BIASES],
            T_nav_world=_matrix(gtsam.Pose3(self.T_nav_world).retract(step[_WORLD])),
            scale=self.scale * float(np.exp(step[SCALE])),
            lever=self.lever + step[LEVER],
        )

    def away_from(self, other: "Knot") -> FloatArray:
        """(25,) the step from another state to this one."""
        return np.concatenate([
            log(inverse(other.T_nav_imu) @ self.T_nav_imu),
            self.velocity - other.velocity,
            self.bias - other.bias,
            log(inverse(other.T_nav_world) @ self.T_nav_world),
            [np.log(self.scale / other.scale)],
            self.lever - other.lever,
        ])  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Prior:
    """Gaussian of the oldest state: `|A step - b|^2` about a mean."""

    mean: Knot
    A: Annotated[FloatArray, Shape(_SIZE, _SIZE)]
    b: Annotated[FloatArray, Shape(_SIZE)]


class InertialWindow(Stateful):
    """The latest knots, the first of which begins it; with the position (3,) of the IMU in the LiDAR frame."""

    _knots: list[Knot]
    _prior: _Prior | None
    _latest: Annotated[FloatArray, Shape(_SIZE, _SIZE)]  # square root of the latest state's information

    def __init__(self, preintegration: Preintegration, lever: FloatArray, lever_sigma_m: float) -> None:
        self.preintegration = preintegration  # of the samples from here on
        self._lever, self._lever_sigma_m = lever, lever_sigma_m
        self._measurements: dict[float, gtsam.PreintegratedCombinedMeasurements] = {}
        self._knots, self._prior, self._latest = [], None, np.eye(_SIZE)

    @property
    def last(self) -> Knot | None:
        """The latest state; None before the first."""
        return self._knots[-1] if self._knots else None

    def begin(
        self, stamp: float, T_world_lidar: FloatArray, sqrt_information: FloatArray, up: FloatArray, is_level: bool,
        is_at_rest: bool,
    ) -> None:  # fmt: skip
        """Begin at a registered pose (4, 4), with the specific force (3,) there; the calibration stays.

        With `is_level`, so does the tilt of the world; after a long loss of tracking, the map may have been restarted.
        """
        last, sigmas = self.last, np.full(_SIZE, np.inf)
        sigmas[_VELOCITY], sigmas[9:12], sigmas[12:15], sigmas[_WORLD] = _SPEED, _FORCE_BIAS, _RATE_BIAS, _TILT
        sigmas[SCALE], sigmas[LEVER] = _SCALE, self._lever_sigma_m
        A = np.diag(1.0 / sigmas)
        # The shortest rotation that turns the force to the z axis.
        vertical = Rotation.align_vectors([[0.0, 0.0, 1.0]], [T_world_lidar[:3, :3] @ up])[0]
        T_nav_world = make_transform(vertical.as_matrix(), np.zeros(3))
        bias, scale, lever = np.zeros(6), 1.0, self._lever
        if last is not None:
            bias, scale, lever = last.bias, last.scale, last.lever
            kept = np.r_[9:_SIZE] if is_level else np.r_[9:15, SCALE:_SIZE]
            A[np.ix_(kept, kept)] = np.linalg.cholesky(np.linalg.inv(self.covariance()[np.ix_(kept, kept)])).T
            T_nav_world = last.T_nav_world if is_level else T_nav_world
        T_nav_imu = T_nav_world @ T_world_lidar @ make_transform(np.eye(3), lever)
        knot = Knot(
            stamp, T_nav_imu, np.zeros(3), bias, T_nav_world, bias, scale, lever, T_world_lidar, sqrt_information,
            is_at_rest,
        )  # fmt: skip
        self._knots, self._measurements = [knot], {}
        self._prior = _Prior(knot, A, np.zeros(_SIZE))
        self._latest = _triangle(_own_rows(self._prior, knot)[:, :_SIZE])

    def predicted(self, stamp: float) -> Knot:
        """The state at the next stamp by the IMU alone."""
        last = self._knots[-1]
        pim = self.preintegration.between(last.stamp, stamp, last.bias)
        self._measurements[stamp] = pim
        pose, velocity = _scaled(last, last)
        state = pim.predict(gtsam.NavState(pose, velocity), ConstantBias(last.bias[:3], last.bias[3:]))
        T = _matrix(state.pose())
        T[:3, 3] = last.T_nav_imu[:3, 3] + T[:3, 3] / last.scale
        knot = replace(
            last, stamp=stamp, T_nav_imu=T, velocity=state.velocity() / last.scale, integrated_at=last.bias,
            sqrt_information=np.zeros((6, 6)),
        )  # fmt: skip
        return replace(knot, T_world_lidar=knot.T_world_estimated)

    def add(self, knot: Knot) -> None:
        """Add the next state, with its registration if there is one, and update all states."""
        self._knots.append(knot)
        for _ in range(_ITERATIONS):
            step = self._step()
            if np.abs(step).max() < _CONVERGED:
                break
        while len(self._knots) > _SCANS:
            first, second = self._knots[:2]
            assert self._prior is not None
            R = _eliminated(_own_rows(self._prior, first), self._between_rows(first, second))
            self._prior = _remaining(second, R)
            self._knots = self._knots[1:]
            self._measurements.pop(second.stamp, None)

    def covariance(self, following: Knot | None = None) -> FloatArray:
        """(25, 25) of the latest state, or of a predicted one that follows it."""
        root, last = self._latest, self._knots[-1]
        if following is not None:
            own = np.pad(root, ((0, 0), (0, 1)))
            root = _remaining(following, _eliminated(own, self._between_rows(last, following))).A
        inverse_root = np.linalg.inv(root)
        return np.asarray(inverse_root @ inverse_root.T, dtype=np.float64)

    def _step(self) -> FloatArray:
        """Gauss-Newton step of all states, by elimination in their order; that of the latest (25,)."""
        rows, prior = [], self._prior
        assert prior is not None
        for first, second in pairwise(self._knots):
            R = _eliminated(_own_rows(prior, first), self._between_rows(first, second))
            prior = _remaining(second, R)
            rows.append(R[:_SIZE])
        last = _triangle(_own_rows(prior, self._knots[-1]))[:_SIZE]
        self._latest = last[:, :_SIZE]
        steps = [solve_triangular(self._latest, last[:, -1])]
        for row in reversed(rows):
            steps.append(solve_triangular(row[:, :_SIZE], row[:, -1] - row[:, _SIZE:-1] @ steps[-1]))
        self._knots = [knot.moved(step) for knot, step in zip(self._knots, reversed(steps), strict=True)]
        return steps[0]

    def _between_rows(self, first: Knot, second: Knot) -> FloatArray:
        """Whitened rows `[first | second | b]` (25, 51) of the IMU between two knots, and the walk of gravity.

        Positions and velocities are scaled, so that their accelerations are the measured ones.
        """
        values, scaled = gtsam.Values(), [_scaled(knot, first) for knot in (first, second)]
        for n, (knot, (pose, velocity)) in enumerate(zip((first, second), scaled, strict=True)):
            values.insert(X(n), pose)
            values.insert(V(n), velocity)
            values.insert(B(n), ConstantBias(knot.bias[:3], knot.bias[3:]))
        pim = self._measurements.get(second.stamp)
        if pim is None:
            pim = self.preintegration.between(first.stamp, second.stamp, second.integrated_at)
            self._measurements[second.stamp] = pim
        factor = gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), pim).linearize(values)
        rows: FloatArray = np.zeros((_SIZE, 2 * _SIZE + 1))
        rows[:15, _OF_IMU] = factor.augmentedJacobian()
        for begin, (pose, velocity) in zip((0, _SIZE), scaled, strict=True):
            position, speed = slice(begin + 3, begin + 6), slice(begin + 6, begin + 9)
            along = pose.rotation().matrix().T @ pose.translation()
            rows[:15, SCALE] += rows[:15, position] @ along + rows[:15, speed] @ velocity
            rows[:15, position] *= first.scale
            rows[:15, speed] *= first.scale
        root = 1.0 / np.array([_TILT_WALK * np.sqrt(second.stamp - first.stamp)] * 3 + [_FIXED] * 7)
        away = second.away_from(first)[15:]
        rows[15:, 15:_SIZE], rows[15:, _SIZE + 15 : -1] = -np.diag(root), np.diag(root)
        rows[15:, -1] = -root * away
        return rows


def _scaled(knot: Knot, origin: Knot) -> tuple[gtsam.Pose3, FloatArray]:
    """Pose relative to the position of another knot, and velocity, both scaled to the measured accelerations."""
    T = knot.T_nav_imu.copy()
    T[:3, 3] = origin.scale * (T[:3, 3] - origin.T_nav_imu[:3, 3])
    return gtsam.Pose3(T), origin.scale * knot.velocity


def _matrix(pose: gtsam.Pose3) -> FloatArray:
    # Column by column, sums would round otherwise than those of a restored state.
    return np.ascontiguousarray(pose.matrix(), dtype=np.float64)


def _eliminated(own: FloatArray, between: FloatArray) -> FloatArray:
    """Upper triangle `[first | second | b]` of a knot's rows `[first | b]` and those between it and the next."""
    rows: FloatArray = np.zeros((len(own) + len(between), 2 * _SIZE + 1))
    rows[: len(own), :_SIZE], rows[: len(own), -1] = own[:, :-1], own[:, -1]
    rows[len(own) :] = between
    return _triangle(rows)


def _triangle(rows: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)


def _remaining(second: Knot, R: FloatArray) -> _Prior:
    """The information on the second knot in the triangle of two."""
    return _Prior(second, R[_SIZE : 2 * _SIZE, _SIZE:-1].copy(), R[_SIZE : 2 * _SIZE, -1].copy())


def _own_rows(prior: _Prior, knot: Knot) -> FloatArray:
    """Whitened rows `[own | b]` (N, 26) of a knot's Gaussian, its registered pose, by Huber's kernel, and its rest."""
    away = (prior.b - prior.A @ knot.away_from(prior.mean))[:, None]
    expected, root = knot.T_world_estimated, knot.sqrt_information
    residual = root @ log(inverse(knot.T_world_lidar) @ expected)
    norm = float(np.linalg.norm(residual))
    weight = np.sqrt(_HUBER / norm) if norm > _HUBER else 1.0
    rows: FloatArray = np.zeros((6, _SIZE + 1))
    rows[:, _POSE] = root @ adjoint(inverse(knot.T_imu_lidar))
    rows[:, _WORLD] = -root @ adjoint(inverse(expected))
    rows[:, LEVER], rows[:, -1] = -root[:, 3:], -residual
    rest: FloatArray = np.zeros((3, _SIZE + 1))
    rest[:, _VELOCITY], rest[:, -1] = np.eye(3) / _REST, -knot.velocity / _REST
    return np.vstack([np.hstack([prior.A, away]), weight * rows, rest[: 3 * knot.is_at_rest]])


def _rotated(points: FloatArray, vectors: FloatArray) -> FloatArray:
    """Points (N, 3), each turned by its own rotation vector (N, 3)."""
    angle2 = np.einsum("ij,ij->i", vectors, vectors)
    angle = np.sqrt(angle2)
    sine, versine = np.sinc(angle / np.pi)[:, None], 0.5 * np.sinc(0.5 * angle / np.pi)[:, None] ** 2
    once = np.cross(vectors, points)
    return np.asarray(points + sine * once + versine * np.cross(vectors, once), dtype=np.float64)
