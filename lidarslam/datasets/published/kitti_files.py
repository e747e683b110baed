"""Calibration files of KITTI and KITTI-360, and the times of their sweeps."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.files import bounded_lines
from lidarslam.core.geometry import FloatArray, make_transform, orthonormalize
from lidarslam.core.text import count
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.times.stamps import assumed_rate, mend_stamps, read_stamps

# Sweeps of one drive last the same to 0.2 %; a larger difference than this part is a wrong stamp.
_SWEEP_TOLERANCE = 0.25


def read_calibration(path: Path) -> dict[str, FloatArray]:
    """The arrays of a calibration file by name; lines without numbers, such as the date, are left out."""
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
    """T_cam_lidar (4, 4) of the odometry benchmark's calib.txt, its line `Tr` or `Tr_velo_to_cam`."""
    arrays = read_calibration(path)
    name = "Tr_velo_to_cam" if "Tr" not in arrays and "Tr_velo_to_cam" in arrays else "Tr"
    rows = _entry(path, arrays, name, 12).reshape(3, 4)
    return _rigid(path, rows[:, :3], rows[:, 3])


def read_raw_calibration(path: Path) -> FloatArray:
    """The transform (4, 4) of a raw calibration file: T_B_A of calib_A_to_B.txt, T_rect_cam of calib_cam_to_cam.txt."""
    arrays = read_calibration(path)
    if path.name == "calib_cam_to_cam.txt":
        return _rigid(path, _entry(path, arrays, "R_rect_00", 9).reshape(3, 3), np.zeros(3))
    return _rigid(path, _entry(path, arrays, "R", 9).reshape(3, 3), _entry(path, arrays, "T", 3))


@dataclass(frozen=True, eq=False)
class SweepTiming:
    """The times of N sweeps."""

    stamps: FloatArray  # (N,) seconds, strictly increasing; the laser faces forward, which triggers the cameras
    # before_s, after_s: (N,) seconds from the sweep's start to the stamp and from the stamp to its end
    before_s: FloatArray
    after_s: FloatArray
    from_clock: bool  # whether the stamps are clock readings; else they are made from the rate
    notes: tuple[str, ...]  # facts for the user


def read_sweep_timing(folder: Path, numbers: NDArray[np.intp], config: ReaderConfig) -> SweepTiming:
    """By timestamps.txt, timestamps_start.txt and timestamps_end.txt in a `velodyne_points` folder, else by the rate.

    The numbers (N,) of the scans are the rows of the files; a missing scan has a blank row.
    """
    try:
        found = _rows(folder / "timestamps.txt", numbers)
        stamps, replaced = mend_stamps(found, numbers.astype(np.float64))
    except ValueError:
        half = np.full(len(numbers), 0.5 / config.rate_hz)
        note = assumed_rate("There is no timestamps.txt with two stamps that increase", config)
        return SweepTiming(numbers / config.rate_hz, half, half, False, (note,))
    notes = []
    if replaced:
        notes.append(f"{count(replaced, 'stamp')} of timestamps.txt interpolated: missing, repeated or backwards.")
    period = float(np.median(np.diff(stamps) / np.diff(numbers))) if len(stamps) > 1 else 1.0 / config.rate_hz
    start, end = (_rows(folder / f"timestamps_{which}.txt", numbers) for which in ("start", "end"))
    before_s, wrong_starts = _plausible(stamps - start, 0.5 * period)
    after_s, wrong_ends = _plausible(end - stamps, 0.5 * period)
    if wrong_starts or wrong_ends:
        said = "ends of sweeps missing or implausible, and replaced: sweeps are taken to be seamless."
        notes.append(f"{count(wrong_starts, 'start')} and {wrong_ends} {said}")
    return SweepTiming(stamps, before_s, after_s, True, tuple(notes))


def _rows(path: Path, numbers: NDArray[np.intp]) -> FloatArray:
    """The stamps of the rows with these numbers, NaN where there is none."""
    stamps = read_stamps(path) if path.is_file() else np.empty(0)
    return np.append(stamps, np.nan)[np.minimum(numbers, len(stamps))]


def _plausible(durations: FloatArray, expected: float) -> tuple[FloatArray, int]:
    wrong = ~(np.abs(durations - expected) < _SWEEP_TOLERANCE * expected)  # NaN is wrong too
    return np.where(wrong, expected, durations), int(np.count_nonzero(wrong))
