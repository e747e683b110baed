"""The gyroscope's bias, by a Kalman filter of the LiDAR's attitude and the bias."""

from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, log, make_transform
from lidarslam.core.state.stateful import Shape, Stateful

# White noise of a consumer's gyroscope, rad/s/sqrt(Hz); its bias at first, rad/s, and the walk of that, rad/s/sqrt(s).
_DENSITY, _FIRST_BIAS, _WALK = 5e-4, 0.02, 1e-4
# Error of its scale and axes, as a share of the turn; error of its clock, seconds.
_SCALE, _CLOCK_S = 0.001, 0.001
# No turn is more precise, radians.
_LEAST_TURN = np.deg2rad(0.03)
# No registered attitude is more precise, radians; innovations beyond so many deviations count less.
_LEAST_ATTITUDE = np.deg2rad(0.05)
_MOST_SQUARED = 9.0


class BiasFilter(Stateful):
    """Bias and attitude with their covariance.

    Registered attitudes are measurements of the attitude, not of turns: their errors are independent, those of turns
    between consecutive ones are not.
    """

    bias: Annotated[FloatArray, Shape(3)]  # rad/s, in the LiDAR's axes
    _R_world_lidar: Annotated[FloatArray, Shape(3, 3)] | None
    _covariance: Annotated[FloatArray, Shape(6, 6)]  # of the attitude's error, a turn from the right, and the bias

    def __init__(self) -> None:
        self.bias = np.zeros(3)
        self._R_world_lidar = None
        self._covariance = np.diag([_LEAST_ATTITUDE**2] * 3 + [_FIRST_BIAS**2] * 3)

    def turn_covariance(self, turn: FloatArray, interval_s: float, change: FloatArray) -> FloatArray:
        """(3, 3) of the error of a turn (3, 3) within an interval in which the rate changed by (3,), from the right."""
        noise = self._noise(turn, interval_s, change) + _LEAST_TURN**2 * np.eye(3)
        return np.asarray(noise + interval_s**2 * self._covariance[3:, 3:], dtype=np.float64)

    def turned(self, turn: FloatArray, interval_s: float, change: FloatArray) -> None:
        """Propagate by a turn (3, 3) that the gyroscope measured, without the bias."""
        if self._R_world_lidar is not None:
            self._R_world_lidar = self._R_world_lidar @ turn
        F = np.eye(6)
        F[:3, :3], F[:3, 3:] = turn.T, -interval_s * np.eye(3)
        Q = np.zeros((6, 6))
        Q[:3, :3] = self._noise(turn, interval_s, change)
        Q[3:, 3:] = interval_s * _WALK**2 * np.eye(3)
        self._covariance = F @ self._covariance @ F.T + Q

    def registered(self, R_world_lidar: FloatArray, covariance: FloatArray) -> None:
        """Update with a registered attitude (3, 3) and its covariance (3, 3)."""
        noise = covariance + _LEAST_ATTITUDE**2 * np.eye(3)
        if self._R_world_lidar is None:
            self.restart(R_world_lidar, noise)
            return
        innovation = log(make_transform(self._R_world_lidar.T @ R_world_lidar, np.zeros(3)))[:3]
        P = self._covariance
        squared = float(innovation @ np.linalg.solve(P[:3, :3] + noise, innovation))
        S = P[:3, :3] + max(1.0, squared / _MOST_SQUARED) * noise
        gain = np.linalg.solve(S, P[:3]).T
        step = gain @ innovation
        self._R_world_lidar = self._R_world_lidar @ _exp(step[:3])
        self.bias = self.bias + step[3:]
        covariance = P - gain @ P[:3]
        self._covariance = 0.5 * (covariance + covariance.T)

    def restart(self, R_world_lidar: FloatArray | None, noise: FloatArray | None = None) -> None:
        """Begin at an attitude (3, 3) with its covariance (3, 3), or at none: the bias stays."""
        self._R_world_lidar = R_world_lidar
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = np.eye(3) * _LEAST_ATTITUDE**2 if noise is None else noise
        covariance[3:, 3:] = self._covariance[3:, 3:]
        self._covariance = covariance

    def _noise(self, turn: FloatArray, interval_s: float, change: FloatArray) -> FloatArray:
        angle = log(make_transform(turn, np.zeros(3)))[:3]
        systematic = _SCALE**2 * (angle @ angle) + _CLOCK_S**2 * (change @ change)
        return np.asarray((_DENSITY**2 * abs(interval_s) + systematic) * np.eye(3), dtype=np.float64)


def _exp(vector: FloatArray) -> FloatArray:
    return exp(np.concatenate([vector, np.zeros(3)]))[:3, :3]
