"""The samples of an IMU as recorded, made usable: in order, finite, in SI units."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.files import bounded_lines
from lidarslam.core.geometry import FloatArray, is_rigid, orthonormalize
from lidarslam.core.imu import GRAVITY_RANGE, ImuSamples
from lidarslam.core.text import count
from lidarslam.core.trajectory import parse_numbers

_STANDARD_GRAVITY = 9.80665  # m/s^2, the unit g
_IN_G = (0.7, 1.5)  # as `GRAVITY_RANGE`, of accelerations in g
# Ranges of sensors begin here: rad/s and m/s^2. A saturated sensor repeats its largest value this often in a row.
_LEAST_RANGES, _REPEATED = (1.0, 15.0), 3
# Share of missing samples that is noted.
_MISSING = 0.02
IMU_FILE = "imu.csv"
EXTRINSIC = "T_lidar_imu"
COLUMNS = ("stamp_s", "wx_rad_s", "wy_rad_s", "wz_rad_s", "ax_m_s2", "ay_m_s2", "az_m_s2")
# Clock readings in seconds are below, those in nanoseconds above.
_NANOSECONDS_FROM = 1e14


def usable_samples(
    stamps: FloatArray,
    angular_velocities: FloatArray,
    accelerations: FloatArray,
    T_lidar_imu: FloatArray | None,
    notes: tuple[str, ...] = (),
) -> ImuSamples | None:
    """The samples in the order of time; None where there are none.

    Samples with a number that is not finite or the stamp of another one are left out, and those out of the sensor's
    range; accelerations (N, 3) in g are converted to m/s^2. All this is noted, and missing samples too.
    """
    finite = np.isfinite(np.column_stack([stamps, angular_velocities, accelerations])).all(axis=1)
    finite_rows = np.flatnonzero(finite)
    rows = finite_rows[np.unique(stamps[finite_rows], return_index=True)[1]]
    if not len(rows):
        return None
    for kind, left_out in (
        ("with a number that is not finite", len(stamps) - len(finite_rows)),
        ("with the stamp of another", len(finite_rows) - len(rows)),
    ):
        if left_out:
            notes = (*notes, f"{count(left_out, 'IMU sample')} {kind} left out.")
    force = accelerations[rows]
    size = float(np.median(np.linalg.norm(force, axis=1)))
    if _IN_G[0] < size < _IN_G[1]:
        force = force * _STANDARD_GRAVITY
        notes = (*notes, f"The IMU's accelerations are in g (median {size:.2f}) and were converted to m/s^2.")
    elif not GRAVITY_RANGE[0] < size < GRAVITY_RANGE[1]:
        notes = (*notes, f"The IMU's accelerations have a median of {size:.3g}, which is gravity in no known unit.")
    kept = ~(_saturated(angular_velocities[rows], _LEAST_RANGES[0]) | _saturated(force, _LEAST_RANGES[1]))
    if (saturated := len(kept) - int(kept.sum())) > 0:
        notes = (*notes, f"{count(saturated, 'IMU sample')} out of the sensor's range left out.")
    steps = np.diff(stamps[rows])
    missing = 1.0 - len(steps) * float(np.median(steps)) / float(steps.sum()) if len(steps) > 1 else 0.0
    if missing > _MISSING:
        notes = (*notes, f"{100.0 * missing:.0f} % of the IMU's samples are missing.")
    return ImuSamples(stamps[rows][kept], angular_velocities[rows][kept], force[kept], T_lidar_imu, notes)


def _saturated(vectors: FloatArray, least: float) -> NDArray[np.bool_]:
    """(N,) whether a component of a vector (N, 3) is one of several equal ones in a row, at the largest of them all."""
    from scipy.ndimage import binary_opening  # takes a while to load

    sizes = np.abs(vectors)
    largest = sizes.max(axis=0)
    at_limit = (sizes == largest) & (largest > least)
    return np.asarray(binary_opening(at_limit, np.ones((_REPEATED, 1), dtype=bool)).any(axis=1))


def read_imu_csv(path: Path) -> ImuSamples | None:
    """The samples of a table, whose first line may name the columns; None of a table without any."""
    table = parse_numbers(path, len(COLUMNS), may_have_names=True)
    stamps = table[:, 0]
    if len(stamps) and np.nanmedian(stamps) > _NANOSECONDS_FROM:
        stamps = stamps / 1e9
    return usable_samples(stamps, table[:, 1:4], table[:, 4:], _extrinsic(path))


def _extrinsic(path: Path) -> FloatArray | None:
    line = next((line for line in bounded_lines(path) if line.startswith("#") and EXTRINSIC in line), None)
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
