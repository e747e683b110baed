"""The GPS/IMU unit of a KITTI raw drive: one text file of 30 numbers for each camera image."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.trajectory import parse_numbers
from lidarslam.datasets.folders.scan_files import numbered_scans

_POLE_DEG = 90.0
_EARTH_RADIUS_M = 6378137.0  # WGS 84, equator, as KITTI's own development kit has it
_COLUMNS = 30
_POSITION_ACCURACY_COLUMN = 23
# Of the unit's own axes; the columns behind them are of the level ones.
_ACCELERATIONS, _ANGULAR_VELOCITIES = slice(11, 14), slice(17, 20)


class OxtsPoses(NamedTuple):
    """The unit's poses."""

    numbers: NDArray[np.intp]  # (N,) the row of the stamp file each pose belongs to
    T_enu_imu: FloatArray  # (N, 4, 4) in an east-north-up frame; imu is x forward, y left, z up
    accuracy_m: FloatArray  # (N,) standard deviation of the position as the unit itself states it
    angular_velocities: FloatArray  # (N, 3) rad/s
    accelerations: FloatArray  # (N, 3) specific force, m/s^2
    geodetic: FloatArray  # (N, 3) latitude and longitude in degrees, altitude in metres


def read_oxts(folder: Path) -> OxtsPoses:
    """Read `oxts/data` of a drive.

    Raises:
        InputError: there is no file, or one does not hold 30 numbers that begin with a latitude.
    """
    files, numbers = numbered_scans(folder, ".txt")
    tables = [parse_numbers(path, _COLUMNS) for path in files]
    for path, table in zip(files, tables, strict=True):
        if len(table) != 1 or not np.isfinite(table[0, :6]).all() or not abs(table[0, 0]) < _POLE_DEG:
            expected = f"one line of {_COLUMNS} numbers that begins with a latitude"
            raise InputError(f"{path}: expected {expected}, got {len(table)} lines; copy the file again")
    rows = np.concatenate(tables)
    accuracy_m = rows[:, _POSITION_ACCURACY_COLUMN]
    velocities, accelerations = rows[:, _ANGULAR_VELOCITIES], rows[:, _ACCELERATIONS]
    return OxtsPoses(numbers, oxts_poses(rows), accuracy_m, velocities, accelerations, rows[:, :3])


def oxts_poses(rows: FloatArray) -> FloatArray:
    """T_enu_imu (N, 4, 4) of rows (N, >=6): latitude, longitude (degrees), altitude (m), roll, pitch, yaw (radians).

    The position is the Mercator projection scaled by the cosine of the first latitude, so that metres are metres
    there; the rotation is Rz(yaw) Ry(pitch) Rx(roll), yaw counted from east (Geiger et al., IJRR 2013, and the
    raw development kit).
    """
    latitude, longitude = np.deg2rad(rows[:, 0]), np.deg2rad(rows[:, 1])
    scaled_radius = np.cos(latitude[0]) * _EARTH_RADIUS_M
    east = scaled_radius * longitude
    north = scaled_radius * np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
    R = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]).as_matrix()
    return make_transform(R, np.column_stack([east, north, rows[:, 2]]))
