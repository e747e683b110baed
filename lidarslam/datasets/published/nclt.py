"""A session of NCLT (Carlevaris-Bianco et al., IJRR 2016): `velodyne_sync/*.bin`, ground truth and `ms25.csv`.

Points are those of one turn in the frame of the robot's body, whose z axis points down, in steps of 5 mm. The LiDAR's
frame here is that of the HDL-32E's centre with the axes of the body turned by 180 degrees about x: x forward, y left,
z up. The world of the ground truth is turned likewise.
"""

from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse, make_transform, transform_points
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.folders.scan_files import read_bytes
from lidarslam.datasets.imu_samples import usable_samples
from lidarslam.datasets.point_table import fields_of
from lidarslam.datasets.published.stamped_files import StampedRecording, increasing, read_table
from lidarslam.datasets.recording import first_file

_POINT = np.dtype([("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("intensity", "u1"), ("laser", "u1")])
_STEP_M, _ORIGIN_M = 0.005, -100.0
# Places of the sensors in the frame of the body, from the data set's paper; the IMU has the body's axes.
_LIDAR_IN_BODY, _IMU_IN_BODY = np.array([0.002, -0.004, -0.957]), np.array([-0.11, -0.18, -0.71])
_UPRIGHT = make_transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
_T_BODY_LIDAR = make_transform(np.diag([1.0, -1.0, -1.0]), _LIDAR_IN_BODY)
_T_LIDAR_IMU = inverse(_T_BODY_LIDAR) @ make_transform(np.eye(3), _IMU_IN_BODY)
_US = 1e-6


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
        return increasing(_US * rows[:, 0], _UPRIGHT @ T_down_body @ _T_BODY_LIDAR)

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


open_recording = NcltRecording
