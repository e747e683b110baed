"""A folder of scan files: .bin, .pcd, .ply or .npy, one sweep each; their stamps, and the files next to them."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.text import count
from lidarslam.datasets.cloud_recording import CloudRecording
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.folders.scan_files import SCAN_SUFFIXES, natural_key, table_reader
from lidarslam.datasets.imu_samples import IMU_FILE, read_imu_csv
from lidarslam.datasets.point_table import RawCloud, raw_cloud
from lidarslam.datasets.recording import FileRecording, Recording, find_truth_file, first_file
from lidarslam.datasets.times.point_time import CLOCK_LIMIT_S
from lidarslam.datasets.times.stamps import assumed_rate, mend_stamps, read_stamps, scan_rate, stamps_from_names

_STAMP_FILES = ("timestamps.txt", "times.txt")
# Pairs of consecutive scans that are compared at their seams, spread over the recording.
_PAIRS = 40
# Share of the scans above which other numbered files are scans in a second format, rather than a few maps.
_FEW_OTHERS = 0.1
# The number at the end of a name, its digits that count, and the most numbers per scan of names that count scans.
_NUMBER, _MOST_DIGITS, _MOST_MISSING = re.compile(r"\d+$"), 9, 3
# Scans that are farther apart may be stamped in another unit.
_LOWEST_RATE_HZ = 0.1


def _find_scans(folder: Path) -> tuple[list[Path], list[str], list[str]]:
    """The scans, those of the most frequent format; facts and warnings about the others."""
    named = [p for p in folder.iterdir() if p.suffix.lower() in SCAN_SUFFIXES and not p.name.startswith(".")]
    candidates = [path for path in named if path.is_file()]
    if not candidates:
        raise InputError(f"{folder}: expected scan files ({', '.join(SCAN_SUFFIXES)}), found none")
    counts = Counter(path.suffix.lower() for path in candidates)
    suffix = max(SCAN_SUFFIXES, key=lambda s: counts[s])  # of equals the first: a scan wins over a map
    same = [path for path in candidates if path.suffix.lower() == suffix]
    numbered = [path for path in same if any(c.isdecimal() for c in path.stem)]
    files = sorted(numbered or same, key=lambda path: natural_key(path.stem))
    skipped = sorted(path.name for path in set(candidates) - set(files))
    are_scans = len(skipped) > _FEW_OTHERS * len(files) and any(c.isdecimal() for c in skipped[0])
    gone = sorted(path.name for path in named if path.suffix.lower() == suffix and not path.is_file())
    notes, warnings = list[str](), list[str]()
    if skipped:
        others = f"{count(len(skipped), 'other file')} not taken for scans, such as {skipped[0]}."
        (warnings if are_scans else notes).append(others)
    if gone:
        no_files = "is no file" if len(gone) == 1 else "are no files"
        warnings.append(f"{count(len(gone), 'scan')} {no_files} that can be opened, such as {gone[0]}.")
    return files, notes, warnings


def _numbers(files: Sequence[Path]) -> NDArray[np.intp]:
    """The numbers (N,) of scans in their order, from 0: those in their names, in steps of their greatest divisor."""
    found = [_NUMBER.search(path.stem) for path in files]
    numbers = np.array([int(match[0][-_MOST_DIGITS:]) for match in found if match is not None], dtype=np.int64)
    steps = np.diff(numbers)
    if len(numbers) < len(files) or not (steps > 0).all() or not len(steps):
        return np.arange(len(files))
    steps //= np.gcd.reduce(steps)
    # Where most are missing, the numbers are of another kind.
    is_count = steps.sum() < _MOST_MISSING * len(files)
    return np.concatenate([[0], np.cumsum(steps)]) if is_count else np.arange(len(files))


def _read_stamp_file(path: Path, files: Sequence[Path]) -> tuple[FloatArray, list[str]]:
    """The stamps, and warnings where lines and scans differ in number, or stamps were replaced."""
    lines = read_stamps(path)
    stamps, numbers = lines[np.isfinite(lines)], np.arange(len(files))
    left, which = max(0, len(files) - len(stamps)), None
    if len(stamps) > len(files):
        named = [int(file.stem) for file in files if file.stem.isdecimal()]
        which = "the first are taken"
        if len(named) == len(files) and named[-1] < len(lines):  # as in KITTI, where scans may have been omitted
            stamps, numbers, which = lines[named], np.array(named), "each takes the line of its number, from 0 on"
    elif left:
        which = f"those of the last {left:,} continue at its rate"
    said = f"{path.name} has {count(len(stamps) if left else len(lines), 'stamp')} for {count(len(files), 'scan')}"
    warnings = [] if which is None else [f"{said}; {which}."]
    stamps = np.append(stamps[: len(files)], np.full(left, np.nan))
    try:
        mended, replaced = mend_stamps(stamps, numbers.astype(np.float64))
    except ValueError:
        raise InputError(
            f"{path}: expected stamps that increase from line to line, no two of them do; mend it, or move it away to"
            " use the file names or the rate"
        ) from None
    if replaced > left:
        warnings.append(
            f"{count(replaced - left, 'stamp')} of {path.name} interpolated: repeated, backwards or far ahead."
        )
    if (rate_hz := scan_rate(mended)) is not None and rate_hz < _LOWEST_RATE_HZ:
        warnings.append(
            f"The stamps of {path.name} are {1.0 / rate_hz:,.6g} s apart, as no LiDAR's are: expected are seconds, or"
            " milli-, micro- or nanoseconds since 1970."
        )
    return mended, warnings


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a folder of scans."""
    if not source.is_dir():
        raise InputError(f"{source}: expected a folder of scans, got a file; give the folder it lies in")
    return ScanFolderRecording(source, config)


class ScanFolderRecording(CloudRecording, FileRecording):
    """The scans of one folder."""

    reader = "scan-folder"
    imu_name = IMU_FILE

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        files, notes, warnings = _find_scans(folder)
        places = (folder, folder.absolute().parent, folder.resolve().parent)
        stamp_file = first_file(places, *_STAMP_FILES)
        numbers = _numbers(files)
        stamps, self._has_stamps = numbers / config.rate_hz, True
        named = stamps_from_names([path.stem for path in files])
        is_named = named is not None and len(set(named)) == len(named)
        if stamp_file is not None and is_named and stamp_file.parent != folder:
            of_camera = len(read_stamps(stamp_file)) != len(files)
            stamp_file = None if of_camera else stamp_file
        if stamp_file is not None:
            stamps, faults = _read_stamp_file(stamp_file, files)
            warnings += faults
        elif named is not None and is_named:
            notes.append("The stamps are the file names.")
            order = np.argsort(named)  # not that of the names: 5.36 comes before 5.4
            files, stamps = [files[i] for i in order], named[order]
        else:
            self._has_stamps = False
            if (missing := int(numbers[-1]) + 1 - len(files)) > 0:
                warnings.append(f"{count(missing, 'number')} missing among the names of the scans; these leave gaps.")
        above = places[2]
        whole = above.parent if above.name == "velodyne_points" else above
        if folder.resolve().name == "velodyne" or whole != above:
            warnings.append(
                f"The folder is part of a KITTI recording; name {whole} for its times, poses and calibration."
            )
        super().__init__(folder, config, files)
        self.stamps = stamps
        self._truth_path, self._imu_path = find_truth_file(places), first_file(places, IMU_FILE)
        self._facts_of_source, self._folder_warnings = tuple(notes), tuple(warnings)
        self._read_table = table_reader(files)

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The table imu.csv in the folder or the one above."""
        return None if self._imu_path is None else read_imu_csv(self._imu_path)

    @cached_property
    def _faults_of_source(self) -> tuple[str, ...]:
        assumed = (assumed_rate("The scans have no stamps", self._config),) if self._rate_is_assumed else ()
        return (*self._folder_warnings, *assumed)

    @property
    def _stored_scans(self) -> int:
        return len(self._files)

    def _decode(self, item: int) -> RawCloud:
        path = self._files[item]
        table = self._read_table(path)
        try:
            return raw_cloud(table, self._config.time_field)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def _stamp(self, item: int) -> float:
        return float(self.stamps[item])

    def _sound_items(self) -> Iterable[int]:
        return range(self._stored_scans)

    def _runs(self) -> Iterable[Iterable[int]]:
        starts = sorted({int(index) for index in np.linspace(0, max(0, self._stored_scans - 2), _PAIRS)})
        return (range(first, min(first + 2, self._stored_scans)) for first in starts)

    @cached_property
    def period_s(self) -> float | None:
        rate = scan_rate(self.stamps)
        return None if rate is None else 1.0 / rate

    @cached_property
    def _rate_is_assumed(self) -> bool:
        model = self._learned.model
        return not (self._has_stamps or (model is not None and model.reference == "absolute"))

    def _read(self, item: int, faults: Faults) -> Scan:
        cloud, stamp = self._decode(item), self._stamp(item)
        if not self._has_stamps:
            stamp = self._first_point(cloud, stamp)
        return self._timing.scan(cloud, stamp, faults, str(self._files[item]))

    def _first_point(self, cloud: RawCloud, stamp: float) -> float:
        """The earliest reading of the points' clock, which is better than the stamp by an assumed rate."""
        model = self._learned.model
        if model is None or model.reference != "absolute" or cloud.times is None or cloud.time_field != model.field:
            return stamp
        seconds = cloud.times[cloud.returns].astype(np.float64) / model.units_per_second
        seconds = seconds[np.isfinite(seconds)]
        if not len(seconds):
            return stamp
        return float(seconds[np.abs(seconds - np.median(seconds)) <= CLOCK_LIMIT_S].min())

    def _last_stamp(self, first: Scan) -> float:
        """By its points' clock, which may be better than the rate."""
        try:
            return self._read(self._stored_scans - 1, Faults()).stamp
        except InputError:
            return super()._last_stamp(first)
