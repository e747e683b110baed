"""A sequence of MulRan (Kim et al., ICRA 2020): `Ouster/*.bin`, `global_pose.csv`, `xsens_imu.csv`.

A scan is 64 x 1024 points of x, y, z and intensity, one column of 64 lasers after the other, with zeros where there
was no return; the LiDAR turns ten times a second. The poses are those of the car's base in UTM coordinates.
"""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import inverse, make_transform, orthonormalize
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import NO_POINT_TIME, Faults
from lidarslam.datasets.folders.scan_files import read_bin
from lidarslam.datasets.imu_samples import usable_samples
from lidarslam.datasets.published.stamped_files import increasing, read_table, stamped_scans
from lidarslam.datasets.stored_recording import FileRecording
from lidarslam.datasets.times.point_time import PointTimeModel

SCANS = "Ouster"
_LASERS, _COLUMNS, _SWEEP_S = 64, 1024, 0.1
# The data set's calib_base2ouster.txt: metres, and roll, pitch, yaw in degrees.
_T_BASE_LIDAR = make_transform(
    Rotation.from_euler("xyz", [0.0001, 0.0003, 179.6654], degrees=True).as_matrix(), [1.7042, -0.021, 1.8047]
)
# Stamp, quaternion, Euler angles, angular velocity, acceleration, magnetic field; the first sequences lack the last.
_IMU_COLUMNS = 17
_ANGULAR_VELOCITY, _ACCELERATION = slice(8, 11), slice(11, 14)
_NS = 1e-9


class MulRanRecording(FileRecording):
    """One sequence: the folder, such as KAIST01, with Ouster in it."""

    reader = "mulran"
    imu_name = "xsens_imu.csv"

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        files, stamps = stamped_scans(folder / SCANS)
        super().__init__(folder, config, files)
        self.stamps = stamps

    def _beside(self, name: str) -> Path | None:
        places = (self._source, self._source / "sensor_data")
        return next((place / name for place in places if (place / name).is_file()), None)

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar by global_pose.csv; the world is the LiDAR's frame at the first of its poses."""
        path = self._truth_path()
        if path is None:
            return None
        rows = read_table(path, 13)
        if not len(rows):
            return None
        bottom = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1))
        T_utm_base = orthonormalize(np.hstack([rows[:, 1:], bottom]).reshape(-1, 4, 4))
        T_utm_lidar = T_utm_base @ _T_BASE_LIDAR
        return increasing(_NS * rows[:, 0], inverse(T_utm_lidar[0]) @ T_utm_lidar)

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The samples of xsens_imu.csv; where the unit is on the car is not published."""
        path = self._beside(self.imu_name)
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
        if len(rows) == _LASERS * _COLUMNS and self._config.time_reference != "none":
            number = np.arange(len(rows))
            offsets, rings = _SWEEP_S / _COLUMNS * (number // _LASERS), number % _LASERS
        elif self._config.time_reference != "none":
            faults.note(NO_POINT_TIME, str(self._files[index]))
        return Scan.from_raw(rows[:, :3], self.stamps[index], offsets, rings, rows[:, 3])

    def _truth_path(self) -> Path | None:
        return self._beside("global_pose.csv")

    def _point_time_model(self) -> PointTimeModel | None:
        return None if self._config.time_reference == "none" else PointTimeModel("column", "s", "relative")

    def _notes(self) -> Iterator[str]:
        yield "A scan's name is taken for the start of its sweep; the data set does not say which instant it is."


open_recording = MulRanRecording
