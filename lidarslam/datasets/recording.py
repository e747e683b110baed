"""A recording on disk, a sequence of scans with a description: the interface of the readers, and their common part."""

import logging
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.plugins import require_library
from lidarslam.core.scan import Scan, ScanSequence
from lidarslam.core.text import first_few
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.point_table import PointField
from lidarslam.datasets.times.point_time import PointTimeModel

logger = logging.getLogger(__name__)

STORAGE_SUFFIXES = (".db3", ".mcap")  # of rosbag2
ROSBAG1_SUFFIXES = (".bag", ".bag.active")  # .active: the recorder was killed
_TRUTH_NAMES = ("ground_truth.tum", "groundtruth.tum", "ground_truth.txt", "groundtruth.txt")
# Of the points of KITTI, and of the .bin files of others.
KITTI_FIELDS = ("x", "y", "z", "intensity")


@dataclass(frozen=True)
class Topic:
    """One topic of a bag."""

    name: str
    message_type: str
    messages: int


class SeveralTopicsError(InputError):
    """A bag has several point cloud topics, `clouds` among all its `topics`, and none was chosen."""

    def __init__(self, message: str, clouds: Sequence[Topic], topics: Sequence[Topic]) -> None:
        super().__init__(message)
        self.clouds = tuple(clouds)
        self.topics = tuple(topics)


@dataclass(frozen=True)
class ImuSummary:
    """The IMU of a recording."""

    name: str  # topic of a bag, else the file or folder
    samples: int
    rate_hz: float | None  # median; None of fewer than two samples
    has_extrinsic: bool  # whether T_lidar_imu is known
    notes: tuple[str, ...] = ()  # of its samples

    @staticmethod
    def of(name: str, samples: ImuSamples) -> "ImuSummary":
        """The description of the samples of a topic, file or folder."""
        return ImuSummary(name, len(samples), samples.rate_hz, samples.T_lidar_imu is not None, samples.notes)


@dataclass(frozen=True, eq=False)
class RecordingInfo:
    """Description of a recording, as `lidarslam info` prints it."""

    reader: str  # name of the reader in the registry
    scans: int  # number of scans
    first: Scan  # the first scan that can be read
    last_stamp: float  # stamp of the last scan, seconds
    ground_truth: Path | None  # where the true trajectory was found, if it was
    point_time: PointTimeModel | None  # as inferred from the values of a time field; None without
    topic: str | None = None
    topics: tuple[Topic, ...] = ()  # of a bag, all of them; `topic` is the one that is read
    fields: tuple[PointField, ...] = ()  # of the points as stored
    notes: tuple[str, ...] = ()  # further facts for the user, one sentence each
    imu: ImuSummary | None = None
    rate_is_assumed: bool = False  # the scans have no stamps, so that stamps and duration follow from `reader.rate_hz`

    @property
    def first_stamp(self) -> float:
        """Stamp of the first scan that can be read, seconds."""
        return self.first.stamp

    @property
    def duration_s(self) -> float:
        """From the first stamp to the last, seconds."""
        return max(0.0, self.last_stamp - self.first.stamp)

    @property
    def rate_hz(self) -> float | None:
        """Mean scans per second; None where the duration is zero."""
        return (self.scans - 1) / self.duration_s if self.duration_s > 0.0 else None


class Recording(ScanSequence, Protocol):
    """A recording on disk."""

    @property
    def T_cam_lidar(self) -> FloatArray | None:
        """Extrinsic calibration of a KITTI recording, whose pose files are in the camera frame; None elsewhere."""

    @property
    def imu(self) -> ImuSamples | None:
        """The samples of the IMU; None without one."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Faults of the recording as a whole, and repairs; one sentence each, with counts."""

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`.

        Those that cannot be read are left out and counted in `faults`; without it the first of them is an error.
        """

    def describe(self) -> RecordingInfo:
        """The contents of the recording, by its first scan too."""


class StoredRecording:
    """A file or folder; implements `Recording`.

    A reader adds `__len__`, `_items`, `_read` and `_last_stamp`, and sets or overrides what else there is.
    """

    reader: str
    imu_name: str = "imu"
    topic: str | None = None
    topics: tuple[Topic, ...] = ()
    point_time: PointTimeModel | None = None  # where the reader knows it; not used where the configuration wants none
    _stored: tuple[PointField, ...] = ()  # the fields of its points

    def __init__(self, source: Path, config: ReaderConfig) -> None:
        self._source = source
        self._config = config

    @property
    def name(self) -> str:
        """The folder's name, or the file's without its suffix."""
        return self._source.resolve().name if self._source.is_dir() else self._source.stem

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar at the truth's own stamps."""
        return None if self._truth_path is None else read_tum(self._truth_path)

    @cached_property
    def imu(self) -> ImuSamples | None:
        """No IMU."""
        return None

    @cached_property
    def T_cam_lidar(self) -> FloatArray | None:
        """No camera."""
        return None

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Faults of the recording as a whole."""
        return ()

    @cached_property
    def _notes(self) -> tuple[str, ...]:
        return ()

    @cached_property
    def _truth_path(self) -> Path | None:
        return None

    @cached_property
    def _rate_is_assumed(self) -> bool:
        return False

    @cached_property
    def _point_time(self) -> PointTimeModel | None:
        return None if self._config.time_reference == "none" else self.point_time

    def __len__(self) -> int:
        raise NotImplementedError

    @property
    def _stored_scans(self) -> int:
        return len(self)

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; faults are logged where nobody counts them."""
        return self._scans(scan_indices(len(self), start, stop, step), faults)

    def _scans(self, wanted: range, faults: Faults | None) -> Iterator[Scan]:
        counted = Faults(strict=True) if faults is None else faults
        try:
            for item in self._items(wanted, counted):
                try:
                    scan = self._read(item, counted)
                except InputError as error:
                    counted.unreadable(error)
                    continue
                yield scan
        finally:
            if faults is None:
                for warning in counted.warnings():
                    logger.warning("%s: %s", self._source, warning)

    def describe(self) -> RecordingInfo:
        """By the first readable scan; see `Recording`."""
        faults = Faults()
        item, first = self._first(faults)
        return RecordingInfo(
            reader=self.reader,
            scans=len(self),
            first=first,
            last_stamp=self._last_stamp(first),
            ground_truth=self._truth_path,
            point_time=self._point_time,
            topic=self.topic,
            topics=self.topics,
            fields=self._fields(item),
            notes=(*self._notes, *self.warnings, *faults.warnings()),
            rate_is_assumed=self._rate_is_assumed,
            imu=self._imu_summary(),
        )

    def _first(self, faults: Faults) -> tuple[Any, Scan]:
        """The first readable scan, and its item; the error of the first one where none can be read."""
        first_error = None
        for item in self._items(range(self._stored_scans), faults):
            try:
                return item, self._read(item, faults)
            except InputError as error:
                first_error = first_error or error
                faults.unreadable(error)
        left_out = "".join(f"; {warning}" for warning in faults.warnings())
        raise first_error or InputError(f"{self._source}: holds no scan that could be used; record it again{left_out}")

    def _items(self, wanted: range, faults: Faults) -> Iterator[Any]:
        """The items that the wanted scans are read from; others are counted."""
        raise NotImplementedError

    def _read(self, item: Any, faults: Faults) -> Scan:
        raise NotImplementedError

    def _fields(self, item: Any) -> tuple[PointField, ...]:  # noqa: ARG002
        return self._stored

    def _last_stamp(self, first: Scan) -> float:
        raise NotImplementedError

    def _imu_summary(self) -> ImuSummary | None:
        return None if self.imu is None else ImuSummary.of(self.imu_name, self.imu)


class FileRecording(StoredRecording):
    """A folder with a file for each scan. A reader adds `_read`, by the index of a scan, and the stamps."""

    stamps: FloatArray
    """(N,) seconds."""
    _stored = tuple(PointField(name, "float32") for name in KITTI_FIELDS)

    def __init__(self, folder: Path, config: ReaderConfig, files: Sequence[Path]) -> None:
        super().__init__(folder, config)
        self._files = files

    def __len__(self) -> int:
        return len(self._files)

    def _items(self, wanted: range, faults: Faults) -> Iterator[int]:  # noqa: ARG002
        return iter(wanted)

    def _last_stamp(self, first: Scan) -> float:  # noqa: ARG002
        return float(self.stamps[-1])


class PacketRecording(StoredRecording):
    """The sweeps of one sensor. A reader adds `_items`, `_read` and `_fields`."""

    reader = "packets"
    imu_name = "the sensor's own"
    library: tuple[str, str, str]  # that decodes the packets, as of `require_library`

    def __init__(self, source: Path, config: ReaderConfig) -> None:
        require_library(*self.library)
        super().__init__(source, config)
        self._truth_path = truth_beside(source, self.name)

    def __len__(self) -> int:
        return self._extent[0]

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """See `Recording`; sweeps are not counted beforehand, which would take a pass over all packets."""
        return self._scans(scan_indices(sys.maxsize, start, stop, step), faults)

    @cached_property
    def _extent(self) -> tuple[int, float]:
        """Number of sweeps, and the stamp of the last one."""
        count, last = 0, 0.0
        for scan in self.scans(faults=Faults()):
            count, last = count + 1, scan.stamp
        return count, last

    def _last_stamp(self, first: Scan) -> float:  # noqa: ARG002
        return self._extent[1]


def scan_indices(count: int, start: int, stop: int | None, step: int) -> range:
    """The indices `range(start, stop, step)` of a recording of `count` scans, a stop past the end being the end."""
    if start < 0 or step < 1 or (stop is not None and stop < 0):
        raise InputError(
            f"expected start >= 0, stop >= 0 and step >= 1, got start {start}, stop {stop} and step {step}"
        )
    return range(start, count if stop is None else min(stop, count), step)


def find_sequence(source: Path, folder: Path, marker: str, wanted: str | None, noun: str = "sequence") -> Path:
    """The sequence of a data set: the source, or one of those in a folder, which are known by a path in them.

    Wanted is one by its name, or the last number in it; None: the only one.
    """
    if (source / marker).exists():
        name = source.resolve().name
        if wanted is not None and wanted.zfill(len(name)) != name:
            raise InputError(
                f"{source}: is the {noun} {name}, not {wanted}; leave --sequence out or give the folder above"
            )
        return source
    names = sorted(path.name for path in folder.glob("*") if (path / marker).exists())
    if not names:
        raise InputError(f"{source}: expected {marker} in it, or in folders in {folder}; found neither")
    return folder / choose_sequence(source, names, wanted, noun)


def choose_sequence(source: Path, names: Sequence[str], wanted: str | None, noun: str = "sequence") -> str:
    """Of the names of a data set's sequences the only one, or the wanted one: by name, or by the last number in it."""
    number = int(wanted) if wanted is not None and wanted.isdecimal() else None
    fitting = [name for name in names if wanted in (None, name)] or [
        name for name in names if number is not None and _last_number(name) == number
    ]
    if len(fitting) == 1:
        return fitting[0]
    if wanted is None:
        raise InputError(f"{source}: holds {len(names):,} {noun}s; choose one with --sequence: {first_few(names, 8)}")
    raise InputError(f"{source}: has no {noun} {wanted!r}; there are: {first_few(names, 8)}")


def _last_number(name: str) -> int | None:
    numbers = re.findall(r"[0-9]+", name)
    return int(numbers[-1]) if numbers else None


def storage_files(folder: Path, suffixes: tuple[str, ...] = STORAGE_SUFFIXES) -> list[Path]:
    """The databases and MCAP files of a folder, or other bags, without hidden ones such as macOS's `._` files.

    A recorder that was killed leaves them without their metadata.yaml.
    """
    named = (entry for entry in folder.iterdir() if entry.name.endswith(suffixes) and entry.name[0] != ".")
    return sorted(entry for entry in named if entry.is_file())


def first_file(folders: Sequence[Path], *names: str) -> Path | None:
    """The first of these files in the first folder that has one of them."""
    paths = (folder / name for folder in folders for name in names)
    return next((path for path in paths if path.is_file()), None)


def find_truth_file(folders: Sequence[Path], stem: str | None = None) -> Path | None:
    """The true trajectory in the first folder that has one; `<stem>.tum` in any of them precedes general names."""
    own = None if stem is None else first_file(folders, f"{stem}.tum")
    return own or first_file(folders, *_TRUTH_NAMES)


def truth_beside(source: Path, name: str) -> Path | None:
    """The true trajectory in a recording's folder or its parent, or in the folder of its file."""
    above = [source, source.absolute().parent, source.resolve().parent] if source.is_dir() else [source.parent]
    return find_truth_file(above, name)
