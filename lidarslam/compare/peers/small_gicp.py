"""small_gicp's scan-to-model odometry, as its own examples build it; the only file that imports the library.

GICP of a sweep thinned to one point in 0.25 m against a map of Gaussian voxels of 1 m, or less where the maximum range
is less than 100 m, from the last motion repeated.
Sweeps are registered as they are, without compensation of the motion: a pose belongs to the middle of its sweep.
"""

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from lidarslam.compare.peers.interface import MAX_RANGE_M, Poses, Sweep
from lidarslam.core.imu import ImuSamples

_DOWNSAMPLING_M, _VOXEL_M = 0.25, 1.0
_HORIZON, _CLEAR_CYCLE = 100, 10


class SmallGicpEstimator:
    """small_gicp behind the protocol of peers."""

    def __init__(self, range_m: float = MAX_RANGE_M) -> None:
        import small_gicp

        self._scale = range_m / MAX_RANGE_M
        self._map: Any = small_gicp.GaussianVoxelMap(self._scale * _VOXEL_M)
        self._map.set_lru(horizon=_HORIZON, clear_cycle=_CLEAR_CYCLE)
        self._threads = os.cpu_count() or 1
        self._instants: list[float] = []
        self._poses = [np.eye(4), np.eye(4)]  # the motion before the first scan is none

    def add_imu(self, samples: ImuSamples, number: int) -> None:
        """It uses no IMU."""

    def load(self, sweep: Sweep) -> Callable[[], None]:
        """The registration, still to be called."""
        import small_gicp

        self._instants.append(sweep.middle)

        def register() -> None:
            resolution_m = self._scale * _DOWNSAMPLING_M
            cloud, _ = small_gicp.preprocess_points(sweep.scan.points, resolution_m, num_threads=self._threads)
            before, last = self._poses[-2:]
            pose = last
            if self._map.size():
                # The library's poses are not exactly rigid.
                predicted = last @ np.linalg.inv(before) @ last
                pose = small_gicp.align(self._map, cloud, predicted, num_threads=self._threads).T_target_source
            self._map.insert(cloud, pose)
            self._poses.append(pose)

        return register

    def finish(self) -> Poses:
        """The poses at the middles of the sweeps."""
        return Poses(np.array(self._instants), np.array(self._poses[2:]))
