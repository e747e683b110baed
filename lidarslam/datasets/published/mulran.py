"""A sequence of MulRan (Kim et al., ICRA 2020): `Ouster/*.bin`, `global_pose.csv`, `xsens_imu.csv`.

A scan is 64 x 1024 points of x, y, z and intensity, one column of 64 lasers after the other, with zeros where there
was no return; the LiDAR turns ten times a second. The poses are those of the car's base in UTM coordinates.
"""

from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import inverse, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import NO_POINT_TIME, Faults
from lidarslam.datasets.folders.scan_files import read_bin
from lidarslam.datasets.imu_samples import usable_samples
from lidarslam.datasets.published.stamped_files import StampedRecording, increasing, poses_of_rows, read_table
from lidarslam.datasets.recording import first_file
from lidarslam.datasets.times.point_time import PointTimeModel

_LASERS, _COLUMNS, _SWEEP_S = 64, 1024, 0.1
# The data set's calib_base2ouster.txt: metres, and roll, pitch, yaw in degrees.
_T_BASE_LIDAR = make_transform(
    Rotation.from_euler("xyz", [0.0001, 0.0003, 179.6654], degrees=True).as_matrix(), [1.7042, -0.021, 1.8047]
)
# Stamp, quaternion, Euler angles, angular velocity, acceleration, magnetic field; the first sequences lack the last.
_IMU_COLUMNS = 17
_ANGULAR_VELOCITY, _ACCELERATION = slice(8, 11), slice(11, 14)
_NS = 1e-9


class MulRanRecording(StampedRecording):
    """One sequence: the folder, such as KAIST01, with Ouster in it."""

    reader = "mulran"
    scan_folder = "Ouster"
    imu_name = "xsens_imu.csv"
    point_time = PointTimeModel("column", "s", "relative")
    _notes = ("A scan's name is taken for the start of its sweep; the data set does not say which instant it is.",)

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        super().__init__(folder, config)
        self._folders = folder, folder / "sensor_data"
        self._truth_path = first_file(self._folders, "global_pose.csv")

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar by global_pose.csv; the world is the LiDAR's frame at the first of its poses."""
        rows = np.empty((0, 13)) if self._truth_path is None else read_table(self._truth_path, 13)
        if not len(rows):
            return None
        T_utm_lidar = poses_of_rows(rows[:, 1:]) @ _T_BASE_LIDAR
        return increasing(_NS * rows[:, 0], inverse(T_utm_lidar[0]) @ T_utm_lidar)

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The samples of xsens_imu.csv; where the unit is on the car is not published."""
        path = first_file(self._folders, self.imu_name)
        if path is None:
            return None
        with path.open(encoding="utf-8", errors="replace") as file:
            if file.readline().count(",") + 1 < _IMU_COLUMNS:
                return None  # of the first sequences: orientations alone
        rows = read_table(path, _IMU_COLUMNS)
        return usable_samples(_NS * rows[:, 0], rows[:, _ANGULAR_VELOCITY], rows[:, _ACCELERATION], None)

    def _read(self, index: int, faults: Faults) -> Scan:
        rows = read_bin(self._files[index])
        offsets = rings = None
        if self._point_time and len(rows) == _LASERS * _COLUMNS:
            number = np.arange(len(rows))
            offsets, rings = _SWEEP_S / _COLUMNS * (number // _LASERS), number % _LASERS
        elif self._point_time:
            faults.note(NO_POINT_TIME, str(self._files[index]))
        return Scan.from_raw(rows[:, :3], self.stamps[index], offsets, rings, rows[:, 3])


open_recording = MulRanRecording
