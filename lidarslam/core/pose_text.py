"""TUM and KITTI text files <-> arrays of poses; the only file that knows a quaternion's order.

TUM: `stamp tx ty tz qx qy qz qw`, a pose a line, `#` comments. KITTI: twelve numbers a line, the first three rows
of the pose matrix, no stamps.
"""

from array import array
from io import StringIO
from pathlib import Path

import numpy as np

from lidarslam.core.bounded_lines import bounded_lines
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, is_rigid, make_transform, orthonormalize

# Survey coordinates are far below; squares of much larger numbers overflow.
_FARTHEST_M = 1e9

_FORMATS = {
    8: "; a TUM trajectory has lines `stamp tx ty tz qx qy qz qw`",
    12: "; a KITTI trajectory has the first three rows of a pose matrix a line",
}
# By the columns that were expected and those that came.
_OTHER_FORMAT = {
    (8, 12): (
        "; it is in KITTI's format, which has no stamps, and often holds the poses of a camera: give the LiDAR's as TUM"
        " text, a line `stamp tx ty tz qx qy qz qw` for each scan"
    ),
    (12, 8): "; it looks like a TUM trajectory, `stamp tx ty tz qx qy qz qw`",
}


def parse_numbers(path: Path, columns: int) -> FloatArray:
    """The (N, columns) numbers of a text file; commas count as blanks.

    Raises:
        InputError: the file is missing, is not text, or a line does not hold that many numbers.
    """
    numbers = array("d")
    for number, line in enumerate(bounded_lines(path), start=1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            raise InputError(
                f"{path}:{number}: expected {columns} numbers, got {line.strip()[:60]!r}{_FORMATS.get(columns, '')}"
            ) from None
        if len(row) != columns:
            hint = _OTHER_FORMAT.get((columns, len(row)), _FORMATS.get(columns, ""))
            raise InputError(f"{path}:{number}: expected {columns} numbers, got {len(row)}{hint}")
        numbers.extend(row)
    return np.array(numbers, dtype=np.float64).reshape(-1, columns)


def read_tum_poses(path: Path) -> tuple[FloatArray, FloatArray]:
    """Stamps (N,) and poses (N, 4, 4) of a TUM file; lines may stand in any order, of equal stamps the first is kept.

    Raises:
        InputError: the file is missing or a line is not a pose.
    """
    table = parse_numbers(path, columns=8)
    if not len(table):
        raise InputError(f"{path}: holds no pose; expected lines `stamp tx ty tz qx qy qz qw`")
    norms = np.linalg.norm(table[:, 4:], axis=1)
    if not np.isfinite(table).all() or (np.abs(norms - 1.0) > 0.05).any():
        raise InputError(f"{path}: holds numbers that are no poses; expected `stamp tx ty tz qx qy qz qw`")
    _require_near(path, table[:, 1:4])
    _, first = np.unique(table[:, 0], return_index=True)
    table = table[first]
    from scipy.spatial.transform import Rotation  # takes a while to load

    R = Rotation.from_quat(table[:, 4:]).as_matrix()
    return table[:, 0], make_transform(R, table[:, 1:4])


def format_tum_poses(stamps: FloatArray, poses: FloatArray) -> str:
    """Stamps (N,) and poses (N, 4, 4) as TUM text, nine decimals, quaternions with qw >= 0."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    out = StringIO()
    np.savetxt(out, np.column_stack([stamps, poses[:, :3, 3], quaternions]), fmt="%.9f")
    return out.getvalue()


def read_kitti_poses(path: Path) -> FloatArray:
    """Read the poses (N, 4, 4) of a KITTI file, in whatever frame it holds them.

    Raises:
        InputError: the file is missing or a line is not a pose.
    """
    rows = parse_numbers(path, columns=12).reshape(-1, 3, 4)
    if not len(rows):
        raise InputError(f"{path}: holds no pose; expected twelve numbers a line")
    T = make_transform(rows[:, :, :3], rows[:, :, 3])
    if not np.isfinite(T).all() or (np.abs(np.linalg.det(T[:, :3, :3]) - 1.0) > 1e-2).any():
        raise InputError(f"{path}: holds rows that are no poses; expected the first three rows of a rigid transform")
    _require_near(path, T[:, :3, 3])
    return orthonormalize(T)


def read_transform(path: Path) -> FloatArray:
    """A rigid transform (4, 4) from a text file of four rows of four numbers.

    Raises:
        InputError: the file holds anything else.
    """
    T = parse_numbers(path, columns=4)
    if T.shape != (4, 4) or not is_rigid(T, tolerance=1e-3):
        raise InputError(f"{path}: expected a rigid transform of four rows of four numbers, the last 0 0 0 1")
    return orthonormalize(T)


def _require_near(path: Path, positions: FloatArray) -> None:
    farthest = float(np.abs(positions).max())
    if farthest > _FARTHEST_M:
        raise InputError(f"{path}: a position lies {farthest:.3g} m from the origin; expected metres")


def format_kitti(poses: FloatArray) -> str:
    """Poses (N, 4, 4) as KITTI text."""
    out = StringIO()
    np.savetxt(out, poses[:, :3].reshape(-1, 12), fmt="%.9e")
    return out.getvalue()
