"""KISS-SLAM, RKO-LIO and small_gicp behind the protocol of peers; the only file that imports them."""

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from lidarslam.compare.peers.interface import MAX_RANGE_M, Estimator, Poses, Sweep
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples

_DOWNSAMPLING_M, _VOXEL_M = 0.25, 1.0
_HORIZON, _CLEAR_CYCLE = 100, 10


def _scale(range_m: float | None) -> float:
    return 1.0 if range_m is None else range_m / MAX_RANGE_M


class KissSlamEstimator(Estimator):
    """KISS-SLAM: KISS-ICP with motion compensation, and a pose graph.

    A pose belongs to the end of its sweep, but for the first two, which come before any motion is known, stay smeared
    over the sweep and belong to its middle.
    """

    def __init__(self, _: Sweep, __: ImuSamples | None, range_m: float | None) -> None:
        from kiss_slam.config import load_config
        from kiss_slam.slam import KissSLAM

        config: Any = load_config(None)
        config.odometry.preprocessing.max_range = range_m or MAX_RANGE_M
        config.odometry.mapping.voxel_size *= _scale(range_m)
        config.local_mapper.voxel_size *= _scale(range_m)
        self._slam: Any = KissSLAM(config)
        self._instants: list[float] = []

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


class RkoLioEstimator:
    """RKO-LIO, LiDAR-inertial odometry; its base frame is that of the LiDAR.

    It moves every point to the end of the sweep with the IMU: a pose belongs to the end of its sweep. Sweeps without
    times count as measured at one instant.
    """

    def __init__(self, _: Sweep, imu: ImuSamples | None, range_m: float | None) -> None:
        from rko_lio.config import LIOConfig
        from rko_lio.lio import LIO

        self._T_lidar_imu = np.eye(4) if imu is None or imu.T_lidar_imu is None else imu.T_lidar_imu
        self._lio: Any = LIO(LIOConfig(voxel_size=_scale(range_m), max_range=range_m or MAX_RANGE_M))
        self._poses: list[tuple[float, FloatArray]] = []

    def add_imu(self, samples: ImuSamples, number: int) -> None:
        """Take the sample with this number."""
        self._lio.add_imu_measurement(
            samples.accelerations[number],
            samples.angular_velocities[number],
            round(1e9 * samples.stamps[number]),
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
        instants, poses = ([entry[part] for entry in self._poses] for part in (0, 1))
        return Poses(np.array(instants), np.array(poses).reshape(-1, 4, 4))


class SmallGicpEstimator(Estimator):
    """small_gicp's scan-to-model odometry, as its own examples build it.

    GICP of a sweep thinned to one point in 0.25 m against a map of Gaussian voxels of 1 m, or less where the maximum
    range is less than 100 m, from the last motion repeated. Sweeps are registered as they are, without compensation of
    the motion: a pose belongs to the middle of its sweep.
    """

    def __init__(self, _: Sweep, __: ImuSamples | None, range_m: float | None) -> None:
        import small_gicp

        self._scale = _scale(range_m)
        self._map: Any = small_gicp.GaussianVoxelMap(self._scale * _VOXEL_M)
        self._map.set_lru(horizon=_HORIZON, clear_cycle=_CLEAR_CYCLE)
        self._threads = os.cpu_count() or 1
        self._instants: list[float] = []
        self._poses = [np.eye(4), np.eye(4)]  # the motion before the first scan is none

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
