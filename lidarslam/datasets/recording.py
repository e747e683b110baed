"""What the readers hand out: a sequence of scans that can also describe itself."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan, ScanSequence
from lidarslam.datasets.faults import Faults


@dataclass(frozen=True)
class PointTime:
    """What was inferred about the time of single points.

    Attributes:
        source: where the time comes from: the name of the point field, or words such as "azimuth".
        unit: "s", "ms", "us" or "ns".
        reference: "relative" (to the scan's stamp) or "absolute" (a clock reading).
        first_s, last_s: smallest and largest offset from the stamp in the scan that was looked at, seconds.
    """

    source: str
    unit: str
    reference: str
    first_s: float
    last_s: float


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
class PointField:
    """One field of the points as stored, such as `intensity`, `float32`."""

    name: str
    type_name: str


@dataclass(frozen=True)
class RecordingInfo:
    """What `lidarslam info` prints.

    Attributes:
        reader: name of the reader in the registry.
        scans: number of scans.
        first_stamp, duration_s: seconds; the duration is from the first stamp to the last.
        rate_hz: scans a second, None for fewer than two scans.
        points_per_scan: valid points in the first scan.
        dropped_points: invalid points left out of the first scan.
        has_rings: whether points carry the number of their laser.
        ground_truth: where the true trajectory was found, if it was.
        point_time: None when the recording has no per-point time.
        topics: of a bag, all of them; `topic` is the one that is read.
        fields: as stored in the file or the message.
        notes: whatever else the user should know, one sentence each.
    """

    reader: str
    scans: int
    first_stamp: float
    duration_s: float
    rate_hz: float | None
    points_per_scan: int
    dropped_points: int
    has_rings: bool
    ground_truth: Path | None
    point_time: PointTime | None
    topic: str | None = None
    topics: tuple[Topic, ...] = ()
    fields: tuple[PointField, ...] = ()
    notes: tuple[str, ...] = field(default=())


class Recording(ScanSequence, Protocol):
    """A recording on disk."""

    @property
    def T_cam_lidar(self) -> FloatArray | None:
        """Extrinsic calibration of a KITTI recording, whose pose files are in the camera frame; None elsewhere."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with the recording as a whole, and what was mended; one sentence each, with counts."""

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`.

        Those that cannot be read are left out and counted in `faults`; without it the first of them is an error.

        Raises:
            InputError: the range makes no sense, a scan cannot be read, or nothing more can be.
        """

    def describe(self) -> RecordingInfo:
        """Look at the recording, its first scan included, and say what it holds."""
