"""Messages of rosbag1 and rosbag2 files, by rosbags; a file whose index cannot be read is read without it.

Layouts: ROS bag format 2.0 (wiki.ros.org/Bags/Format/2.0), MCAP (mcap.dev/spec), rosbag2's SQLite tables. They are read
here where there is no index, as after a crash of the recorder, because rosbags needs one, and `StreamReader` of mcap
1.6 loses a chunk that is cut off and accepts cut records.
"""

import sqlite3
import struct
from bz2 import BZ2Decompressor
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from functools import cached_property
from io import BytesIO, RawIOBase
from itertools import chain, count, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO
from urllib.parse import quote

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1.reader import Compression, Header, RecordType, decompressors, normalize, read_uint32
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2 import reader as rosbag2_reader
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS, decompress, read_exact, read_string, zstd  # type: ignore[attr-defined] # Python's, or as in Python
from rosbags.typesys.msg import normalize_msgtype

from lidarslam.core.errors import InputError
from lidarslam.core.files import reading
from lidarslam.core.text import reason
from lidarslam.datasets.point_table import RawCloud
from lidarslam.datasets.recording import ROSBAG1_SUFFIXES, Topic
from lidarslam.datasets.ros.bag_message import BagMessage, decode, read_header

Recovered = tuple[str, str, int, bytes]
"""Topic, type as in ROS 2, time of recording in nanoseconds, and bytes of a message."""
# Recorders write chunks of 1 to 16 MB, and a cloud of two million points has some 100 MB.
MOST_BYTES = 1 << 28
# Largest ratio of decompression of a file that is compressed as a whole; that of clouds is below twenty.
_MOST_GROWTH = 100
_LAST_MESSAGES_NS = 1_000_000_000
_REPAIR = {
    ".bag": "rosbag reindex {}",
    ".mcap": "mcap recover {} -o recovered.mcap",
    ".db3": "sqlite3 {} .recover | sqlite3 recovered.db3",
}
# Records are read whole; a longer one is a damaged length.
_LONGEST_RECORD = 1 << 30
# Opcodes of MCAP.
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
MCAP_MAGIC, _ROSBAG1_MAGIC = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n"
# A damaged database may hold anything for a name.
_TOPICS = "SELECT id, name, type FROM topics WHERE typeof(name) = 'text' AND typeof(type) = 'text'"
# By the table itself, because the pages of its index are at the end.
_ROWS = "SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id"


def unpacked(data: bytes, make: Callable[[], Any]) -> bytes:
    """The content of compressed frames, one after the other; ValueError where they are cut short or hold too much."""
    frames, size = [], 0
    while data:
        decompressor = make()
        frames.append(decompressor.decompress(data, MOST_BYTES + 1 - size))
        size += len(frames[-1])
        if size > MOST_BYTES:
            raise ValueError(
                f"{len(data):,} bytes unpack to more than {MOST_BYTES >> 20} MB, which no chunk or message has"
            )
        if not decompressor.eof:
            raise ValueError("the compressed data are cut short")
        data = decompressor.unused_data or b""
    return b"".join(frames)


def unpacked_message(data: bytes) -> bytes:
    """A message of a rosbag2 with compression per message, or a chunk: frames of Zstandard."""
    return unpacked(data, zstd.ZstdDecompressor)


class _UnpackedFile(RawIOBase):
    """A file compressed by Zstandard as a whole."""

    def __init__(self, file: BinaryIO, _mode: str) -> None:
        self._name, self._left = file.name, MOST_BYTES + _MOST_GROWTH * file.seek(0, 2)
        file.seek(0)
        self._file = zstd.open(file, "rb")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(len(buffer))
        self._left -= len(data)
        if self._left < 0:
            raise InputError(f"{self._name}: unpacks to more than {_MOST_GROWTH} times its size, as no recording does")
        buffer[: len(data)] = data
        return len(data)


rosbag2_reader.zstd = SimpleNamespace(open=_UnpackedFile, decompress=unpacked_message)  # type: ignore[attr-defined,assignment]
DECOMPRESSORS["lz4"] = lambda data, _: unpacked(data, LZ4FrameDecompressor)
DECOMPRESSORS["zstd"] = lambda data, _: unpacked_message(data)
decompressors[Compression.LZ4.value] = lambda data: unpacked(data, LZ4FrameDecompressor)
decompressors[Compression.BZ2.value] = lambda data: unpacked(data, BZ2Decompressor)


class BagFile:
    """A rosbag1 `.bag`, a rosbag2 folder, or a single `.db3` or `.mcap`; opened for every pass, closed after it.

    Attributes:
        topics: with their numbers of messages.
        ros2: whether its messages are of ROS 2.
        damage: why it is read without its index or metadata; None when they are sound.
        span_ns: time of recording of the first message, and one behind that of the last; without any, the end is 0.
        notes: how it is read otherwise, one sentence each.
    """

    notes: tuple[str, ...] = ()

    def __init__(self, path: Path) -> None:
        log = _left_in_log(path)
        if path.is_file() and not path.stat().st_size:
            raise InputError(log or f"{path}: is empty, 0 bytes; copy the bag again")
        self.path = path
        self.ros2 = not path.name.endswith(ROSBAG1_SUFFIXES)
        self._has_index = True
        self._messages_are_compressed = False
        self.damage: str | None = None
        self.span_ns = (2**63 - 1, 0)
        try:
            counts = self._read_index()
        except InputError as error:
            counts = self._read_without_index(error)
        if log is not None and not counts.total():
            raise InputError(log)
        self.damage = "; ".join(filter(None, (self.damage, log))) or None
        self.topics: tuple[Topic, ...] = tuple(Topic(*key, count) for key, count in sorted(counts.items()))

    def _read_index(self) -> Counter[tuple[str, str]]:
        counts: Counter[tuple[str, str]] = Counter()
        with self._opened() as reader, self._damage("its index cannot be read"):
            self._messages_are_compressed = getattr(reader, "compression_mode", None) == "message"
            for connection in reader.connections:
                if not (isinstance(connection.topic, str) and isinstance(connection.msgtype, str)):
                    raise ValueError("a topic without a name or type")  # a database may hold anything there
                counts[connection.topic, connection.msgtype] += connection.msgcount
            self.span_ns = (reader.start_time, reader.end_time)
        return counts

    def _read_without_index(self, error: InputError) -> Counter[tuple[str, str]]:
        """Read the messages one after another; the error remains if there is none."""
        counts, why = Counter[tuple[str, str]](), ""
        try:
            for name, message_type, record_ns, _ in recover(self.path, self._suffix()):
                counts[name, message_type] += 1
                self.span_ns = (min(self.span_ns[0], record_ns), max(self.span_ns[1], record_ns + 1))
        except Exception as broken:  # perhaps not even the beginning can be read
            why = f": {reason(broken)}"
        if not counts:
            raise error
        self._has_index = False
        self.damage = (
            f"{self.path}: has no index that can be read, so its {counts.total()} messages were read one after another"
            f" as far as they go{why}; {self._remedy}"
        )
        return counts

    def messages(self, topic: Topic, on_damage: Callable[[str], None] = lambda _: None) -> Iterator[BagMessage]:
        """All messages of a topic in the order of recording, not decoded; of each file up to its damage."""
        if not self._has_index:
            yield from self._in_sequence(topic)
            return
        try:
            with self._opened() as reader:
                for storage in _storages(reader):
                    try:
                        yield from self._by_index(storage, topic)
                    except InputError as error:
                        on_damage(str(error))
        except InputError as error:  # gone since its index was read
            on_damage(str(error))

    def _by_index(self, storage: Any, topic: Topic, start_ns: int | None = None) -> Iterator[BagMessage]:
        named = (topic.name, topic.message_type)
        connections = [each for each in storage.connections if (each.topic, each.msgtype) == named]
        messages = storage.messages(connections, start=start_ns) if connections else iter(())
        for number in count():
            with self._damage(f"reading stopped after {number} messages of {topic.name}"):
                found = next(messages, None)
            if found is None:
                return
            yield self._message(found[1], found[2], topic)

    def _in_sequence(self, topic: Topic) -> Iterator[BagMessage]:
        with suppress(Exception):  # up to the damage
            for name, message_type, record_ns, raw in recover(self.path, self._suffix()):
                if (name, message_type) == (topic.name, topic.message_type):
                    yield self._message(record_ns, raw, topic)

    def _message(self, record_ns: int, raw: bytes, topic: Topic) -> BagMessage:
        try:
            raw = unpacked_message(raw) if self._messages_are_compressed else raw
            header_ns, frame_id = read_header(raw, self.ros2)
        except Exception as error:  # of the decompressor too
            damage = f"{self.path}: a message is damaged: {reason(error)}"
            return BagMessage(record_ns, 0, "", topic.message_type, b"", damage)
        return BagMessage(record_ns, header_ns, frame_id, topic.message_type, raw)

    def last_message(self, topic: Topic) -> BagMessage | None:
        """The message of a topic recorded last, found from the end of the bag; None if there is none."""
        if self._has_index:
            with suppress(Exception), self._opened() as reader:  # damaged there
                look_back_ns = _LAST_MESSAGES_NS
                while True:
                    start_ns = reader.end_time - look_back_ns
                    parts = (self._by_index(storage, topic, start_ns) for storage in _storages(reader))
                    last = _last(chain.from_iterable(parts))
                    if last is not None or look_back_ns > reader.duration:
                        return last
                    look_back_ns *= 8
        return _last(self.messages(topic))

    def decode(self, message: BagMessage, time_field: str | None = None) -> RawCloud:
        """The points of a message."""
        with self._damage("a point cloud cannot be decoded"):
            try:
                return decode(message, self.ros2, time_field)
            except InputError as error:
                raise InputError(f"{self.path}: {error}") from error

    @contextmanager
    def _opened(self) -> Iterator[Rosbag1Reader | Rosbag2Reader]:
        with self._damage("it cannot be opened"):
            require_tables(self.path)
            reader = Rosbag2Reader(self.path) if self.ros2 else Rosbag1Reader(self.path)
            reader.open()
        try:
            yield reader
        finally:
            reader.close()

    def _damage(self, place: str) -> AbstractContextManager[None]:
        return reading(self.path, place, self._remedy)

    def _suffix(self) -> str:
        return self.path.suffix if self.ros2 else ".bag"

    @cached_property
    def _remedy(self) -> str:
        if self.path.is_dir() and self.ros2:
            whole = min(self.path.glob("*.zstd"), default=None)
            if whole is not None:  # decompressed, it is a file that is read as far as possible
                return f"try `zstd -dc {whole} > {whole.with_suffix('')}` and give that file, or copy the bag again"
            return f"try `ros2 bag reindex {self.path}`, or copy the bag again"
        command = _REPAIR.get(self._suffix())
        if command is None:
            return "readable are .bag, .db3, .mcap and rosbag2 folders with a metadata.yaml"
        return (
            f"try `{command.format(self.path / '*.bag' if self.path.is_dir() else self.path)}`, or copy the bag again"
        )


def _left_in_log(path: Path) -> str | None:
    """Warning of messages left in a database's write-ahead log, as after a crash, which rosbags does not read."""
    logs = path.glob("*.db3-wal") if path.is_dir() else [path.with_name(f"{path.name}-wal")]
    log = next((log for log in logs if log.is_file() and log.stat().st_size), None)
    if log is None:
        return None
    merge = f"sqlite3 {str(log).removesuffix('-wal')} 'PRAGMA wal_checkpoint(TRUNCATE)'"
    return f"{log}: may hold messages that are not yet in the bag, as after a crash; `{merge}` adds them"


def _last(messages: Iterable[BagMessage]) -> BagMessage | None:
    last = None
    for message in messages:
        last = message if message.damage is None else last
    return last


def _storages(reader: Rosbag1Reader | Rosbag2Reader) -> list[Any]:
    """The readers of a bag's single files; all have a path, connections and messages."""
    if isinstance(reader, Rosbag1Reader):
        return [reader]
    return getattr(reader.storage, "storages", None) or [reader.storage]


def recover(path: Path, suffix: str) -> Iterator[Recovered]:
    """The messages of a `.bag`, `.mcap` or `.db3` file up to its first damaged place, a ValueError or the end."""
    if suffix == ".db3":
        yield from _database(path)
        return
    records: _Rosbag1 | _Mcap = _Rosbag1() if suffix == ".bag" else _Mcap()
    with path.open("rb") as file:
        if file.read(len(records.magic)) != records.magic:
            raise ValueError(f"it does not begin as a {suffix} file")
        size = path.stat().st_size
        while (at := file.tell()) < size:
            try:
                yield from records.read(file)
            except Exception as error:  # damaged bytes make struct, codecs and look-ups raise nearly anything
                raise ValueError(f"it breaks off at byte {at:,} of {size:,} ({reason(error)})") from error


class _Rosbag1:
    """Records of a header, fields `name=value`, and data; chunks hold connections and messages."""

    magic = _ROSBAG1_MAGIC

    def __init__(self) -> None:
        self._connections: dict[int, tuple[str, str]] = {}  # topic and type, by the number in each message

    def read(self, file: BinaryIO) -> Iterator[Recovered]:
        """The messages of the record that begins here."""
        header, size = Header.read(file), read_uint32(file)
        kind, data = header.get_uint8("op"), file.read(min(size, _LONGEST_RECORD))
        if kind == RecordType.CHUNK:
            compression = header.get_string("compression")
            yield from _within(data if compression == "none" else decompressors[compression](data), self.read)
        _require_whole(data, size)
        if kind == RecordType.CONNECTION:
            fields = Header.read(BytesIO(struct.pack("<I", size) + data))
            named = normalize(header.get_string("topic")), normalize_msgtype(fields.get_string("type"))
            self._connections[header.get_uint32("conn")] = named
        elif kind == RecordType.MSGDATA:
            named = self._connections[header.get_uint32("conn")]
            yield *named, header.get_time("time"), data


class _Mcap:
    """Records of an opcode, a length and their content; chunks hold schemas, channels and messages."""

    magic = MCAP_MAGIC

    def __init__(self) -> None:
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str]] = {}

    def read(self, file: BinaryIO) -> Iterator[Recovered]:
        """The messages of the record that begins here."""
        opcode, size = struct.unpack("<BQ", read_exact(file, 9))
        if opcode in (_FOOTER, _DATA_END):  # the summary behind it repeats schemas and channels
            file.seek(0, 2)
            return
        data = file.read(min(size, _LONGEST_RECORD))
        body = BytesIO(data)
        if opcode == _CHUNK:
            _, _, unpacked_size, checksum = struct.unpack("<QQQI", read_exact(body, 28))
            compression, _, content = read_string(body), body.read(8), body.read()
            # A part of a chunk without compression can be read as it stands.
            is_part = not compression and len(data) < size
            content = content if is_part else decompress(content, compression, unpacked_size, checksum)
            yield from _within(content, self.read)
        _require_whole(data, size)
        if opcode == _SCHEMA:
            (schema,) = struct.unpack("<H", read_exact(body, 2))
            self._schemas[schema] = read_string(body)
        elif opcode == _CHANNEL:
            channel, schema = struct.unpack("<HH", read_exact(body, 4))
            self._channels[channel] = (read_string(body), self._schemas[schema])
        elif opcode == _MESSAGE:
            channel, _, record_ns, _ = struct.unpack("<HIQQ", read_exact(body, 22))
            yield *self._channels[channel], record_ns, body.read()


def _within(content: bytes, read: Callable[[BinaryIO], Iterator[Recovered]]) -> Iterator[Recovered]:
    stream = BytesIO(content)
    while stream.tell() < len(content):
        yield from read(stream)


def _require_whole(data: bytes, size: int) -> None:
    if len(data) < size:
        raise ValueError(f"expected a record of {size:,} bytes, got {len(data):,}")


def require_tables(path: Path) -> None:
    """ValueError where messages or topics of a database (or one in a folder) are a view: its query may have no end."""
    for file in path.glob("*.db3") if path.is_dir() else [path] if path.suffix == ".db3" else []:
        with closing(_connected(file)) as database, suppress(sqlite3.Error):  # damaged, which is found when it is read
            for name, kind in database.execute("SELECT name, type FROM sqlite_master"):
                if name.lower() in ("messages", "topics") and kind != "table":
                    raise ValueError(f"its {name} are a {kind}, not a table")


def _connected(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)


def _database(path: Path) -> Iterator[Recovered]:
    require_tables(path)
    with path.open("rb") as file:
        header = file.read(32)
    with closing(_connected(path)) as database:
        # Without it SQLite refuses a file that is shorter than its header says; nothing can be written here.
        database.execute("PRAGMA writable_schema=ON")
        topics = {number: (name, kind) for number, name, kind in database.execute(_TOPICS)}
        # Pages that are missing at the end (sqlite.org/fileformat2.html, 1.3) SQLite may take for zeros.
        page, pages = struct.unpack_from(">H10xI", header, 16)
        is_cut = path.stat().st_size < pages * (page if page > 1 else 65536)
        for row, following in pairwise(chain(_rows(database), [None])):
            if row is None or (following is None and is_cut):
                return
            topic, record_ns, raw = row
            if topic in topics and isinstance(record_ns, int) and isinstance(raw, bytes):
                yield *topics[topic], record_ns, raw


def _rows(database: sqlite3.Connection) -> Iterator[tuple[Any, ...]]:
    with suppress(sqlite3.Error):  # damaged from here on
        yield from database.execute(_ROWS)
