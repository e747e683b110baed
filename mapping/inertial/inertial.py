"""An IMU's part in scan-to-map registration: it predicts each scan's state, and follows the registered poses."""

from dataclasses import replace
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, adjoint, inverse, make_transform, rotation_angle, skew
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.state import Shape, Stateful
from lidarslam.mapping.inertial.window import LEVER, SCALE, STANDARD_GRAVITY, InertialWindow, Knot, Preintegration
from lidarslam.mapping.motion.prediction import GravityDirection, MotionState, Prior
from lidarslam.mapping.tracking.mapped_scan import MappedScan

# Errors of registered poses that no registration reports: standard deviations, rotation first.
_REGISTRATION = np.array([np.deg2rad(0.05)] * 3 + [0.005] * 3)
# Error of a sweep's mean velocity, of which the motion is none: rotation, rad/s, and translation, m/s.
_UNEVEN = np.array([0.01] * 3 + [0.03] * 3)
# Standard deviations of the lever arm's components, given and found.
KNOWN_LEVER_M, UNKNOWN_LEVER_M = 0.02, 0.3
# Time around a stamp over which the specific force is taken as gravity, seconds.
_LEVEL_S, _STEP_S = 1.0, 0.02
# Dead reckoning by the IMU alone ends after this time, seconds.
_DEAD_RECKONING_S = 2.0
# At rest, samples are steady from this time before a stamp until that after it, seconds, and scans are registered
# within this distance.
_REST_S, _REST_M = (0.25, 0.5), 0.05
# Gravity is measured this often, seconds, where its direction is known to this, radians.
_EVERY_S, _LEVEL_SIGMA = 1.0, np.deg2rad(0.5)
# The vertical of the world is replaced by one whose deviation is smaller by this factor.
_BETTER = 0.7
# The turns of IMU and LiDAR disagree when they differ by more than this share, and by more than registration does.
_FEWEST_TURNS, _MOST_DIFFERENT, _REGISTRATION_ERROR = 50, 0.2, np.deg2rad(0.15)
# Biases are reported beyond this many standard deviations and above a threshold: sensor, part of the bias, threshold in
# m/s^2 and rad/s, factor and unit of the message.
_DEVIATIONS = 5.0
_LARGE_SCALE = 0.05
_LARGE_BIASES = (
    ("accelerometer", slice(0, 3), 0.5, 1.0 / STANDARD_GRAVITY, "g"),
    ("gyroscope", slice(3, 6), np.deg2rad(0.8), 180.0 / np.pi, "deg/s"),
)


class Inertial(Stateful):
    """Follows the registered scans, and predicts the next, given the IMU's extrinsic calibration (4, 4)."""

    _window: InertialWindow
    _registered_s: float | None  # stamp of the last registered scan
    _rest_position: Annotated[FloatArray, Shape(3)] | None  # of a LiDAR that has been at rest since the first scan
    _measured_s: float | None  # stamp at which gravity was measured last
    _up_world: Annotated[FloatArray, Shape(3)] | None  # unit, as first known well
    _up_sigma: float  # radians
    direction: GravityDirection | None  # gravity as measured until the last scan, in its LiDAR frame
    # of the turns that were compared: their number, and the sums of squares of their angles and of the differences
    _turns: int
    _angles2: float
    _differences2: float

    def __init__(self, samples: ImuSamples, T_lidar_imu: FloatArray, lever_sigma_m: float = KNOWN_LEVER_M) -> None:
        self._extrinsics, self._lever_sigma_m = T_lidar_imu, lever_sigma_m
        self.may_rest = True  # where its samples are steady; otherwise it moves at a constant velocity
        self.is_mounting_known = lever_sigma_m < UNKNOWN_LEVER_M  # given; else its rotation was found
        self._integrate(samples)
        self._window = InertialWindow(self.gyroscope, T_lidar_imu[:3, 3], lever_sigma_m)
        self._predicted: Knot | None = None
        self._registered_s, self._measured_s, self.direction = None, None, None
        self._rest_position = None
        self._up_world, self._up_sigma = None, np.pi
        self._turns, self._angles2, self._differences2 = 0, 0.0, 0.0

    def use(self, samples: ImuSamples) -> None:
        """Continue with other samples of the same IMU, such as the latest ones."""
        self._integrate(samples)
        self._window.preintegration = self.gyroscope

    def anew(self) -> "Inertial":
        """A new instance with the same samples."""
        return self._with(self._samples)

    def reversed(self, about_s: float) -> "Inertial":
        """A new instance with the same samples, with time reversed about an instant."""
        samples = self._samples
        stamps = 2.0 * about_s - samples.stamps[::-1]
        return self._with(ImuSamples(stamps, -samples.angular_velocities[::-1], samples.accelerations[::-1]))

    def _with(self, samples: ImuSamples) -> "Inertial":
        other = Inertial(samples, self._extrinsics, self._lever_sigma_m)
        other.may_rest = self.may_rest
        return other

    @property
    def warnings(self) -> list[str]:
        """Problems of the IMU, one sentence each."""
        warnings, last = [], self._window.last
        differences2 = self._differences2 - self._turns * _REGISTRATION_ERROR**2
        if self._turns >= _FEWEST_TURNS and differences2 >= _MOST_DIFFERENT**2 * self._angles2:
            differ = f"differ by {100.0 * np.sqrt(differences2 / self._angles2):.0f} %"
            warnings.append(f"the turns that IMU and LiDAR measured {differ}: the IMU's mounting or clock is wrong")
        if last is not None:
            whole = self._window.covariance()
            covariance = whole[9:15, 9:15]
            for sensor, part, least, scale, unit in _LARGE_BIASES:
                size, sigma = np.linalg.norm(last.bias[part]), np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1])
                if size > max(least, _DEVIATIONS * sigma):
                    warnings.append(f"the IMU's {sensor} has a bias of {scale * size:.2f} {unit}; estimated, corrected")
            sigma = np.sqrt(whole[SCALE, SCALE])
            if abs(np.log(last.scale)) > max(_LARGE_SCALE, _DEVIATIONS * sigma):
                times = f"{last.scale:.2f} times those of the LiDAR's positions"
                warnings.append(f"the IMU's accelerations are {times}; estimated, corrected")
        return warnings

    @property
    def is_at_rest(self) -> bool:
        """Whether the sensor has been at rest since the first scan, by its IMU and by the registrations."""
        return self._rest_position is not None

    @property
    def T_lidar_imu(self) -> FloatArray:
        """(4, 4) extrinsic calibration, its position as estimated."""
        lever = self._extrinsics[:3, 3] if self._window.last is None else self._window.last.lever
        return make_transform(self._extrinsics[:3, :3], lever)

    def prior(self, scan: Scan, prior: Prior) -> Prior:
        """The odometry's prior of a scan, with the state that the IMU predicts."""
        last, self._predicted = self._window.last, None
        if last is None or scan.stamp <= last.stamp or not self.gyroscope.covers(last.stamp, scan.stamp):
            return prior
        if self._registered_s is None or scan.stamp - self._registered_s > _DEAD_RECKONING_S:
            return prior
        self._predicted = knot = self._window.predicted(scan.stamp)
        return replace(prior, inertial=self._lidar_state(scan, knot, self._window.covariance(knot)))

    def update(self, scan: Scan, mapped: MappedScan) -> None:
        """Update with the result of a scan: biases, velocity and gravity follow it."""
        knot, self._predicted, self.direction = self._predicted, None, None
        has_moved = self._has_moved(mapped)
        self.may_rest &= not has_moved
        if not (self.may_rest and self._is_steady(scan.stamp)):
            self._rest_position = None
        if knot is None or has_moved or (mapped.registered and not mapped.is_connected):
            self._up_world = None
            if mapped.registered or self._window.last is None:
                self._begin(scan, mapped.state.T_world_lidar)
            return
        knot = replace(knot, is_at_rest=self.is_at_rest)
        if mapped.registered and mapped.measured is not None:
            self._compare(knot, mapped)
            root = _root_of(mapped.measured.information)
            knot = replace(knot, T_world_lidar=mapped.measured.T_world_lidar, sqrt_information=root)
            self._registered_s = scan.stamp
        self._window.add(knot)
        self.direction = self._gravity(knot.stamp)

    def _gravity(self, stamp: float) -> GravityDirection | None:
        """Gravity once a second, as soon as its direction in the world is known."""
        if self._measured_s is not None and stamp - self._measured_s < _EVERY_S - 1e-6:
            return None
        last, covariance = self._window.last, self._window.covariance()
        assert last is not None
        tilt = last.T_nav_imu[:3, :3] @ covariance[:3, :3] @ last.T_nav_imu[:3, :3].T
        sigma = float(np.sqrt(np.linalg.eigvalsh(tilt[:2, :2])[-1]))
        if sigma > _LEVEL_SIGMA:
            return None
        self._measured_s, up = stamp, last.T_nav_imu[2, :3]
        if self._up_world is None or sigma < _BETTER * self._up_sigma:
            self._up_world, self._up_sigma = last.T_nav_world[2, :3], sigma
        across = skew(up)
        return GravityDirection(
            up, self._up_world, across @ covariance[:3, :3] @ across.T + self._up_sigma**2 * np.eye(3)
        )

    def _is_steady(self, stamp: float) -> bool:
        return self.gyroscope.is_steady(stamp - _REST_S[0], stamp + _REST_S[1])

    def _has_moved(self, mapped: MappedScan) -> bool:
        """Whether a sensor that is at rest by its IMU was registered elsewhere: it moves at a constant velocity."""
        if self._rest_position is None or not mapped.registered:
            return False
        return bool(np.linalg.norm(mapped.state.T_world_lidar[:3, 3] - self._rest_position) > _REST_M)

    def _integrate(self, samples: ImuSamples) -> None:
        self._samples = samples
        self.gyroscope = Preintegration(samples, self._extrinsics[:3, :3])

    def _begin(self, scan: Scan, T_world_lidar: FloatArray) -> None:
        if self.gyroscope.covers(scan.stamp, scan.stamp):
            instants = self.gyroscope.within(scan.stamp - _LEVEL_S, scan.stamp + _LEVEL_S, _STEP_S)
            turns = self.gyroscope.rotations(instants, np.zeros(3))
            at = self.gyroscope.turn(scan.stamp, instants[0], np.zeros(3))
            up = at @ np.einsum("nij,nj->i", turns[:-1], self.gyroscope.means(instants)[:, 3:])
            is_level = self._registered_s is not None and scan.stamp - self._registered_s < _DEAD_RECKONING_S
            root = np.diag(1.0 / _REGISTRATION)
            if self._window.last is None and self.may_rest and self._is_steady(scan.stamp):
                self._rest_position = T_world_lidar[:3, 3].copy()
            self._window.begin(scan.stamp, T_world_lidar, root, up, is_level, self.is_at_rest)
            self._registered_s = scan.stamp

    def _lidar_state(self, scan: Scan, knot: Knot, covariance: FloatArray) -> MotionState:
        """The LiDAR's pose and velocity during a sweep, with their covariance (12, 12), of a state of the IMU."""
        T_nav_lidar, lever = knot.T_nav_imu @ knot.T_imu_lidar, -knot.lever
        T_world_lidar, R = knot.T_world_estimated, T_nav_lidar[:3, :3]
        begin, end = _sweep(scan)
        around = scan.stamp + (np.array([begin, end]) if end > begin else np.array([-0.005, 0.005]))
        mean = self.gyroscope.means(around)[0]
        rate = self.gyroscope.mean_rate(scan)
        rate = (mean[:3] if rate is None else rate) - knot.bias[3:]
        acceleration, own = (mean[3:] - knot.bias[:3] - R[2] * STANDARD_GRAVITY) / knot.scale, R.T @ knot.velocity
        # At the middle of the sweep; a twist turns with the sensor.
        middle_s = 0.5 * (begin + end)
        translation = own + np.cross(rate, lever) + middle_s * (acceleration - np.cross(rate, own))
        J = np.zeros((12, len(covariance)))
        J[:6, :6], J[:6, 15:21] = adjoint(inverse(knot.T_imu_lidar)), -adjoint(inverse(T_world_lidar))
        J[3:6, LEVER] = -np.eye(3)
        J[6:9, 12:15] = -np.eye(3)
        turned = np.eye(3) - middle_s * skew(rate)
        J[9:, :3], J[9:, 6:9], J[9:, 12:15] = turned @ skew(own), turned @ R.T, skew(lever) - middle_s * skew(own)
        J[9:, SCALE], J[9:, LEVER] = -middle_s * acceleration, -skew(rate)
        P = J @ covariance @ J.T
        P[6:, 6:] += np.diag(_UNEVEN**2)
        return MotionState(scan.stamp, T_world_lidar, np.concatenate([rate, translation]), P)

    def _compare(self, knot: Knot, mapped: MappedScan) -> None:
        last = self._window.last
        assert last is not None
        turn = last.T_nav_imu[:3, :3].T @ knot.T_nav_imu[:3, :3]
        moved = last.T_world_lidar[:3, :3].T @ mapped.state.T_world_lidar[:3, :3]
        self._turns += 1
        self._angles2 += float(rotation_angle(turn)) ** 2
        self._differences2 += float(rotation_angle(turn.T @ moved)) ** 2


def _root_of(information: FloatArray) -> FloatArray:
    """(6, 6) square root of a registered pose's information, with the errors that no registration reports."""
    added = np.linalg.solve(np.eye(6) + information * _REGISTRATION**2, information)
    values, vectors = np.linalg.eigh(0.5 * (added + added.T))
    # In the order of a restored array: products would round otherwise.
    return np.ascontiguousarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T, dtype=np.float64)


def _sweep(scan: Scan) -> tuple[float, float]:
    """Begin and end of a sweep from its stamp, seconds; zero where its points have no times."""
    if scan.time_offsets is None or not len(scan):
        return 0.0, 0.0
    return min(0.0, float(scan.time_offsets.min())), max(0.0, float(scan.time_offsets.max()))
