"""RKO-LIO, LiDAR-inertial odometry; the only file that imports it.

It moves every point to the end of the sweep with the IMU: a pose belongs to the end of its sweep. Sweeps without times
count as measured at one instant.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from lidarslam.compare.peers.interface import MAX_RANGE_M, Poses, Sweep
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples


class RkoLioEstimator:
    """RKO-LIO behind the protocol of peers; its base frame is that of the LiDAR."""

    def __init__(self, imu: ImuSamples, range_m: float = MAX_RANGE_M) -> None:
        from rko_lio.config import LIOConfig
        from rko_lio.lio import LIO

        self._T_lidar_imu = np.eye(4) if imu.T_lidar_imu is None else imu.T_lidar_imu
        self._lio: Any = LIO(LIOConfig(voxel_size=range_m / MAX_RANGE_M, max_range=range_m))
        self._poses: list[tuple[float, FloatArray]] = []

    def add_imu(self, samples: ImuSamples, number: int) -> None:
        """Take the sample with this number."""
        self._lio.add_imu_measurement(
            samples.accelerations[number],
            samples.angular_velocities[number],
            _nanoseconds(samples.stamps[number]),
            self._T_lidar_imu,
        )

    def load(self, sweep: Sweep) -> Callable[[], None]:
        """The registration, still to be called; the library leaves out a sweep that it cannot use."""
        from rko_lio.rko_lio_pybind import InputError

        offsets = sweep.scan.time_offsets
        seconds = np.full(len(sweep.scan), sweep.start) if offsets is None else sweep.scan.stamp + offsets
        times = np.rint(1e9 * seconds).astype(np.int64)

        def register() -> None:
            try:
                self._lio.register_scan(sweep.scan.points, times, np.eye(4))
            except InputError:
                return
            self._poses.append((sweep.end, self._lio.pose()))

        return register

    def finish(self) -> Poses:
        """The poses at the ends of the sweeps."""
        return Poses(
            np.array([instant for instant, _ in self._poses]),
            np.array([pose for _, pose in self._poses]).reshape(-1, 4, 4),
        )


def _nanoseconds(seconds: float) -> int:
    return round(1e9 * seconds)
