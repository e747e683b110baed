"""Messages of rosbag1 and rosbag2 files; the only file that imports rosbags.

Point clouds are decoded with fixed definitions, never with those in the bag: the definition of PointCloud2 has not
changed, bags may lack definitions, and a damaged or unusual definition of some other topic must not matter.
"""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import cast

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from lidarslam.core.errors import InputError
from lidarslam.datasets.livox import CUSTOM_MESSAGE_TYPES, decode_custom_message
from lidarslam.datasets.point_cloud2 import DecodedCloud, PointCloud2Message, decode_point_cloud2
from lidarslam.datasets.recording import Topic

RosbagReader = Rosbag1Reader | Rosbag2Reader

POINT_CLOUD2_TYPE = "sensor_msgs/msg/PointCloud2"
CLOUD_TYPES = (POINT_CLOUD2_TYPE, *CUSTOM_MESSAGE_TYPES)

_LAST_MESSAGES_NS = 1_000_000_000


@dataclass(frozen=True)
class BagMessage:
    """One message as it stands in the bag.

    Attributes:
        record_ns: when it was recorded, nanoseconds.
        header_ns: the stamp of its header, nanoseconds.
    """

    record_ns: int
    header_ns: int
    message_type: str
    raw: bytes


class BagFile:
    """A rosbag1 `.bag`, a rosbag2 folder, or a single `.db3` or `.mcap`; opened for every pass, closed after it."""

    def __init__(self, path: Path) -> None:
        """Read the index.

        Raises:
            InputError: the bag is damaged, has no index, or is of no readable kind.
        """
        self.path = path
        self._ros2 = path.suffix != ".bag" or path.is_dir()
        with self._opened() as reader, self._damage("its index cannot be read"):
            counts: dict[tuple[str, str], int] = {}
            for connection in reader.connections:
                key = (connection.topic, connection.msgtype)
                counts[key] = counts.get(key, 0) + connection.msgcount
            self.topics: tuple[Topic, ...] = tuple(Topic(*key, count) for key, count in sorted(counts.items()))

    def messages(self, topic: Topic) -> Iterator[BagMessage]:
        """All messages of a topic in the order they were recorded, not decoded.

        Raises:
            InputError: the bag is damaged, at the message where it is.
        """
        with self._opened() as reader:
            yield from self._stream(reader, topic, None)

    def last_message(self, topic: Topic) -> BagMessage | None:
        """The message of a topic recorded last, found from the end of the bag; None if there is none."""
        with self._opened() as reader:
            with self._damage("its index cannot be read"):
                end_ns, length_ns = reader.end_time, reader.duration
            look_back_ns = _LAST_MESSAGES_NS
            while True:
                last = None
                for message in self._stream(reader, topic, end_ns - look_back_ns):
                    last = message
                if last is not None or look_back_ns > length_ns:
                    return last
                look_back_ns *= 8

    def decode(self, message: BagMessage, time_field: str | None = None) -> DecodedCloud:
        """Decode a message of one of the `CLOUD_TYPES`.

        Raises:
            InputError: the message is damaged or lacks a field.
        """
        with self._damage("a point cloud cannot be decoded"):
            try:
                if message.message_type in CUSTOM_MESSAGE_TYPES:
                    return decode_custom_message(message.raw, self._ros2)
                store = _typestore(self._ros2)
                deserialize = store.deserialize_cdr if self._ros2 else store.deserialize_ros1
                cloud = cast(PointCloud2Message, deserialize(message.raw, POINT_CLOUD2_TYPE))
                return decode_point_cloud2(cloud, time_field)
            except InputError as error:
                raise InputError(f"{self.path}: {error}") from error

    @contextmanager
    def _opened(self) -> Iterator[RosbagReader]:
        with self._damage("it cannot be opened"):
            reader = Rosbag2Reader(self.path) if self._ros2 else Rosbag1Reader(self.path)
            reader.open()
        try:
            yield reader
        finally:
            reader.close()

    def _stream(self, reader: RosbagReader, topic: Topic, start_ns: int | None) -> Iterator[BagMessage]:
        connections: Sequence[Connection] = [
            connection
            for connection in reader.connections
            if (connection.topic, connection.msgtype) == (topic.name, topic.message_type)
        ]
        source = reader.messages(connections, start=start_ns)
        count = 0
        while True:
            with self._damage(f"reading stopped after {count} messages of {topic.name}"):
                try:
                    _, record_ns, raw = next(source)
                except StopIteration:
                    return
                message = BagMessage(record_ns, self._header_ns(raw), topic.message_type, raw)
            count += 1
            yield message

    def _header_ns(self, raw: bytes) -> int:
        """The header's stamp, which stands at a fixed place; looking there spares decoding the message."""
        if self._ros2:
            if raw[0] != 0:
                raise InputError(
                    f"{self.path}: its messages are not plain CDR; if they are compressed, give the rosbag2 folder with"
                    f" its metadata.yaml instead of the file"
                )
            seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] == 1 else ">iI", raw, 4)
        else:
            seconds, nanoseconds = struct.unpack_from("<II", raw, 4)
        return int(seconds) * 10**9 + int(nanoseconds)

    @contextmanager
    def _damage(self, what: str) -> Iterator[None]:
        """Damaged files make rosbags raise nearly anything: its own errors, assertions, KeyError, struct.error."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"{self.path}: {what} ({reason}); {self._remedy()}") from error

    def _remedy(self) -> str:
        if self.path.is_dir():
            return f"try `ros2 bag reindex {self.path}`, or give one of its .db3 or .mcap files instead of the folder"
        return {
            ".bag": f"try `rosbag reindex {self.path}`, or copy the bag again",
            ".mcap": f"try `mcap recover {self.path} -o recovered.mcap`, or copy the bag again",
            ".db3": f"try `sqlite3 {self.path} .recover | sqlite3 recovered.db3`, or copy the bag again",
        }.get(self.path.suffix, "readable are .bag, .db3, .mcap and rosbag2 folders with a metadata.yaml")


@cache
def _typestore(ros2: bool) -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)
