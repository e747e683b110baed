"""KITTI's calibration files: lines `name: numbers`."""

from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.files import bounded_lines
from lidarslam.core.geometry import FloatArray, make_transform, orthonormalize


def read_calibration(path: Path) -> dict[str, FloatArray]:
    """The arrays of a calibration file by name; lines without numbers, such as the date, are left out.

    Raises:
        InputError: the file cannot be read.
    """
    arrays = {}
    for line in bounded_lines(path):
        name, _, values = line.partition(":")
        try:
            arrays[name.strip()] = np.array([float(word) for word in values.split()])
        except ValueError:
            continue
    return arrays


def _entry(path: Path, arrays: dict[str, FloatArray], name: str, count: int) -> FloatArray:
    values = arrays.get(name)
    if values is None or len(values) != count or not np.isfinite(values).all():
        got = "no such line" if values is None else f"{len(values)} numbers"
        raise InputError(f"{path}: expected a line `{name}:` with {count} numbers, got {got}")
    return values


def _rigid(path: Path, R: FloatArray, t: FloatArray) -> FloatArray:
    """The transform (4, 4), re-orthonormalised: the files round to seven digits or fewer."""
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0.0:
        raise InputError(f"{path}: holds a rotation matrix that is none; expected orthonormal rows, right-handed")
    return orthonormalize(make_transform(R, t))


def read_tr(path: Path) -> FloatArray:
    """T_cam_lidar (4, 4) of the odometry benchmark's calib.txt, its line `Tr` or `Tr_velo_to_cam`.

    Raises:
        InputError: the file cannot be read or has no such line.
    """
    arrays = read_calibration(path)
    name = "Tr_velo_to_cam" if "Tr" not in arrays and "Tr_velo_to_cam" in arrays else "Tr"
    rows = _entry(path, arrays, name, 12).reshape(3, 4)
    return _rigid(path, rows[:, :3], rows[:, 3])


def read_raw_calibration(path: Path) -> FloatArray:
    """The transform (4, 4) of a raw calibration file: T_B_A of calib_A_to_B.txt, T_rect_cam of calib_cam_to_cam.txt.

    Raises:
        InputError: the file cannot be read or lacks a line.
    """
    arrays = read_calibration(path)
    if path.name == "calib_cam_to_cam.txt":
        return _rigid(path, _entry(path, arrays, "R_rect_00", 9).reshape(3, 3), np.zeros(3))
    return _rigid(path, _entry(path, arrays, "R", 9).reshape(3, 3), _entry(path, arrays, "T", 3))
