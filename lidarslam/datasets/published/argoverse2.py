"""Argoverse 2, Sensor and LiDAR data sets: the sweeps of one log, two stacked 32-beam LiDARs in one.

Points are published in the vehicle's frame at the rear axle, compensated to the sweep's stamp. Here they are in the
frame of the upper LiDAR, from where rings and elevations are those of a sensor.
"""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.files import reading
from lidarslam.core.geometry import FloatArray, inverse, transform_points
from lidarslam.core.plugins import require_library
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.point_table import PointField
from lidarslam.datasets.published.stamped_files import increasing, poses_wxyz
from lidarslam.datasets.recording import FileRecording, first_file

_NANOSECOND = 1e-9
_POINT = ("x", "y", "z", "intensity", "laser_number")
_POSITION, _QUATERNION = ("tx_m", "ty_m", "tz_m"), ("qw", "qx", "qy", "qz")
_SENSOR = "up_lidar"


class Argoverse2Recording(FileRecording):
    """One log: the folder with sensors/lidar."""

    reader = "argoverse-2"
    _notes = ("The scans are motion compensated by the publishers; their per-point times are not needed.",)

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        files = sorted((folder / "sensors" / "lidar").glob("*.feather"), key=lambda path: path.stem.zfill(20))
        if not files:
            raise InputError(f"{folder}: holds no sweep sensors/lidar/*.feather; give the folder of one log")
        if wrong := next((path for path in files if not path.stem.isdecimal()), None):
            raise InputError(f"{wrong}: expected a name that is the sweep's stamp in nanoseconds; move it away")
        super().__init__(folder, config, files)
        self.stamps = np.array([int(path.stem) for path in files]) * _NANOSECOND
        self._truth_path = first_file((folder,), "city_SE3_egovehicle.feather")
        self._calibration = folder / "calibration" / "egovehicle_SE3_sensor.feather"
        if not self._calibration.is_file():
            self.warnings = (
                "There is no calibration/egovehicle_SE3_sensor.feather; points and poses are in the vehicle's frame,"
                " not that of the upper LiDAR.",
            )

    @property
    def name(self) -> str:
        """Such as argoverse2_02678d04."""
        return f"argoverse2_{self._source.resolve().name.partition('-')[0]}"

    @cached_property
    def _T_ego_lidar(self) -> FloatArray:
        path = self._calibration
        if not path.is_file():
            return np.eye(4)
        sensors = _read_columns(path, ("sensor_name", *_POSITION, *_QUATERNION))
        rows = np.flatnonzero(sensors["sensor_name"] == _SENSOR)
        if len(rows) != 1:
            raise InputError(f"{path}: expected one row of {_SENSOR}, got {len(rows)}; download it again")
        T_ego_lidar: FloatArray = _poses(path, sensors)[rows[0]]
        return T_ego_lidar

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar at the vehicle's poses, more than there are sweeps."""
        path = self._truth_path
        if path is None:
            return None
        table = _read_columns(path, ("timestamp_ns", *_POSITION, *_QUATERNION))
        stamps, T_world_ego = table["timestamp_ns"].astype(np.float64) * _NANOSECOND, _poses(path, table)
        order = np.argsort(stamps, kind="stable")
        return increasing(stamps[order], T_world_ego[order] @ self._T_ego_lidar)

    def _read(self, index: int, faults: Faults) -> Scan:  # noqa: ARG002
        table = _read_columns(self._files[index], _POINT)
        points = np.column_stack([table[axis].astype(np.float64) for axis in "xyz"])
        missing = ~points.any(axis=1)
        points = transform_points(inverse(self._T_ego_lidar), points)
        points[missing] = 0.0
        stamp = float(self.stamps[index])
        return Scan.from_raw(points, stamp, rings=table["laser_number"], intensities=table["intensity"])

    def _fields(self, index: int) -> tuple[PointField, ...]:
        table = _read_columns(self._files[index], _POINT)
        return tuple(PointField(name, str(values.dtype)) for name, values in table.items())


open_recording = Argoverse2Recording


def _read_columns(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    feather = require_library("pyarrow.feather", "Argoverse 2 needs", "pip install 'lidarslam[datasets]'")
    with reading(path, "cannot be read", "download it again"):
        table = feather.read_table(path, columns=list(names))
        return {name: table.column(name).to_numpy() for name in names}


def _poses(path: Path, table: dict[str, NDArray[Any]]) -> FloatArray:
    positions, quaternions = (np.column_stack([table[name] for name in names]) for names in (_POSITION, _QUATERNION))
    return poses_wxyz(path, positions, quaternions)
