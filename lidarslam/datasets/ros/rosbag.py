"""Point clouds of a rosbag: rosbag1, rosbag2 (SQLite or MCAP), as PointCloud2, Livox CustomMsg or packets."""

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.imu import ImuSamples
from lidarslam.core.plugins import require_library
from lidarslam.core.scan import Scan
from lidarslam.datasets.cloud_recording import CloudRecording
from lidarslam.datasets.config import ReaderConfig, TimeReference, TimeUnit
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.packets.ouster import OusterRecording, find_metadata, frames_of_packets, packets_of, read_sensor
from lidarslam.datasets.packets.velodyne import VelodyneCapture
from lidarslam.datasets.point_table import RawCloud
from lidarslam.datasets.recording import (
    ImuSummary,
    Recording,
    SeveralTopicsError,
    Topic,
    storage_files,
    truth_beside,
)
from lidarslam.datasets.ros.bag_file import BagFile
from lidarslam.datasets.ros.bag_imu import choose_imu, read_imu
from lidarslam.datasets.ros.bag_message import (
    CLOUD_TYPES,
    CUSTOM_MESSAGE_TYPES,
    OUSTER_PACKET_TYPES,
    TIME_UNIT,
    VELODYNE_SCAN_TYPE,
    BagMessage,
    StampSource,
    find_stamp_source,
)
from lidarslam.datasets.ros.split_bag import open_bag
from lidarslam.datasets.times.stamps import in_stamp_order

_STRING_TYPE = "std_msgs/msg/String"
_TOPICS_LISTED = 20
# As a share of one topic's messages, the most of all others together if these are no recordings: occasional maps.
_NEGLIGIBLE = 0.05
# Number of pairs of messages that are compared at their seams, spread over this many of the first.
_PAIRS, _LOOKED_AT = 40, 600
_FRAMES_LOOKED_AT, _STAMPS_LOOKED_AT = 10, 20
# Enough for the median of the IMU's rate.
_SAMPLES_LOOKED_AT = 200

_DAMAGED = "damaged places in the bag were met, where reading its file stopped"
_MISSING = "scans are missing that the index lists"
_NO_HEADER_STAMPS = "The message headers have no stamps, so the times of recording are used."
_NEVER_SET = "scans were left out: their stamps were never set"


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a rosbag1 `.bag`, a rosbag2 folder, a single `.db3` or `.mcap`, or a folder of several of one recording."""
    bag = open_bag(source)
    topic = choose_topic(source, bag.topics, config.topic)
    if topic.message_type in OUSTER_PACKET_TYPES:
        return OusterBag(source, config, bag, topic)
    if topic.message_type == VELODYNE_SCAN_TYPE:
        require_library(*VelodyneCapture.library)
    return BagRecording(source, config, bag, topic)


class BagRecording(CloudRecording):
    """The messages of one point cloud topic.

    Stamps are those of the message headers, or, where no header has one, the times of recording. A message of another
    sensor, or one whose stamp is not after those before it, keeps its index but makes no scan; such are counted.
    """

    reader = "rosbag"

    def __init__(self, source: Path, config: ReaderConfig, bag: BagFile, topic: Topic) -> None:
        super().__init__(source, config)
        self._bag = bag
        self._topic = topic
        self.topic, self.topics = topic.name, bag.topics
        self._facts_of_source = bag.notes
        self._truth_path = truth_beside(source, self.name)

    @property
    def frames(self) -> tuple[BagFile, str]:
        """The bag, and the frame of its clouds."""
        return self._bag, self._frame_id

    @property
    def _stored_scans(self) -> int:
        return self._topic.messages

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The samples of the IMU topic nearest to the clouds', unless another is asked for."""
        topic = self._imu_topic
        return None if topic is None else read_imu(self._bag, topic, self._frame_id, self._stamps)

    @cached_property
    def _imu_topic(self) -> Topic | None:
        return choose_imu(self._bag, self._topic.name, self._frame_id, self._config.imu_topic)

    def _imu_summary(self) -> ImuSummary | None:
        """By the first samples; their number is in the index."""
        if (topic := self._imu_topic) is None:
            return None
        first = read_imu(self._bag, topic, self._frame_id, self._stamps, _SAMPLES_LOOKED_AT)
        return None if first is None else replace(ImuSummary.of(topic.name, first), samples=topic.messages)

    @cached_property
    def _faults_of_source(self) -> tuple[str, ...]:
        others = _others_left_out(self._bag.topics, self._topic) if self._config.topic is None else None
        unset = None if self._stamps.from_header else _NO_HEADER_STAMPS
        found = (others, self._bag.damage, unset, _one_part(self._source))
        return tuple(warning for warning in found if warning is not None)

    def _items(self, wanted: range, faults: Faults) -> Iterator[BagMessage]:
        return in_stamp_order(self._wanted(wanted, faults), self._stamp, faults)

    def _wanted(self, wanted: range, faults: Faults) -> Iterator[BagMessage]:
        other_sensor = (
            f"scans were left out: they come from another sensor than {self._frame_id!r}; for that one set"
            " reader.frame_id"
        )
        for index, message in enumerate(islice(self._messages(wanted, faults), max(0, wanted.stop))):
            if index not in wanted:
                continue
            if message.damage is not None:
                faults.unreadable(InputError(message.damage))
            elif message.frame_id != self._frame_id:
                faults.leave_out(other_sensor, repr(message.frame_id))
            elif (stamp := self._stamp(message)) <= self._stamps.before_first:
                faults.leave_out(_NEVER_SET, f"{stamp:.9f}")
            else:
                yield message

    def _messages(self, wanted: range, faults: Faults) -> Iterator[BagMessage]:
        count, damages = 0, list[str]()

        def note(damage: str) -> None:
            damages.append(damage)
            faults.note(_DAMAGED, damage)

        for count, message in enumerate(self._bag.messages(self._topic, note), 1):  # noqa: B007 - the last one counts
            yield message
        if not count:
            lists = (
                f"{self._source}: its index lists {self._stored_scans} messages of {self._topic.name}, it holds none;"
            )
            remedy = " reindex it, or give one of its .db3 or .mcap files instead of the folder"
            raise InputError(damages[0] if damages else lists + remedy)
        if missing := sum(index >= count for index in wanted):
            held = f"its index lists {self._stored_scans} scans, it holds {count}"
            faults.leave_out(_MISSING, held, missing, is_readable=False)

    def _of_any_sensor(self) -> Iterator[BagMessage]:
        return (message for message in self._bag.messages(self._topic) if message.damage is None)

    def _sound_items(self) -> Iterator[BagMessage]:
        return (message for message in self._of_any_sensor() if message.frame_id == self._frame_id)

    @cached_property
    def _frame_id(self) -> str:
        """The sensor that most of the first messages come from, unless another is asked for."""
        frames = Counter(m.frame_id for m in islice(self._of_any_sensor(), _FRAMES_LOOKED_AT))
        wanted = self._config.frame_id
        if wanted is None:
            return max(frames, key=lambda frame: frames[frame], default="")
        if wanted not in frames and not any(m.frame_id == wanted for m in self._of_any_sensor()):
            found = ", ".join(repr(frame) for frame in frames)
            raise InputError(
                f"{self._source}: reader.frame_id is {wanted!r}, but {self._topic.name} begins with {found}"
            )
        return wanted

    def _decode(self, item: BagMessage) -> RawCloud:
        return self._bag.decode(item, self._config.time_field)

    @cached_property
    def _stamps(self) -> StampSource:
        return find_stamp_source(self._of_any_sensor())

    def _stamp(self, item: BagMessage) -> float:
        return self._stamps.stamp(item)

    def _last_stamp(self, first: Scan) -> float:
        return self._last_recorded_stamp or first.stamp

    @cached_property
    def _last_recorded_stamp(self) -> float | None:
        last = self._bag.last_message(self._topic)
        return None if last is None else self._stamp(last)

    @cached_property
    def period_s(self) -> float | None:
        """The median interval of the first stamps that increase, seconds."""
        stamps = np.array([self._stamp(message) for message in islice(self._sound_items(), _STAMPS_LOOKED_AT)])
        steps = np.diff(stamps[stamps > self._stamps.before_first])
        return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else None

    @property
    def _defined_time(self) -> tuple[TimeUnit, TimeReference, TimeUnit | None]:
        if self._topic.message_type == VELODYNE_SCAN_TYPE:
            return "ns", "absolute", None  # as they are decoded
        if self._topic.message_type in CUSTOM_MESSAGE_TYPES:
            return self._config.time_unit, "absolute", TIME_UNIT
        return super()._defined_time

    def _runs(self) -> Iterator[tuple[BagMessage, BagMessage]]:
        apart = max(2, min(self._topic.messages, _LOOKED_AT) // _PAIRS)
        return islice(pairwise(islice(self._sound_items(), _LOOKED_AT)), 0, None, apart)


class OusterBag(OusterRecording):
    """The packets of an Ouster in one `lidar_packets` topic, as ouster_ros records them.

    The sensor's metadata is in a topic or next to the bag.
    """

    reader = "rosbag"

    def __init__(self, source: Path, config: ReaderConfig, bag: BagFile, topic: Topic) -> None:
        super().__init__(source, config)
        self._bag = bag
        self._topic = topic
        self.topic, self.topics = topic.name, bag.topics
        self.warnings = () if bag.damage is None else (bag.damage,)

    @cached_property
    def sensor(self) -> Any:
        """See `OusterRecording`."""
        if (text := next(self._contents("metadata", _STRING_TYPE), None)) is not None:
            return read_sensor(text.decode(errors="replace"))
        if (beside := find_metadata(self._source)) is not None:
            return read_sensor(beside.read_text(encoding="utf-8", errors="replace"))
        raise InputError(
            f"{self._source}: {self.topic} holds packets of an Ouster, which need the sensor's metadata; put it"
            f" beside the bag as {self.name}.json"
        )

    def _items(self, wanted: range, faults: Faults) -> Iterator[Any]:  # noqa: ARG002
        contents = self._contents(self._topic.name.rpartition("/")[2], self._topic.message_type)
        return islice(frames_of_packets(self.sensor, contents), wanted.start, wanted.stop, wanted.step)

    def _packets_of_imu(self) -> Iterator[Any]:
        return packets_of("imu", self.sensor, self._contents("imu_packets", self._topic.message_type))

    def _contents(self, name: str, message_type: str) -> Iterator[bytes]:
        """The content of the messages of a topic other than that of the packets: a single string or array of bytes."""
        beside = f"{self._topic.name.rpartition('/')[0]}/{name}"
        topic = next((t for t in self._bag.topics if (t.name, t.message_type) == (beside, message_type)), None)
        for message in self._bag.messages(topic) if topic is not None else ():
            start = 8 if self._bag.ros2 else 4
            order = ">" if self._bag.ros2 and message.raw[1:2] == b"\x00" else "<"
            if len(message.raw) >= start:
                (length,) = struct.unpack_from(order + "I", message.raw, start - 4)
                yield message.raw[start : start + length].rstrip(b"\0" if message_type == _STRING_TYPE else b"")


def choose_topic(source: Path, topics: Sequence[Topic], wanted: str | None) -> Topic:
    """The wanted point cloud topic, or the only one with many messages; without clouds, the only one of packets."""
    clouds = [topic for topic in topics if topic.message_type in CLOUD_TYPES and topic.messages]
    packets = [topic for topic in topics if _has_packets(topic) and topic.messages]
    if wanted is not None:
        named = [topic for topic in topics if topic.name.lstrip("/") == wanted.lstrip("/")]
        if chosen := next((topic for topic in named if topic in clouds + packets), None):
            return chosen
        found = f"holds {_listing(named)}, which is no point cloud" if named else f"has no topic {wanted!r}"
        raise InputError(f"{source}: {found}; its point cloud topics: {_listing(clouds)}")
    clouds = clouds or packets
    most = max(clouds, key=lambda topic: topic.messages, default=None)
    if most is not None and sum(topic.messages for topic in clouds) <= (1.0 + _NEGLIGIBLE) * most.messages:
        return most
    if clouds:
        message = f"{source}: several point cloud topics, choose one with --topic: {_listing(clouds)}"
        raise SeveralTopicsError(message, clouds, topics)
    if not any(topic.messages for topic in topics):
        raise InputError(f"{source}: the bag is empty, expected messages of a point cloud topic; record it again")
    hint = ""
    if any(topic.message_type.replace("/", "/msg/") in CLOUD_TYPES for topic in topics):
        hint = " Its messages are those of ROS 1, which are read from a .bag alone: give the one it was converted from."
    raise InputError(
        f"{source}: no point cloud topic (sensor_msgs/PointCloud2 or Livox CustomMsg) with messages; packets of other"
        f" sensors are not decoded.{hint} Its topics: {_listing(topics)}"
    )


def _others_left_out(topics: Sequence[Topic], chosen: Topic) -> str | None:
    """A sentence where a bag has point clouds on other topics than the chosen one."""
    others = [t for t in topics if t.message_type in CLOUD_TYPES and t.messages and t.name != chosen.name]
    named = ", ".join(f"{topic.name} ({topic.messages})" for topic in others[:_TOPICS_LISTED])
    return f"{chosen.name} is read; {named} with few messages left out: choose with --topic." if others else None


def _has_packets(topic: Topic) -> bool:
    is_lidar = "lidar" in topic.name.rpartition("/")[2]  # packets of the IMU have the same type
    return topic.message_type == VELODYNE_SCAN_TYPE or (topic.message_type in OUSTER_PACKET_TYPES and is_lidar)


def _one_part(source: Path) -> str | None:
    """A sentence where a file is one of several of a rosbag2."""
    folder = source.absolute().parent
    parts = storage_files(folder) if source.is_file() and (folder / "metadata.yaml").is_file() else []
    return f"This file is one of {len(parts)} parts of the bag {folder}; name the folder." if len(parts) > 1 else None


def _listing(topics: Sequence[Topic]) -> str:
    words = [f"{topic.name} ({topic.message_type}, {topic.messages} messages)" for topic in topics[:_TOPICS_LISTED]]
    if len(topics) > _TOPICS_LISTED:
        words.append(f"and {len(topics) - _TOPICS_LISTED} more")
    return ", ".join(words) or "none"
