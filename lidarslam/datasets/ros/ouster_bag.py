"""Packets of an Ouster in a bag, as ouster_ros records them, with the metadata in a topic or next to the bag."""

import struct
from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.packets.ouster import (
    OusterRecording,
    find_metadata,
    frames_of_packets,
    imu_packets,
    read_sensor,
)
from lidarslam.datasets.recording import Topic
from lidarslam.datasets.ros.bag_file import BagFile

_STRING_TYPE = "std_msgs/msg/String"


class OusterBag(OusterRecording):
    """The packets of one `lidar_packets` topic."""

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

    def _items(self, wanted: range, faults: Faults, strict: bool) -> Iterator[Any]:  # noqa: ARG002
        contents = self._contents(self._topic.name.rpartition("/")[2], self._topic.message_type)
        return islice(frames_of_packets(self.sensor, contents), wanted.start, wanted.stop, wanted.step)

    def _packets_of_imu(self) -> Iterator[Any]:
        return imu_packets(self.sensor, self._contents("imu_packets", self._topic.message_type))

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
