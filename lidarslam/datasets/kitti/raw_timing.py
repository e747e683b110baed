"""Stamps of the sweeps of a KITTI raw drive, and of the points within a sweep by their azimuth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.text import count
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.times.stamps import assumed_rate, mend_stamps, read_stamps

# Sweeps of one drive last the same to 0.2 %; a larger difference than this part is a wrong stamp.
_SWEEP_TOLERANCE = 0.25


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
    """Read timestamps.txt, timestamps_start.txt and timestamps_end.txt of a `velodyne_points` folder.

    Args:
        folder: where the three files are, if they are.
        numbers: (N,) the scans' numbers, which are the rows of the files; a missing scan has a blank row.
        config: its rate makes the stamps when timestamps.txt is missing or useless.

    Raises:
        InputError: a file is damaged.
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
