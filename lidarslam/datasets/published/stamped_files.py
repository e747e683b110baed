"""Data sets whose scans are named by their stamps: MulRan and NCLT; tables of numbers and poses.

MulRan (Kim et al., ICRA 2020): `Ouster/*.bin`, `global_pose.csv`, `xsens_imu.csv`. A scan is 64 x 1024 points of x, y,
z and intensity, one column of 64 lasers after the other, with zeros where there was no return; the LiDAR turns ten
times a second. The poses are those of the car's base in UTM coordinates.

NCLT (Carlevaris-Bianco et al., IJRR 2016): `velodyne_sync/*.bin`, ground truth and `ms25.csv`. Points are those of one
turn in the frame of the robot's body, whose z axis points down, in steps of 5 mm. The LiDAR's frame here is that of the
HDL-32E's centre with the axes of the body turned by 180 degrees about x: x forward, y left, z up. The world of the
ground truth is turned likewise.
"""

from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse, make_transform, orthonormalize, transform_points
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, parse_numbers
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import NO_POINT_TIME, Faults
from lidarslam.datasets.folders.scan_files import read_bin, read_bytes
from lidarslam.datasets.imu_samples import usable_samples
from lidarslam.datasets.point_table import fields_of
from lidarslam.datasets.recording import FileRecording, first_file
from lidarslam.datasets.times.point_time import PointTimeModel
from lidarslam.datasets.times.stamps import increasing_poses, stamps_from_names

# Of MulRan.
_LASERS, _COLUMNS, _SWEEP_S = 64, 1024, 0.1
# The data set's calib_base2ouster.txt: metres, and roll, pitch, yaw in degrees.
_T_BASE_LIDAR = make_transform(
    Rotation.from_euler("xyz", [0.0001, 0.0003, 179.6654], degrees=True).as_matrix(), [1.7042, -0.021, 1.8047]
)
# Stamp, quaternion, Euler angles, angular velocity, acceleration, magnetic field; the first sequences lack the last.
_IMU_COLUMNS = 17
_ANGULAR_VELOCITY, _ACCELERATION = slice(8, 11), slice(11, 14)
_NS = 1e-9
# Of NCLT.
_POINT = np.dtype([("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("intensity", "u1"), ("laser", "u1")])
_STEP_M, _ORIGIN_M = 0.005, -100.0
# Places of the sensors in the frame of the body, from the data set's paper; the IMU has the body's axes.
_LIDAR_IN_BODY, _IMU_IN_BODY = np.array([0.002, -0.004, -0.957]), np.array([-0.11, -0.18, -0.71])
_UPRIGHT = make_transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
_T_BODY_LIDAR = make_transform(np.diag([1.0, -1.0, -1.0]), _LIDAR_IN_BODY)
_T_LIDAR_IMU = inverse(_T_BODY_LIDAR) @ make_transform(np.eye(3), _IMU_IN_BODY)
_US = 1e-6


class StampedRecording(FileRecording):
    """A folder in which `scan_folder` holds .bin scans named by clock readings in micro- or nanoseconds."""

    scan_folder: str

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        scans = folder / self.scan_folder
        files = np.array([path for path in scans.glob("*.bin") if not path.name.startswith(".")], dtype=object)
        if not len(files):
            raise InputError(f"{scans}: holds no .bin scan; give the folder of one sequence, above it")
        stamps = stamps_from_names([path.stem for path in files])
        if stamps is None or len(np.unique(stamps)) < len(stamps):
            raise InputError(f"{scans}: expected scans named by their stamps, such as 1561000444390857630.bin")
        order = np.argsort(stamps)
        super().__init__(folder, config, list(files[order]))
        self.stamps = stamps[order]


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
        return increasing_poses(_NS * rows[:, 0], inverse(T_utm_lidar[0]) @ T_utm_lidar)

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


class NcltRecording(StampedRecording):
    """One session: the folder, such as 2012-01-08, with velodyne_sync in it."""

    reader = "nclt"
    scan_folder = "velodyne_sync"
    imu_name = "ms25.csv"
    _stored = fields_of(np.empty(0, _POINT))
    _notes = ("Points have no times in this layout. The body's axes are turned so that z points up.",)

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        super().__init__(folder, config)
        above = folder.resolve().parent
        self._truth_path = first_file((folder, above, above / "ground_truth"), f"groundtruth_{self.name}.csv")

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar; the world is the truth's with its z axis turned up."""
        if self._truth_path is None:
            return None
        rows = read_table(self._truth_path, 7)
        R_world_body = Rotation.from_euler("ZYX", rows[:, [6, 5, 4]]).as_matrix()
        T_down_body = make_transform(R_world_body, rows[:, 1:4])
        return increasing_poses(_US * rows[:, 0], _UPRIGHT @ T_down_body @ _T_BODY_LIDAR)

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The samples of ms25.csv: stamp, magnetic field, acceleration, angular velocity."""
        path = self._source / self.imu_name
        if not path.is_file():
            return None
        rows = read_table(path, 10)
        return usable_samples(_US * rows[:, 0], rows[:, 7:10], rows[:, 4:7], _T_LIDAR_IMU)

    def _read(self, index: int, faults: Faults) -> Scan:  # noqa: ARG002
        path = self._files[index]
        data = read_bytes(path)
        if len(data) % _POINT.itemsize:
            raise InputError(f"{path}: expected points of {_POINT.itemsize} bytes, got {len(data)}; copy it again")
        records = np.frombuffer(data, _POINT)
        in_body = _STEP_M * np.column_stack([records[axis] for axis in "xyz"]).astype(np.float64) + _ORIGIN_M
        points: FloatArray = transform_points(inverse(_T_BODY_LIDAR), in_body)
        return Scan.from_raw(points, self.stamps[index], None, records["laser"], records["intensity"])


def read_table(path: Path, columns: int) -> FloatArray:
    """The rows (N, columns) of a table whose numbers are all finite; the first column is a stamp."""
    table = parse_numbers(path, columns)
    return np.asarray(table[np.isfinite(table).all(axis=1)])


def poses_of_rows(numbers: FloatArray) -> FloatArray:
    """Transforms (..., 4, 4) of the twelve numbers (..., 12) of their first three rows, as files round them."""
    rows = numbers.reshape(*numbers.shape[:-1], 3, 4)
    return orthonormalize(make_transform(rows[..., :3], rows[..., 3]))
