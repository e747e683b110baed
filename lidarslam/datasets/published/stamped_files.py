"""Files that the data sets of cars and robots have in common: scans named by their stamps, tables, and poses."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.trajectory import Trajectory, parse_numbers
from lidarslam.datasets.times.stamps import increasing_rows, stamps_from_names


def stamped_scans(folder: Path) -> tuple[list[Path], FloatArray]:
    """The .bin files of a folder by their stamps, and the stamps (N,) in seconds.

    Raises:
        InputError: there is none, or a name is no clock reading in micro- or nanoseconds.
    """
    files = np.array([path for path in folder.glob("*.bin") if not path.name.startswith(".")], dtype=object)
    if not len(files):
        raise InputError(f"{folder}: holds no .bin scan; give the folder of one sequence, above it")
    stamps = stamps_from_names([path.stem for path in files])
    if stamps is None or len(np.unique(stamps)) < len(stamps):
        raise InputError(f"{folder}: expected scans named by their stamps, such as 1561000444390857630.bin")
    order = np.argsort(stamps)
    return list(files[order]), stamps[order]


def read_table(path: Path, columns: int) -> FloatArray:
    """The rows (N, columns) of a table whose numbers are all finite; the first column is a stamp.

    Raises:
        InputError: the file cannot be read, or a row does not hold that many numbers.
    """
    table = parse_numbers(path, columns)
    return np.asarray(table[np.isfinite(table).all(axis=1)])


def increasing(stamps: FloatArray, T_world_lidar: FloatArray) -> Trajectory | None:
    """The poses (N, 4, 4) whose stamps (N,) increase; None if there is none."""
    kept = increasing_rows(stamps)
    return Trajectory(stamps[kept], T_world_lidar[kept]) if kept.any() else None


def poses_wxyz(positions: ArrayLike, quaternions: ArrayLike) -> FloatArray:
    """Transforms (..., 4, 4) of positions (..., 3) and quaternions (..., 4) with the scalar first.

    Raises:
        ValueError: a number is not finite, or a quaternion is zero.
    """
    t, q = np.asarray(positions, dtype=np.float64), np.asarray(quaternions, dtype=np.float64)
    if not (np.isfinite(t).all() and np.isfinite(q).all()):
        raise ValueError("expected finite positions and quaternions")
    return make_transform(Rotation.from_quat(np.roll(q, -1, axis=-1)).as_matrix(), t)
