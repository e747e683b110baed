"""A recording on disk: a sequence of scans with a description; the interface of the readers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan, ScanSequence
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.point_table import PointField
from lidarslam.datasets.times.point_time import PointTimeModel


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


# Of the points of KITTI, and of the .bin files of others.
KITTI_FIELDS = ("x", "y", "z", "intensity")


@dataclass(frozen=True)
class ImuSummary:
    """The IMU of a recording."""

    name: str  # topic of a bag, else the file or folder
    samples: int
    rate_hz: float | None  # median; None of fewer than two samples
    has_extrinsic: bool  # whether T_lidar_imu is known
    notes: tuple[str, ...] = ()  # of its samples


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
