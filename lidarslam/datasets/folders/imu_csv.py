"""IMU samples as a CSV table beside the scans, in the columns of EuRoC's `imu0/data.csv`: `imu.csv`.

A line is `stamp, wx, wy, wz, ax, ay, az`: seconds or nanoseconds, rad/s, m/s^2. Lines that begin with `#` are comments;
`# T_lidar_imu: ` and the twelve numbers of its first three rows, or sixteen, is the extrinsic calibration.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarslam.core.bounded_lines import bounded_lines
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, is_rigid, orthonormalize
from lidarslam.core.imu import ImuSamples
from lidarslam.datasets.imu_samples import usable_samples

IMU_FILE = "imu.csv"
EXTRINSIC = "T_lidar_imu"
COLUMNS = ("stamp_s", "wx_rad_s", "wy_rad_s", "wz_rad_s", "ax_m_s2", "ay_m_s2", "az_m_s2")
# Clock readings in seconds are below, those in nanoseconds above.
_NANOSECONDS_FROM = 1e14


def find_imu_file(folders: Sequence[Path]) -> Path | None:
    """The table in the first folder that has one."""
    return next((folder / IMU_FILE for folder in folders if (folder / IMU_FILE).is_file()), None)


def read_imu_csv(path: Path) -> ImuSamples | None:
    """The samples of a table; None of a table without any.

    Raises:
        InputError: the file cannot be read, or a line is no sample.
    """
    lines = list(bounded_lines(path))
    comments = [line for line in lines if line.startswith("#")]
    rows = [line for line in lines if line.strip() and not line.startswith("#")]
    if rows and any(character.isalpha() and character not in "eEnainf" for character in rows[0]):
        rows = rows[1:]  # the names of the columns
    try:
        table = np.array([row.split(",") for row in rows], dtype=np.float64).reshape(len(rows), len(COLUMNS))
    except ValueError:
        wrong = next(row for row in rows if not _is_sample(row))
        expected = "stamp, wx, wy, wz, ax, ay, az"
        raise InputError(f"{path}: expected lines `{expected}`, got {wrong[:60]!r}; mend it or move it away") from None
    stamps = table[:, 0]
    if len(stamps) and np.nanmedian(stamps) > _NANOSECONDS_FROM:
        stamps = np.array([int(row.split(",")[0]) / 10**9 for row in rows])
    return usable_samples(stamps, table[:, 1:4], table[:, 4:], _extrinsic(path, comments))


def _is_sample(row: str) -> bool:
    try:
        return len([float(word) for word in row.split(",")]) == len(COLUMNS)
    except ValueError:
        return False


def _extrinsic(path: Path, comments: Sequence[str]) -> FloatArray | None:
    line = next((line for line in comments if EXTRINSIC in line), None)
    if line is None:
        return None
    try:
        numbers = [float(word) for word in line.partition(":")[2].replace(",", " ").split()]
        T_lidar_imu = np.array([*numbers[:12], 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)
    except ValueError:
        T_lidar_imu = np.zeros((4, 4))
    if not is_rigid(T_lidar_imu, 1e-3):
        raise InputError(f"{path}: expected `# {EXTRINSIC}:` with the first three rows of a rigid transform")
    return orthonormalize(T_lidar_imu)
