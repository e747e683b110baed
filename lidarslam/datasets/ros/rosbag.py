"""Point clouds of a rosbag: rosbag1, rosbag2 (SQLite or MCAP), as PointCloud2 or Livox CustomMsg."""

import logging
from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults, first_readable, readable_scans
from lidarslam.datasets.folders.layout import find_truth_file
from lidarslam.datasets.folders.scan_files import scan_indices
from lidarslam.datasets.packets.libraries import require
from lidarslam.datasets.recording import Recording, RecordingInfo, Topic
from lidarslam.datasets.ros.bag_file import BagFile
from lidarslam.datasets.ros.bag_imu import BagImu, CloudTopic
from lidarslam.datasets.ros.bag_message import (
    OUSTER_PACKET_TYPES,
    VELODYNE_SCAN_TYPE,
    BagMessage,
    StampSource,
    find_stamp_source,
)
from lidarslam.datasets.ros.bag_point_time import BagPointTime
from lidarslam.datasets.ros.bag_topics import choose_topic, one_part, others_left_out
from lidarslam.datasets.ros.ouster_bag import OusterBag
from lidarslam.datasets.ros.point_cloud2 import DecodedCloud
from lidarslam.datasets.ros.timed_scan import timed_scan
from lidarslam.datasets.times.stamps import in_stamp_order

logger = logging.getLogger(__name__)

_FRAMES_LOOKED_AT = 10

_DAMAGED = "damaged places in the bag were passed over"
_MISSING = "scans are missing that the index lists"
_NO_HEADER_STAMPS = "The message headers have no stamps, so the times of recording are used."
_NEVER_SET = "scans were left out: their stamps were never set"


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a rosbag1 `.bag`, a rosbag2 folder, or a single `.db3` or `.mcap`.

    Raises:
        InputError: the bag cannot be read, or it does not hold the one point cloud topic that is asked for.
        ConfigError: the topic holds packets, and the library that decodes them is not installed.
    """
    bag = BagFile(source)
    topic = choose_topic(source, bag.topics, config.topic)
    if topic.message_type in OUSTER_PACKET_TYPES:
        return OusterBag(source, config, bag, topic)
    if topic.message_type == VELODYNE_SCAN_TYPE:
        require("velodyne_decoder", "packets of a Velodyne")
    return BagRecording(source, config, bag, topic)


class BagRecording:
    """The messages of one point cloud topic; implements `Recording`.

    Stamps are those of the message headers, or, where no header has one, the times of recording.
    """

    T_cam_lidar: FloatArray | None = None  # no camera

    def __init__(self, source: Path, config: ReaderConfig, bag: BagFile, topic: Topic) -> None:
        self._source = source
        self._config = config
        self._bag = bag
        self._topic = topic
        folders = [source, source.resolve().parent] if source.is_dir() else [source.parent]
        self._truth_file = find_truth_file(folders, self.name)

    @property
    def name(self) -> str:
        """The folder's name, or the file's without its suffix."""
        return self._source.resolve().name if self._source.is_dir() else self._source.stem

    @property
    def frames(self) -> tuple[BagFile, str]:
        """The bag, and the frame of its clouds."""
        return self._bag, self._frame_id

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """The TUM file beside the bag, or inside its folder, named like the bag or ground_truth.tum."""
        return None if self._truth_file is None else read_tum(self._truth_file)

    def __len__(self) -> int:
        return self._topic.messages

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The samples of the IMU topic nearest to the clouds', unless another is asked for."""
        return self._imu.samples()

    @cached_property
    def _imu(self) -> BagImu:
        return BagImu(self._bag, CloudTopic(self._topic, self._frame_id, self._stamps), self._config.imu_topic)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Other topics, a lost index, headers without stamps, and what is wrong with the times of the points."""
        others = others_left_out(self._bag.topics, self._topic) if self._config.topic is None else None
        unset = None if self._stamps.from_header else _NO_HEADER_STAMPS
        found = (others, self._bag.damage, unset, one_part(self._source), *self._point_time.warnings)
        return tuple(warning for warning in found if warning is not None)

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; only they are decoded.

        A message of another sensor, or one whose stamp is not after those before it, keeps its index but makes no
        scan; such messages are counted, in a warning where nobody counts.
        """
        return self._scans(scan_indices(len(self), start, stop, step), faults)

    def _scans(self, wanted: range, faults: Faults | None) -> Iterator[Scan]:
        counted = Faults() if faults is None else faults
        try:
            messages = in_stamp_order(self._wanted(wanted, counted, faults is None), self._stamps.stamp, counted)
            yield from readable_scans(messages, lambda message: self._scan(message, counted), faults)
        finally:
            if faults is None:
                for warning in counted.warnings():
                    logger.warning("%s: %s", self._source, warning)

    def _wanted(self, wanted: range, faults: Faults, strict: bool = False) -> Iterator[BagMessage]:
        other_sensor = (
            f"scans were left out: they come from another sensor than {self._frame_id!r}; for that one set"
            " reader.frame_id"
        )
        for index, message in enumerate(islice(self._messages(faults), max(0, wanted.stop))):
            if index not in wanted:
                continue
            if message.damage is not None:
                if strict:
                    raise InputError(message.damage)
                faults.unreadable(InputError(message.damage))
            elif message.frame_id != self._frame_id:
                faults.leave_out(other_sensor, repr(message.frame_id))
            elif (stamp := self._stamps.stamp(message)) <= self._stamps.before_first:
                faults.leave_out(_NEVER_SET, f"{stamp:.9f}")
            else:
                yield message

    def _messages(self, faults: Faults) -> Iterator[BagMessage]:
        count, damages = 0, list[str]()

        def note(damage: str) -> None:
            damages.append(damage)
            faults.note(_DAMAGED, damage)

        for message in self._bag.messages(self._topic, note):
            count += 1
            yield message
        if not count:
            lists = f"{self._source}: its index lists {len(self)} messages of {self._topic.name}, it holds none;"
            remedy = " reindex it, or give one of its .db3 or .mcap files instead of the folder"
            raise InputError(damages[0] if damages else lists + remedy)
        if count < len(self):
            faults.leave_out(_MISSING, f"its index lists {len(self)} scans, it holds {count}", len(self) - count)

    def _sound(self) -> Iterator[BagMessage]:
        """The messages that have a header, to infer from; the others are counted when it is their turn."""
        return (message for message in self._bag.messages(self._topic) if message.damage is None)

    @cached_property
    def _frame_id(self) -> str:
        """The sensor that most of the first messages come from, unless another is asked for."""
        frames = Counter(m.frame_id for m in islice(self._sound(), _FRAMES_LOOKED_AT))
        wanted = self._config.frame_id
        if wanted is None:
            return max(frames, key=lambda frame: frames[frame], default="")
        if wanted not in frames:
            found = ", ".join(repr(frame) for frame in frames)
            raise InputError(
                f"{self._source}: reader.frame_id is {wanted!r}, but {self._topic.name} begins with {found}"
            )
        return wanted

    def _scan(self, message: BagMessage, faults: Faults) -> Scan:
        cloud, stamp = self._decode(message), self._stamps.stamp(message)
        offsets = self._point_time.offsets(cloud, stamp)
        return timed_scan(cloud, offsets, stamp, self._point_time.model is not None, faults)

    def _decode(self, message: BagMessage) -> DecodedCloud:
        return self._bag.decode(message, self._config.time_field)

    @cached_property
    def _stamps(self) -> StampSource:
        return find_stamp_source(self._sound())

    @cached_property
    def _last_stamp(self) -> float | None:
        last = self._bag.last_message(self._topic)
        return None if last is None else self._stamps.stamp(last)

    @cached_property
    def _point_time(self) -> BagPointTime:
        first, period_s = next(self._sound(), None), None
        if first is not None and self._last_stamp is not None and len(self) > 1:
            period_s = (self._last_stamp - self._stamps.stamp(first)) / (len(self) - 1)
        return BagPointTime(self._bag, self._topic, self._config, self._stamps, period_s)

    def describe(self) -> RecordingInfo:
        """Of the first readable scan; see `Recording`."""
        faults = Faults()
        messages = in_stamp_order(self._wanted(range(len(self)), faults), self._stamps.stamp, faults)
        try:
            message, first, unreadable = first_readable(self._source, messages, lambda item: self._scan(item, faults))
        except InputError as error:
            if not faults.left_out:
                raise
            raise InputError(f"{error}; {'; '.join(faults.warnings())}") from error
        cloud = self._decode(message)
        return RecordingInfo(
            reader="rosbag",
            scans=len(self),
            first=first,
            last_stamp=self._last_stamp or first.stamp,
            ground_truth=self._truth_file,
            point_time=self._point_time.model,
            topic=self._topic.name,
            topics=self._bag.topics,
            fields=cloud.fields,
            notes=(
                *self.warnings,
                *faults.warnings(),
                *unreadable.warnings(),
                *self._point_time.notes,
            ),
            imu=self._imu.summary(),
        )
