"""KISS-SLAM; the only file that imports it.

Its odometry is KISS-ICP with motion compensation: a pose belongs to the end of its sweep, but for the first two, which
come before any motion is known, stay smeared over the sweep and belong to its middle.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from lidarslam.compare.peers.interface import MAX_RANGE_M, Poses, Sweep
from lidarslam.core.imu import ImuSamples


class KissSlamEstimator:
    """KISS-SLAM behind the protocol of peers."""

    def __init__(self, range_m: float = MAX_RANGE_M) -> None:
        from kiss_slam.config import load_config
        from kiss_slam.slam import KissSLAM

        config: Any = load_config(None)
        config.odometry.preprocessing.max_range = range_m
        config.odometry.mapping.voxel_size *= range_m / MAX_RANGE_M
        config.local_mapper.voxel_size *= range_m / MAX_RANGE_M
        self._slam: Any = KissSLAM(config)
        self._instants: list[float] = []

    def add_imu(self, samples: ImuSamples, number: int) -> None:
        """It uses no IMU."""

    def load(self, sweep: Sweep) -> Callable[[], None]:
        """The registration, still to be called."""
        offsets = np.empty(0) if sweep.is_compensated else sweep.scan.time_offsets
        self._instants.append(sweep.end if len(self._instants) >= 2 else sweep.middle)
        return lambda: self._slam.process_scan(sweep.scan.points, offsets)

    def finish(self) -> Poses:
        """The poses after the last optimisation of the graph, as its own pipeline takes them."""
        self._slam.generate_new_node()
        self._slam.local_map_graph.erase_last_local_map()
        poses, _ = self._slam.fine_grained_optimization()
        return Poses(np.array(self._instants), np.array(poses))
