"""Layout of a folder of scans: the scan files, their stamps, the ground truth."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.text import count
from lidarslam.datasets.folders.scan_files import SCAN_SUFFIXES, natural_key
from lidarslam.datasets.imu_samples import find_imu_file
from lidarslam.datasets.times.stamps import mend_stamps, read_stamps, stamps_from_names

_STAMP_FILES = ("timestamps.txt", "times.txt")
_NAMES = ("ground_truth.tum", "groundtruth.tum", "ground_truth.txt", "groundtruth.txt")


@dataclass(frozen=True, eq=False)
class FolderLayout:
    """The scans of a folder."""

    files: tuple[Path, ...]  # N files in the order of time, all with one suffix
    stamps: FloatArray  # (N,) seconds, strictly increasing
    from_clock: bool  # whether the stamps were found; else they are made from the rate
    truth: Path | None  # a TUM file, or None
    imu: Path | None  # a table of samples, or None
    notes: tuple[str, ...]  # facts for the user
    warnings: tuple[str, ...]  # faults and repairs


def find_layout(folder: Path, rate_hz: float) -> FolderLayout:
    """The layout by names and the stamp file; no scan is opened.

    Raises:
        InputError: there is no scan, or the stamp file does not go with the scans.
    """
    files, notes, warnings = _find_scans(folder)
    places = (folder, folder.resolve().parent)
    stamp_file = next((place / name for place in places for name in _STAMP_FILES if (place / name).is_file()), None)
    stamps, from_clock = np.arange(len(files)) / rate_hz, True
    named = stamps_from_names([path.stem for path in files])
    if stamp_file is not None:
        stamps, replaced, faults = _read_stamp_file(stamp_file, files)
        warnings += faults
        if replaced:
            warnings.append(
                f"{count(replaced, 'stamp')} of {stamp_file.name} interpolated: repeated, backwards or far ahead."
            )
    elif named is not None and len(set(named)) == len(named):
        notes.append("The stamps are the file names.")
        order = np.argsort(named)  # not that of the names: 5.36 comes before 5.4
        files, stamps = [files[i] for i in order], named[order]
    else:
        from_clock = False
        if named is not None:
            warnings.append("The file names look like stamps, but some are equal.")
    whole = (
        folder.resolve().parent.parent if folder.resolve().parent.name == "velodyne_points" else folder.resolve().parent
    )
    if folder.resolve().name == "velodyne" or whole != folder.resolve().parent:
        warnings.append(f"The folder is part of a KITTI recording; name {whole} for its times, poses and calibration.")
    return FolderLayout(
        tuple(files), stamps, from_clock, find_truth_file(places), find_imu_file(places), tuple(notes), tuple(warnings)
    )


def _find_scans(folder: Path) -> tuple[list[Path], list[str], list[str]]:
    """The scan files in natural order, the most common suffix and numbered names first; notes and warnings."""
    named = [p for p in folder.iterdir() if p.suffix.lower() in SCAN_SUFFIXES and not p.name.startswith(".")]
    candidates = [path for path in named if path.is_file()]
    if not candidates:
        raise InputError(f"{folder}: expected scan files ({', '.join(SCAN_SUFFIXES)}), found none")
    counts = Counter(path.suffix.lower() for path in candidates)
    suffix = max(SCAN_SUFFIXES, key=lambda s: counts[s])  # of equals the first, so that a map beside a scan loses
    same = [path for path in candidates if path.suffix.lower() == suffix]
    numbered = [path for path in same if any(c.isdecimal() for c in path.stem)]
    files = sorted(numbered or same, key=lambda path: natural_key(path.stem))
    skipped = sorted(path.name for path in set(candidates) - set(files))
    shown = ", ".join(skipped[:3]) + (", ..." if len(skipped) > 3 else "")
    gone = sorted(path.name for path in named if path.suffix.lower() == suffix and not path.is_file())
    no_files = "is no file" if len(gone) == 1 else "are no files"
    return (
        files,
        [f"{count(len(skipped), 'other file')} not taken for scans: {shown}."] if skipped else [],
        [f"{count(len(gone), 'scan')} {no_files} that can be opened, such as {gone[0]}."] if gone else [],
    )


def _read_stamp_file(path: Path, files: Sequence[Path]) -> tuple[FloatArray, int, list[str]]:
    """The stamps, how many of them were replaced, and a warning where lines and scans differ in number."""
    lines = read_stamps(path)
    stamps, numbers = lines[np.isfinite(lines)], np.arange(len(files))
    warnings, left = [], max(0, len(files) - len(stamps))
    if len(stamps) > len(files):
        named = [int(file.stem) for file in files if file.stem.isdecimal()]
        if len(named) == len(files) and named[-1] < len(lines):  # as in KITTI, where scans may have been left away
            stamps, numbers, which = lines[named], np.array(named), "each takes the line of its number, from 0 on"
        else:
            stamps, which = stamps[: len(files)], "the first are taken"
        warnings = [f"{path.name} has {len(lines):,} stamps for {count(len(files), 'scan')}; {which}."]
    elif left:
        warnings = [
            f"{path.name} has {count(len(stamps), 'stamp')} for {count(len(files), 'scan')}; those of the last {left:,}"
            " continue at its rate."
        ]
        stamps = np.append(stamps, np.full(left, np.nan))
    try:
        mended, replaced = mend_stamps(stamps, numbers.astype(np.float64))
    except ValueError:
        raise InputError(
            f"{path}: expected stamps that increase from line to line, no two of them do; mend it, or move it away to"
            " use the file names or the rate"
        ) from None
    return mended, replaced - left, warnings


def find_truth_file(folders: Sequence[Path], stem: str | None = None) -> Path | None:
    """The true trajectory in the first folder that has one; `<stem>.tum` in any of them goes before general names."""
    own = [folder / f"{stem}.tum" for folder in folders] if stem else []
    general = [folder / name for folder in folders for name in _NAMES]
    return next((path for path in own + general if path.is_file()), None)
