"""The direction of gravity from an accelerometer and registered poses.

The second difference of three positions `T` apart is the acceleration between them under a triangular weight; what the
accelerometer shows beyond it, turned into the world by the registered attitudes, is gravity. The poses need not be
differentiated, and the turns of the sensor separate the accelerometer's bias from gravity.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state.stateful import Shape, Stateful
from lidarslam.mapping.motion.prediction import GravityDirection

STANDARD = 9.81  # m/s^2
_NORM_SIGMA = 0.03
# Half of the time that a measurement spans: long, so that errors of the positions matter little.
_HALF_S = 1.0
# Standard deviations of a consumer's accelerometer: its bias, m/s^2, and the walk of that, m/s^2/sqrt(s).
_FIRST_BIAS, _WALK = 0.1, 1e-3
# Errors of registered positions and attitudes against one another within the span: metres, radians.
_POSITION_M, _ATTITUDE = 0.006, np.deg2rad(0.1)
# Error of its scale, and of the time: a share of the acceleration of the sensor.
_SCALE = 0.02
# Innovations beyond so many deviations count less.
_MOST_SQUARED = 9.0


@dataclass(frozen=True, eq=False)
class Velocity:
    """Specific force integrated between two scans, in the LiDAR frame of the first.

    Its moments are about the first scan's stamp.
    """

    interval_s: float
    change: Annotated[FloatArray, Shape(3)]  # integral of the force, m/s
    moment: Annotated[FloatArray, Shape(3)]  # integral of the force times the time, m
    attitude: Annotated[FloatArray, Shape(3, 3)]  # R_first_middle


@dataclass(frozen=True, eq=False)
class Station:
    """A registered pose of the IMU: rotation of the LiDAR, position of the IMU, and the way there."""

    stamp: float
    R_world_lidar: Annotated[FloatArray, Shape(3, 3)]
    position: Annotated[FloatArray, Shape(3)]
    since: Velocity | None  # since the station before; None at the first


class GravityFilter(Stateful):
    """Gravity in the world and the accelerometer's bias, with their covariance."""

    _stations: list[Station]  # of the latest span
    _gravity: Annotated[FloatArray, Shape(3)] | None  # upwards in the world, m/s^2
    _bias: Annotated[FloatArray, Shape(3)]  # in the LiDAR's axes
    _covariance: Annotated[FloatArray, Shape(6, 6)]
    _measured_s: float | None

    def __init__(self) -> None:
        self._stations, self._gravity, self._bias, self._measured_s = [], None, np.zeros(3), None
        self._covariance = np.diag([STANDARD**2] * 3 + [_FIRST_BIAS**2] * 3)

    def forget(self) -> None:
        """Poses to come are not connected with those before; the bias stays."""
        self._stations, self._gravity, self._measured_s = [], None, None
        covariance = np.diag([STANDARD**2] * 3 + [0.0] * 3)
        covariance[3:, 3:] = self._covariance[3:, 3:]
        self._covariance = covariance

    def registered(self, station: Station) -> GravityDirection | None:
        """Take the next pose; a measurement in its frame when a span is complete."""
        if station.since is None:
            self._stations = []
        self._stations.append(station)
        begin = station.stamp - 2.0 * _HALF_S
        while len(self._stations) > 1 and self._stations[1].stamp <= begin + 1e-6:
            self._stations.pop(0)
        complete = self._stations[0].stamp <= begin + 1e-6 and len(self._stations) > 2
        if not complete or (self._measured_s is not None and station.stamp - self._measured_s < _HALF_S - 1e-6):
            return None
        elapsed_s = 0.0 if self._measured_s is None else station.stamp - self._measured_s
        self._measured_s = station.stamp
        self._covariance[3:, 3:] += elapsed_s * _WALK**2 * np.eye(3)
        return self._measure(*_gravity(self._stations), station.R_world_lidar)

    def _measure(
        self, measured: FloatArray, attitude: FloatArray, sigma: float, R_world_lidar: FloatArray
    ) -> GravityDirection | None:
        """Update with gravity and bias (3,) in the world, turned by the mean attitude (3, 3) of the span."""
        first = self._gravity is None
        gravity = measured if self._gravity is None else self._gravity
        H = np.hstack([np.eye(3), attitude])
        innovation = measured - gravity - attitude @ self._bias
        S = H @ self._covariance @ H.T + sigma**2 * np.eye(3)
        squared = float(innovation @ np.linalg.solve(S, innovation))
        S += max(0.0, squared / _MOST_SQUARED - 1.0) * sigma**2 * np.eye(3)
        direction = R_world_lidar.T @ (measured - attitude @ self._bias)
        result = GravityDirection(
            direction / np.linalg.norm(direction),
            gravity / np.linalg.norm(gravity),
            np.asarray(R_world_lidar.T @ S @ R_world_lidar / STANDARD**2, dtype=np.float64),
        )
        gravity = self._update(H, innovation, S, gravity)
        # The length of gravity is known.
        norm = float(np.linalg.norm(gravity))
        H = np.concatenate([gravity / norm, np.zeros(3)])[None]
        S = H @ self._covariance @ H.T + _NORM_SIGMA**2
        self._gravity = self._update(H, np.array([STANDARD - norm]), S, gravity)
        return None if first else result

    def _update(self, H: FloatArray, innovation: FloatArray, S: FloatArray, gravity: FloatArray) -> FloatArray:
        gain = np.linalg.solve(S, H @ self._covariance).T
        step = gain @ innovation
        self._bias = self._bias + step[3:]
        covariance = self._covariance - gain @ H @ self._covariance
        self._covariance = 0.5 * (covariance + covariance.T)
        return np.asarray(gravity + step[:3], dtype=np.float64)


def _gravity(stations: list[Station]) -> tuple[FloatArray, FloatArray, float]:
    """Gravity (3,) in the world with the bias, the mean attitude (3, 3) of the bias, and the standard deviation."""
    begin, end = stations[0], stations[-1]
    row = int(np.argmin([abs(2.0 * station.stamp - begin.stamp - end.stamp) for station in stations[1:-1]])) + 1
    middle = stations[row]
    rise_s, fall_s = middle.stamp - begin.stamp, end.stamp - middle.stamp
    force, attitude = np.zeros(3), np.zeros((3, 3))
    for n, (before, station) in enumerate(pairwise(stations)):
        since = station.since
        assert since is not None
        rises = n < row
        offset_s = before.stamp - begin.stamp if rises else end.stamp - before.stamp
        length_s, sign = (rise_s, 1.0) if rises else (fall_s, -1.0)
        force += before.R_world_lidar @ (offset_s * since.change + sign * since.moment) / length_s
        weight = (offset_s + 0.5 * sign * since.interval_s) / length_s * since.interval_s
        attitude += weight * before.R_world_lidar @ since.attitude
    difference = (end.position - middle.position) / fall_s - (middle.position - begin.position) / rise_s
    area = 0.5 * (end.stamp - begin.stamp)
    positions = np.sqrt(2.0 * (1.0 / fall_s**2 + 1.0 / rise_s**2 + 1.0 / (fall_s * rise_s))) * _POSITION_M / area
    scale = _SCALE * float(np.linalg.norm(difference)) / area
    sigma = float(np.sqrt(positions**2 + (STANDARD * _ATTITUDE) ** 2 + scale**2))
    return (force - difference) / area, attitude / area, sigma
