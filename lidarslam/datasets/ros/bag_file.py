"""Messages of rosbag1 and rosbag2 files; the only file that imports rosbags.

A file whose index cannot be read is read without it, as far as it goes. Point clouds are decoded with fixed
definitions, never with those in the bag: the definition of PointCloud2 has not changed, bags may lack definitions, and
a damaged or unusual definition of some other topic must not matter.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1.reader import decompressors as rosbag1_decompressors
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS as mcap_decompressors
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from lidarslam.core.errors import InputError
from lidarslam.datasets.recording import Topic
from lidarslam.datasets.ros.bag_salvage import Chunk, Place, Salvage, messages_from
from lidarslam.datasets.ros.livox import CUSTOM_MESSAGE_TYPES, decode_custom_message
from lidarslam.datasets.ros.point_cloud2 import DecodedCloud, PointCloud2Message, decode_point_cloud2

RosbagReader = Rosbag1Reader | Rosbag2Reader

POINT_CLOUD2_TYPE = "sensor_msgs/msg/PointCloud2"
CLOUD_TYPES = (POINT_CLOUD2_TYPE, *CUSTOM_MESSAGE_TYPES)

STORAGE_SUFFIXES = (".db3", ".mcap")

_LAST_MESSAGES_NS = 1_000_000_000
_LONGEST_FRAME_ID = 256
# Up to the end of a header's frame; a message that is shorter is none.
_SHORTEST_MESSAGE = 16


@dataclass(frozen=True)
class BagMessage:
    """One message as it stands in the bag.

    Attributes:
        record_ns: when it was recorded, nanoseconds.
        header_ns: the stamp of its header, nanoseconds.
        frame_id: of its header: the sensor it comes from.
        damage: why it is no message and has neither stamp nor frame; None where it is one.
    """

    record_ns: int
    header_ns: int
    frame_id: str
    message_type: str
    raw: bytes
    damage: str | None = None


class BagFile:
    """A rosbag1 `.bag`, a rosbag2 folder, or a single `.db3` or `.mcap`; opened for every pass, closed after it.

    Attributes:
        topics: what it holds.
        damage: why it is read without its index, as far as it goes; None when the index is sound.
    """

    def __init__(self, path: Path) -> None:
        """Read the index, or the whole file where that cannot be read.

        Raises:
            InputError: the bag is damaged so that nothing of it can be read, or it is of no readable kind.
        """
        self.path = path
        self._ros2 = path.is_dir() or not is_rosbag1(path)
        self._salvage: Salvage | None = None
        self._messages_are_compressed = False
        self.damage: str | None = None
        try:
            counts = self._read_index()
        except InputError as error:
            counts = self._read_file_alone(error)
        self.topics: tuple[Topic, ...] = tuple(Topic(*key, count) for key, count in sorted(counts.items()))

    def _read_index(self) -> dict[tuple[str, str], int]:
        counts: dict[tuple[str, str], int] = {}
        with self._opened() as reader, self._damage("its index cannot be read"):
            self._messages_are_compressed = getattr(reader, "compression_mode", None) == "message"
            for connection in reader.connections:
                key = (connection.topic, connection.msgtype)
                counts[key] = counts.get(key, 0) + connection.msgcount
        return counts

    def _read_file_alone(self, error: InputError) -> dict[tuple[str, str], int]:
        """Leave a folder's metadata aside, and a file's index too where it must be; the error stands if all fails."""
        file = self._storage_file()
        if file is None:
            raise error
        if file != self.path:
            self.path, folder = file, self.path
            self.damage = f"{folder}: its metadata.yaml is missing or damaged, so {file.name} was read by itself"
            with suppress(InputError):
                return self._read_index()
        try:
            salvage = Salvage(file, file.suffix if self._ros2 else ".bag", _expand)
        except Exception as reason:  # not even the beginning makes sense
            raise error from reason
        if not salvage.counts:
            raise error
        self._salvage = salvage
        damage = "" if salvage.damage is None else f": {salvage.damage}"
        self.damage = (
            f"{file}: has no index that can be read, so its {salvage.counts.total()} messages were read one after"
            f" another as far as they go{damage}; {self._remedy()}"
        )
        return dict(salvage.counts)

    def _storage_file(self) -> Path | None:
        """The one file with the messages; None when a folder has several, whose order only its index tells."""
        if not self.path.is_dir():
            return self.path if not self._ros2 or self.path.suffix in STORAGE_SUFFIXES else None
        files = [entry for entry in self.path.iterdir() if entry.suffix in STORAGE_SUFFIXES and entry.is_file()]
        return files[0] if len(files) == 1 else None

    def messages(self, topic: Topic, on_damage: Callable[[str], None] = lambda _: None) -> Iterator[BagMessage]:
        """All messages of a topic in the order they were recorded, not decoded.

        Damaged places are told and passed over, as far as the index says what is behind them.

        Raises:
            InputError: the bag is damaged so that nothing can be read, or nothing behind the damage could be.
        """
        if self._salvage is not None:
            yield from self._salvaged(self._salvage, topic)
            return
        number, first = 0, None

        def meet(damage: str) -> None:
            nonlocal first
            first = first or damage
            on_damage(damage)

        with self._opened() as reader:
            for storage in _storages(reader):
                for message in self._past_damage(storage, topic, number, meet):
                    number += 1
                    yield message
        if first is not None and not number:
            raise InputError(first)

    def _past_damage(
        self, storage: Any, topic: Topic, before: int, on_damage: Callable[[str], None]
    ) -> Iterator[BagMessage]:
        """Those in one file; `before` is how many there were in those before it."""
        last_ns, repeated = -1, 0
        try:
            for message in self._stream(storage, topic, None, before):
                yield message
                repeated = repeated + 1 if message.record_ns == last_ns else 1
                last_ns = message.record_ns
            return
        except InputError as error:
            on_damage(str(error))
        for message in self._behind(storage, topic, last_ns, on_damage):
            if message.record_ns < last_ns:
                continue
            if message.record_ns == last_ns and repeated:  # had already
                repeated -= 1
                continue
            yield message

    def _behind(
        self, storage: Any, topic: Topic, since_ns: int, on_damage: Callable[[str], None]
    ) -> Iterator[BagMessage]:
        """What is left since the time of some damage, which is the first that is met again, and was told."""
        met: list[str] = []

        def meet(damage: str) -> None:
            if met:
                on_damage(damage)
            met.append(damage)

        suffix = storage.path.suffix if self._ros2 else ".bag"
        chunks = _chunks(storage, _of_topic(storage.connections, topic), since_ns)
        place = Place(storage.path, suffix, _named(storage.connections), chunks)
        for message in messages_from(place, (topic.name, topic.message_type), _expand, meet):
            yield self._message(message.record_ns, message.raw, topic)

    def _salvaged(self, salvage: Salvage, topic: Topic) -> Iterator[BagMessage]:
        with closing(salvage.messages(topic.name, topic.message_type)) as messages:
            for message in messages:
                yield self._message(message.record_ns, message.raw, topic)

    def last_message(self, topic: Topic) -> BagMessage | None:
        """The message of a topic recorded last, found from the end of the bag; None if there is none."""
        if self._salvage is not None:
            return self._last_of_all(topic)
        try:
            return self._last_by_index(topic)
        except InputError:  # damaged there
            return self._last_of_all(topic)

    def _last_of_all(self, topic: Topic) -> BagMessage | None:
        last = None
        for message in self.messages(topic):
            last = message if message.damage is None else last
        return last

    def _last_by_index(self, topic: Topic) -> BagMessage | None:
        with self._opened() as reader:
            with self._damage("its index cannot be read"):
                end_ns, length_ns = reader.end_time, reader.duration
            look_back_ns = _LAST_MESSAGES_NS
            while True:
                last = None
                for storage in _storages(reader):
                    for message in self._stream(storage, topic, end_ns - look_back_ns):
                        last = message if message.damage is None else last
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

    def _stream(self, storage: Any, topic: Topic, start_ns: int | None, count: int = 0) -> Iterator[BagMessage]:
        """Those in one file by its index, since a time; `count` is how many there were before, for the error."""
        connections = _of_topic(storage.connections, topic)
        if not connections:  # another file of the folder has them
            return
        source = storage.messages(connections, start=start_ns)
        while True:
            with self._damage(f"reading stopped after {count} messages of {topic.name}"):
                try:
                    _, record_ns, raw = next(source)
                except StopIteration:
                    return
                message = self._message(record_ns, raw, topic)
            count += 1
            yield message

    def _message(self, record_ns: int, raw: bytes, topic: Topic) -> BagMessage:
        """With the header's stamp and frame, which stand at fixed places; looking there spares decoding the message."""
        damage = None
        if self._messages_are_compressed:
            try:
                raw = _expand("zstd", raw, 0)
            except Exception as error:  # codecs raise nearly anything
                damage = f"a compressed message is damaged ({' '.join(str(error).split())})"
        damage = damage or self._why_no_message(raw)
        if damage is not None:
            return BagMessage(record_ns, 0, "", topic.message_type, b"", f"{self.path}: {damage}")
        if self._ros2:
            seconds, nanoseconds, characters = struct.unpack_from("<iII" if raw[1] == 1 else ">iII", raw, 4)
        else:
            seconds, nanoseconds, characters = struct.unpack_from("<III", raw, 4)
        frame_id = raw[16 : 16 + min(characters, _LONGEST_FRAME_ID)].rstrip(b"\0").decode(errors="replace")
        return BagMessage(record_ns, int(seconds) * 10**9 + int(nanoseconds), frame_id, topic.message_type, raw)

    def _why_no_message(self, raw: bytes) -> str | None:
        if not isinstance(raw, bytes):  # a database holds whatever stands in its rows
            return "a message that is no bytes"
        if len(raw) < _SHORTEST_MESSAGE:
            return f"a message of {len(raw)} bytes, too few for its header"
        if self._ros2 and raw[0] != 0:
            return (
                "it is not plain CDR; if the bag's messages are compressed, give the rosbag2 folder with its"
                " metadata.yaml instead of the file"
            )
        return None

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
            whole = next(iter(sorted(self.path.glob("*.zstd"))), None)
            if whole is not None:  # so much of it is a file by itself, which is read as far as it goes
                return f"try `zstd -dc {whole} > {whole.with_suffix('')}` and give that file, or copy the bag again"
            return f"try `ros2 bag reindex {self.path}`, or give one of its .db3 or .mcap files instead of the folder"
        suffix = self.path.suffix if self._ros2 else ".bag"
        return {
            ".bag": f"try `rosbag reindex {self.path}`, or copy the bag again",
            ".mcap": f"try `mcap recover {self.path} -o recovered.mcap`, or copy the bag again",
            ".db3": f"try `sqlite3 {self.path} .recover | sqlite3 recovered.db3`, or copy the bag again",
        }.get(suffix, "readable are .bag, .db3, .mcap and rosbag2 folders with a metadata.yaml")


def _named(connections: Sequence[Connection]) -> dict[int, tuple[str, str]]:
    return {connection.id: (connection.topic, connection.msgtype) for connection in connections}


def _storages(reader: RosbagReader) -> list[Any]:
    """What reads the single files of a bag: all have a path, connections and messages, and those of MCAP chunks."""
    if isinstance(reader, Rosbag1Reader):
        return [reader]
    return getattr(reader.storage, "storages", None) or [reader.storage]


def _of_topic(connections: Sequence[Connection], topic: Topic) -> list[Connection]:
    return [one for one in connections if (one.topic, one.msgtype) == (topic.name, topic.message_type)]


def _chunks(storage: Any, connections: Sequence[Connection], since_ns: int) -> list[Chunk] | None:
    """Those with messages of these connections recorded since a time, by the index; None where there is none."""
    if isinstance(storage, Rosbag1Reader):
        starts: dict[int, int] = {}
        for connection in connections:
            for entry in storage.indexes[connection.id]:
                if entry.time >= since_ns:
                    starts[entry.chunk_pos] = min(entry.time, starts.get(entry.chunk_pos, entry.time))
        return [Chunk(start_ns, begin) for begin, start_ns in starts.items()]
    infos = getattr(storage, "chunks", None)
    if not infos:
        return None
    return [
        Chunk(info.message_start_time, info.chunk_start_offset)
        for info in infos
        if info.message_end_time >= since_ns and any(info.channel_count.get(one.id) for one in connections)
    ]


@cache
def _typestore(ros2: bool) -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)


def is_rosbag1(path: Path) -> bool:
    """Whether a file is called like a bag of ROS 1; a recorder that was killed leaves `.bag.active`."""
    return path.name.endswith((".bag", ".bag.active"))


def _expand(compression: str, data: bytes, size: int) -> bytes:
    if compression in mcap_decompressors:
        return mcap_decompressors[compression](data, size)
    return rosbag1_decompressors[compression](data)
