"""The rotation of an IMU against the LiDAR, from the turns that both measured."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, log, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.mapping.inertial.gyroscope import Gyroscope

# Turns are compared over this time: long beside the errors of a registered attitude.
_SPAN_S = 0.5
# The rotation is observable when its worst axis is this certain.
_MOST_SIGMA = np.deg2rad(1.0)
# Error of a turn at least, radians; and turns agree when what remains is at most this share of them.
_LEAST_ERROR, _MOST_REMAINING = np.deg2rad(0.1), 0.3
_FEWEST = 20


class MountingError(ValueError):
    """The rotation is not observable by the turns; the message has the reason."""


@dataclass(frozen=True, eq=False)
class Mounting:
    """A rotation that was found."""

    R_lidar_imu: FloatArray  # (3, 3)
    bias: FloatArray  # (3,) of the gyroscope in the IMU's axes, rad/s
    sigma: float  # standard deviation about the worst axis, radians


class Turns:
    """Pairs of rotation vectors of the same times, of LiDAR and IMU, each in its own frame."""

    def __init__(self, samples: ImuSamples) -> None:
        self._gyroscope = Gyroscope(samples, np.eye(3))
        self._first: tuple[float, FloatArray] | None = None
        self.lidar: list[FloatArray] = []
        self.imu: list[FloatArray] = []
        self.spans_s: list[float] = []

    def add(self, stamp: float, R_world_lidar: FloatArray, is_connected: bool) -> None:
        """Take a registered attitude (3, 3); one that does not follow from those before begins anew."""
        if self._first is None or not is_connected:
            self._first = (stamp, R_world_lidar)
            return
        begin, R_world_begin = self._first
        if stamp - begin < _SPAN_S:
            return
        self._first = (stamp, R_world_lidar)
        if self._gyroscope.covers(begin, stamp):
            self.lidar.append(_vector(R_world_begin.T @ R_world_lidar))
            self.imu.append(_vector(self._gyroscope.turn(begin, stamp, np.zeros(3))))
            self.spans_s.append(stamp - begin)


def find_mounting(turns: Turns) -> Mounting:
    """The rotation between both frames, with the gyroscope's bias (Wahba's problem, by SVD).

    Raises:
        MountingError: the turns are too few, about one axis only, or do not agree.
    """
    if len(turns.lidar) < _FEWEST:
        raise MountingError(f"only {len(turns.lidar)} turns could be compared")
    lidar, imu, spans = np.array(turns.lidar), np.array(turns.imu), np.array(turns.spans_s)[:, None]
    # A constant bias is in the mean of all turns, as far as they took equally long.
    a, b = lidar - spans * (lidar.sum(axis=0) / spans.sum()), imu - spans * (imu.sum(axis=0) / spans.sum())
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    remaining = a - b @ R.T
    error = max(_LEAST_ERROR, float(np.sqrt((remaining**2).mean())))
    information = np.eye(3) * float((a**2).sum()) - a.T @ a
    sigma = error / float(np.sqrt(max(np.linalg.eigvalsh(information)[0], 1e-12)))
    if sigma > _MOST_SIGMA:
        raise MountingError(
            f"it turns too little, or about one axis only: uncertain by {min(180.0, np.rad2deg(sigma)):.0f} degrees"
        )
    if np.sqrt((remaining**2).sum() / (a**2).sum()) > _MOST_REMAINING:
        raise MountingError("the turns of LiDAR and IMU do not agree: different clocks, or axes of another kind")
    bias = (imu - lidar @ R).sum(axis=0) / spans.sum()
    return Mounting(np.asarray(R, dtype=np.float64), np.asarray(bias, dtype=np.float64), sigma)


def _vector(R: FloatArray) -> FloatArray:
    return log(make_transform(R, np.zeros(3)))[:3]
