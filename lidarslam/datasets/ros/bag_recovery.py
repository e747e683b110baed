"""The messages of a bag without its index, in the order of the file, as after a crash of the recorder.

Layouts: ROS bag format 2.0 (wiki.ros.org/Bags/Format/2.0), MCAP (mcap.dev/spec), rosbag2's SQLite tables. Written here
because rosbags needs an index, and `StreamReader` of mcap 1.6 loses a chunk that is cut off and accepts cut records.
"""

import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from io import BytesIO
from itertools import chain, pairwise
from pathlib import Path
from typing import BinaryIO, NamedTuple
from urllib.parse import quote

from rosbags.rosbag1.reader import Header, RecordType, decompressors, normalize, read_uint32
from rosbags.rosbag2.storage_mcap import decompress, read_exact, read_string
from rosbags.typesys.msg import normalize_msgtype

Report = Callable[[str], None]

# Records are read whole; a longer one is a damaged length.
_LONGEST_RECORD = 1 << 30
# Opcodes of MCAP.
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
MCAP_MAGIC = b"\x89MCAP0\r\n"
# A damaged database may hold anything for a name.
_TOPICS = "SELECT id, name, type FROM topics WHERE typeof(name) = 'text' AND typeof(type) = 'text'"
# By the table itself, because the pages of its index are at the end.
_ROWS = "SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id"


class RecoveredMessage(NamedTuple):
    """One message; the type is named as in ROS 2, the time is that of recording in nanoseconds."""

    topic: str
    message_type: str
    record_ns: int
    raw: bytes


def recover(path: Path, suffix: str, report: Report) -> Iterator[RecoveredMessage]:
    """The messages of a `.bag`, `.mcap` or `.db3` file, as far as it is readable; damage is reported, a line each.

    A damaged chunk costs its own messages alone; anything else ends the file.

    Raises:
        ValueError, OSError, sqlite3.Error: it is no such file at all.
    """
    if suffix == ".db3":
        yield from _database(path, report)
        return
    records = (_Rosbag1Records if suffix == ".bag" else _McapRecords)(report)
    with path.open("rb") as file:
        if file.read(len(records.magic)) != records.magic:
            raise ValueError(f"it does not begin as a {suffix} file")
        size = path.stat().st_size
        while (at := file.tell()) < size:
            try:
                yield from records.read(file)
            except Exception as error:  # damaged bytes make struct, codecs and look-ups raise nearly anything
                report(f"it breaks off at byte {at:,} of {size:,} ({_reason(error)})")
                return


class _Records:
    """Reads one record after another, those inside chunks too."""

    magic: bytes

    def __init__(self, report: Report) -> None:
        self._report = report
        self._connections: dict[int, tuple[str, str]] = {}  # topic and type, by the number in each message
        self._schemas: dict[int, str] = {}

    def read(self, file: BinaryIO) -> Iterator[RecoveredMessage]:
        """The messages of the record that begins here."""
        raise NotImplementedError

    def _chunk(self, decompressed: Callable[[], bytes], is_whole: bool) -> Iterator[RecoveredMessage]:
        try:
            content = decompressed()
            stream = BytesIO(content)
            while stream.tell() < len(content):
                yield from self.read(stream)
        except Exception as error:
            if is_whole:
                self._report(f"a chunk in it is damaged ({_reason(error)})")


class _Rosbag1Records(_Records):
    """Records of a header, fields `name=value`, and data; chunks hold connections and messages."""

    magic = b"#ROSBAG V2.0\n"

    def read(self, file: BinaryIO) -> Iterator[RecoveredMessage]:
        header, size = Header.read(file), read_uint32(file)
        kind, data = header.get_uint8("op"), file.read(min(size, _LONGEST_RECORD))
        if kind == RecordType.CHUNK:
            yield from self._chunk(lambda: decompressors[header.get_string("compression")](data), len(data) == size)
        _require_whole(data, size)
        if kind == RecordType.CONNECTION:
            fields = Header.read(BytesIO(struct.pack("<I", size) + data))
            named = normalize(header.get_string("topic")), normalize_msgtype(fields.get_string("type"))
            self._connections[header.get_uint32("conn")] = named
        elif kind == RecordType.MSGDATA:
            named = self._connections[header.get_uint32("conn")]
            yield RecoveredMessage(*named, header.get_time("time"), data)


class _McapRecords(_Records):
    """Records of an opcode, a length and their content; chunks hold schemas, channels and messages."""

    magic = MCAP_MAGIC

    def read(self, file: BinaryIO) -> Iterator[RecoveredMessage]:
        opcode, size = struct.unpack("<BQ", read_exact(file, 9))
        if opcode in (_FOOTER, _DATA_END):  # the summary behind it repeats schemas and channels
            file.seek(0, 2)
            return
        data = file.read(min(size, _LONGEST_RECORD))
        body = BytesIO(data)
        if opcode == _CHUNK:
            yield from self._read_chunk(body, len(data) == size)
        _require_whole(data, size)
        if opcode == _SCHEMA:
            (schema,) = struct.unpack("<H", read_exact(body, 2))
            self._schemas[schema] = read_string(body)
        elif opcode == _CHANNEL:
            channel, schema = struct.unpack("<HH", read_exact(body, 4))
            self._connections[channel] = (read_string(body), self._schemas[schema])
        elif opcode == _MESSAGE:
            channel, _, record_ns, _ = struct.unpack("<HIQQ", read_exact(body, 22))
            yield RecoveredMessage(*self._connections[channel], record_ns, body.read())

    def _read_chunk(self, body: BytesIO, is_whole: bool) -> Iterator[RecoveredMessage]:
        _, _, size, checksum = struct.unpack("<QQQI", read_exact(body, 28))
        compression = read_string(body)
        body.read(8)
        data = body.read()
        is_text = not is_whole and not compression  # a part of it can be read as it stands
        yield from self._chunk(lambda: data if is_text else decompress(data, compression, size, checksum), is_whole)


def _require_whole(data: bytes, size: int) -> None:
    if len(data) < size:
        raise ValueError(f"expected a record of {size:,} bytes, got {len(data):,}")


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def require_tables(path: Path) -> None:
    """Refuse a database, or a folder with one, whose messages or topics are a view: its query may have no end.

    Raises:
        ValueError: it has such a view.
    """
    for file in path.glob("*.db3") if path.is_dir() else [path] if path.suffix == ".db3" else []:
        with closing(_connected(file)) as database, suppress(sqlite3.Error):  # damaged, which is found when it is read
            for name, kind in database.execute("SELECT name, type FROM sqlite_master"):
                if name.lower() in ("messages", "topics") and kind != "table":
                    raise ValueError(f"its {name} are a {kind}, not a table")


def _connected(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)


def _database(path: Path, report: Report) -> Iterator[RecoveredMessage]:
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
        for row, following in pairwise(chain(_rows(database, report), [None])):
            if row is None or (following is None and is_cut):
                return
            topic, record_ns, raw = row
            if topic in topics and isinstance(record_ns, int) and isinstance(raw, bytes):
                yield RecoveredMessage(*topics[topic], record_ns, raw)
            else:
                report(f"a row of it is no message (its data are of type {type(raw).__name__})")


def _rows(database: sqlite3.Connection, report: Report) -> Iterator[tuple[object, ...]]:
    """The rows of the table of messages, up to damage."""
    rows = 0
    try:
        for row in database.execute(_ROWS):
            yield row
            rows += 1
    except sqlite3.Error as error:
        report(f"it breaks off after {rows:,} rows ({_reason(error)})")
