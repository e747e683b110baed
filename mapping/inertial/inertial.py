"""An IMU's part in scan-to-map registration: the prior of a scan's turn and attitude, and what that needs to know."""

from dataclasses import replace
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, log, make_transform, rotation_angle
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.state.stateful import Shape, Stateful
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.inertial.bias import BiasFilter
from lidarslam.mapping.inertial.gravity import GravityFilter, Station, Velocity
from lidarslam.mapping.inertial.gyroscope import Gyroscope, Integral
from lidarslam.mapping.motion.prediction import GravityDirection, MotionState, Prior
from lidarslam.mapping.tracking.mapped_scan import MappedScan

# Standard deviation of a translation that only goes on as before: the mapper's own process noise decides.
_ANY_TRANSLATION_M = 10.0
# Smoothing of the velocity between poses: without, errors at the stamps of uncompensated sweeps would swing.
_SMOOTHING = 0.5
_STEPS = 40
# The turns of IMU and LiDAR disagree when they differ by more than this share, and by more than registration does.
_FEWEST_TURNS, _MOST_DIFFERENT, _REGISTRATION_ERROR = 50, 0.2, np.deg2rad(0.15)


class Inertial(Stateful):
    """Follows the registered scans, and predicts the next.

    Args:
        samples: of the IMU.
        T_lidar_imu: (4, 4) extrinsic calibration.
        config: of the mapping.
    """

    _bias: BiasFilter
    _gravity: GravityFilter
    _last: MotionState | None
    _velocity: Annotated[FloatArray, Shape(3)]  # translation between the last poses, body frame, m/s
    _direction: GravityDirection | None
    # of the turns that were compared: how many, and the sums of squares of their angles and of the differences
    _turns: int
    _angles2: float
    _differences2: float

    def __init__(self, samples: ImuSamples, T_lidar_imu: FloatArray, config: MappingConfig) -> None:
        self._config = config
        self._lever = T_lidar_imu[:3, 3]
        self.gyroscope = Gyroscope(samples, T_lidar_imu[:3, :3])
        self._force = Integral(samples.stamps, samples.accelerations @ T_lidar_imu[:3, :3].T)
        self._bias, self._gravity = BiasFilter(), GravityFilter()
        self._last, self._velocity, self._direction = None, np.zeros(3), None
        self._turns, self._angles2, self._differences2 = 0, 0.0, 0.0

    @property
    def disagreement(self) -> str | None:
        """A warning where the turns of IMU and LiDAR disagree: its mounting or its clock is wrong; None else."""
        differences2 = self._differences2 - self._turns * _REGISTRATION_ERROR**2
        if self._turns < _FEWEST_TURNS or differences2 < _MOST_DIFFERENT**2 * self._angles2:
            return None
        percent = 100.0 * np.sqrt(differences2 / self._angles2)
        return f"the turns that IMU and LiDAR measured differ by {percent:.0f} %: the IMU's mounting or clock is wrong"

    @property
    def direction(self) -> GravityDirection | None:
        """Gravity as measured with the last scan, in its LiDAR frame; None where nothing was."""
        return self._direction

    def prior(self, scan: Scan, prior: Prior) -> Prior:
        """The odometry's prior of a scan, fused with the turn that the gyroscope measured; with gravity, if known."""
        last, translation = self._last, self._velocity if prior.velocity is None else prior.velocity[3:]
        rate = self.gyroscope.mean_rate(scan)
        velocity = prior.velocity if rate is None else np.concatenate([rate - self._bias.bias, translation])
        if last is None or not self.gyroscope.covers(last.stamp, scan.stamp):
            return replace(prior, velocity=velocity)
        turn, covariance = self._turn(last.stamp, scan.stamp)
        gravity = None if self._direction is None else self._direction.turned(turn)
        if prior.T_prev_curr is None:
            rotation = log(make_transform(turn, np.zeros(3)))[:3]
            moved = exp(np.concatenate([rotation, self._velocity * (scan.stamp - last.stamp)]))
            unmoved = _without_translation(covariance) / self._config.prior_caution**2
            return Prior(moved, velocity, unmoved, gravity, turn_is_measured=True)
        # The mapper's caution is meant for the odometry, whose errors repeat; the filter follows the gyroscope's.
        own = prior.motion_covariance(self._config)
        fused, covariance = fuse_turn(prior.T_prev_curr, own, turn, covariance)
        return Prior(fused, velocity, covariance / self._config.prior_caution**2, gravity, turn_is_measured=True)

    def update(self, scan: Scan, mapped: MappedScan) -> None:
        """Take the result of a scan: bias, velocity and gravity follow it."""
        last, state = self._last, mapped.state
        follows = last is not None and mapped.registered and mapped.is_connected
        covered = last is not None and self.gyroscope.covers(last.stamp, scan.stamp)
        self._last, self._direction = state, None
        if last is None or not follows or not covered:
            self._bias.restart(state.T_world_lidar[:3, :3] if mapped.registered or last is None else None)
            if last is not None and not mapped.is_connected:
                self._gravity.forget()
            self._direction = self._gravity.registered(self._station(state, None))
            return
        turn, _ = self._turn(last.stamp, scan.stamp)
        interval_s = scan.stamp - last.stamp
        self._bias.turned(turn, interval_s, self.gyroscope.change(last.stamp, scan.stamp))
        self._bias.registered(state.T_world_lidar[:3, :3], state.covariance[:3, :3])
        T_last_now = inverse(last.T_world_lidar) @ state.T_world_lidar
        self._velocity = (1.0 - _SMOOTHING) * self._velocity + _SMOOTHING * log(T_last_now)[3:] / interval_s
        self._turns += 1
        self._angles2 += float(rotation_angle(turn)) ** 2
        self._differences2 += float(rotation_angle(turn.T @ T_last_now[:3, :3])) ** 2
        since = self._integrated(last.stamp, scan.stamp)
        self._direction = self._gravity.registered(self._station(state, since))

    def _turn(self, first_s: float, last_s: float) -> tuple[FloatArray, FloatArray]:
        """The measured turn (3, 3) between two stamps and its covariance (3, 3)."""
        turn = self.gyroscope.turn(first_s, last_s, self._bias.bias)
        change = self.gyroscope.change(first_s, last_s)
        return turn, self._bias.turn_covariance(turn, last_s - first_s, change)

    def _station(self, state: MotionState, since: Velocity | None) -> Station:
        R = state.T_world_lidar[:3, :3]
        return Station(state.stamp, R, state.T_world_lidar[:3, 3] + R @ self._lever, since)

    def _integrated(self, first_s: float, last_s: float) -> Velocity:
        """The specific force between two stamps."""
        instants = np.linspace(first_s, last_s, _STEPS + 1)
        rotations = self.gyroscope.rotations(instants, self._bias.bias)
        changes = self._force.between(instants)
        turned = np.einsum("nij,nj->ni", 0.5 * (rotations[:-1] + rotations[1:]), changes)
        middles = 0.5 * (instants[:-1] + instants[1:]) - first_s
        return Velocity(last_s - first_s, turned.sum(axis=0), middles @ turned, rotations[_STEPS // 2])


def fuse_turn(
    T_prev_curr: FloatArray, covariance: FloatArray, turn: FloatArray, turn_covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A motion (4, 4) and an independent measurement (3, 3) of its rotation, weighted by their information.

    The translation follows the rotation as the motion's covariance (6, 6) has it. Errors are from the right.
    """
    innovation = log(make_transform(T_prev_curr[:3, :3].T @ turn, np.zeros(3)))[:3]
    gain = np.linalg.solve(covariance[:3, :3] + turn_covariance, covariance[:3]).T
    fused = covariance - gain @ covariance[:3]
    return T_prev_curr @ exp(gain @ innovation), np.asarray(0.5 * (fused + fused.T), dtype=np.float64)


def _without_translation(rotation: FloatArray) -> FloatArray:
    """(6, 6) of a motion of which only the rotation is known."""
    covariance = _ANY_TRANSLATION_M**2 * np.eye(6)
    covariance[:3, :3] = rotation
    return covariance
