"""One pass through a bag without its index, record after record.

Layouts: ROS bag format 2.0 (wiki.ros.org/Bags/Format/2.0) and MCAP (mcap.dev/spec).
"""

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

Expand = Callable[[str, bytes, int], bytes]
"""Decompresses a chunk: the compression's name, the data, and the size it should have afterwards."""

_ROSBAG1_MAGIC, _MCAP_MAGIC = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"
# Records are read whole; a longer one is a damaged length.
_LONGEST_RECORD = 1 << 30


@dataclass(frozen=True)
class SalvagedMessage:
    """One message, its type named as ROS 2 names types."""

    topic: str
    message_type: str
    record_ns: int
    raw: bytes


class Walk:
    """One pass through a file; `damage` says what it met."""

    def __init__(self, path: Path, expand: Expand) -> None:
        self._path = path
        self._expand = expand
        self.damage: str | None = None

    def know(self, connections: Mapping[int, tuple[str, str]]) -> None:
        """Topics and types by the numbers that messages carry, which stand in chunks that may not be read."""

    def messages(self) -> Iterator[SalvagedMessage]:
        """All messages, until the file ends or is damaged beyond a chunk."""
        with self._path.open("rb") as file:
            size = self._path.stat().st_size
            self._begin(file)
            while (at := file.tell()) < size:
                try:
                    yield from self.record(file, whole=True)
                except Exception as error:  # damaged bytes make struct, codecs and look-ups raise nearly anything
                    self.damaged(f"it breaks off at byte {at:,} of {size:,}", error)
                    return

    def _begin(self, file: BinaryIO) -> None:
        raise NotImplementedError

    def record(self, file: BinaryIO, whole: bool) -> Iterator[SalvagedMessage]:
        """The messages in the record that begins here, of a whole file or of a chunk."""
        raise NotImplementedError

    def _chunk(
        self, compression: str, data: bytes, size: int, complete: bool, checksum: int = 0
    ) -> Iterator[SalvagedMessage]:
        """The messages in a chunk; one that is damaged inside costs no more than itself."""
        try:
            chunk = BytesIO(data if compression in ("", "none") else self._expand(compression, data, size))
            if complete and checksum and zlib.crc32(chunk.getbuffer()) != checksum:
                raise ValueError("its checksum is another")
            end = len(chunk.getbuffer())
            while chunk.tell() < end:
                yield from self.record(chunk, whole=False)
        except Exception as error:
            if complete:
                self.damaged("a chunk in it is damaged", error)

    def damaged(self, what: str, error: Exception) -> None:
        """What is damaged, and how that shows; the first counts."""
        self.damage = self.damage or f"{what} ({str(error) or type(error).__name__})"


def _take(file: BinaryIO, size: int) -> bytes:
    if size > _LONGEST_RECORD:
        raise ValueError(f"a record of {size:,} bytes")
    data = file.read(size)
    if len(data) < size:
        raise ValueError(f"expected {size:,} bytes more, got {len(data):,}")
    return data


class Rosbag1Walk(Walk):
    """Records of a header, fields `name=value`, and data; chunks hold connections and messages."""

    def __init__(self, path: Path, expand: Expand) -> None:
        super().__init__(path, expand)
        self._connections: dict[bytes, tuple[str, str]] = {}

    def know(self, connections: Mapping[int, tuple[str, str]]) -> None:
        self._connections = {struct.pack("<I", number): named for number, named in connections.items()}

    def _begin(self, file: BinaryIO) -> None:
        if file.read(len(_ROSBAG1_MAGIC)) != _ROSBAG1_MAGIC:
            raise ValueError("it does not begin as a bag of ROS 1")

    def record(self, file: BinaryIO, whole: bool) -> Iterator[SalvagedMessage]:
        header = _fields(_take(file, *struct.unpack("<I", _take(file, 4))))
        (size,) = struct.unpack("<I", _take(file, 4))
        kind = header.get(b"op")
        if kind is None:
            raise ValueError("a record of no kind")
        if kind == b"\x05" and whole:
            if size > _LONGEST_RECORD:
                raise ValueError(f"a chunk of {size:,} bytes")
            data = file.read(size)  # of the last one perhaps only a part is left
            expanded = struct.unpack("<I", header[b"size"])[0]
            yield from self._chunk(header[b"compression"].decode(), data, expanded, len(data) == size)
            _require_whole(data, size)
            return
        data = _take(file, size)
        if kind == b"\x07":
            named = _fields(data)
            package, _, name = named[b"type"].decode().rpartition("/")
            message_type = f"{package.removesuffix('/msg')}/msg/{name}"
            self._connections.setdefault(header[b"conn"], (header[b"topic"].decode(), message_type))
        elif kind == b"\x02":
            seconds, nanoseconds = struct.unpack("<II", header[b"time"])
            yield SalvagedMessage(*self._connections[header[b"conn"]], seconds * 10**9 + nanoseconds, data)


def _fields(data: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        fields[name] = value
        at += 4 + size
    return fields


def _require_whole(data: bytes, size: int) -> None:
    if len(data) < size:
        raise ValueError(f"expected a chunk of {size:,} bytes, got {len(data):,}")


class McapWalk(Walk):
    """Records of a kind, a length and their content; chunks hold schemas, channels and messages."""

    def __init__(self, path: Path, expand: Expand) -> None:
        super().__init__(path, expand)
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str]] = {}

    def know(self, connections: Mapping[int, tuple[str, str]]) -> None:
        self._channels = dict(connections)

    def _begin(self, file: BinaryIO) -> None:
        if file.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            raise ValueError("it does not begin as an MCAP file")

    def record(self, file: BinaryIO, whole: bool) -> Iterator[SalvagedMessage]:
        kind, size = struct.unpack("<BQ", _take(file, 9))
        if kind in (0x02, 0x0F):  # the footer, or the end of the data: what follows repeats what was
            file.seek(0, 2)
            return
        if kind == 0x06 and whole:
            if size > _LONGEST_RECORD:
                raise ValueError(f"a chunk of {size:,} bytes")
            data = file.read(size)
            _, _, expanded, checksum, characters = struct.unpack_from("<QQQII", data)
            compression = data[32 : 32 + characters].decode()
            yield from self._chunk(compression, data[40 + characters :], expanded, len(data) == size, checksum)
            _require_whole(data, size)
            return
        data = _take(file, size)
        if kind == 0x03:
            self._schemas[struct.unpack_from("<H", data)[0]] = _text(data, 2)
        elif kind == 0x04:
            channel, schema = struct.unpack_from("<HH", data)
            if channel not in self._channels:
                self._channels[channel] = (_text(data, 4), self._schemas[schema])
        elif kind == 0x05:
            channel, _, record_ns, _ = struct.unpack_from("<HIQQ", data)
            yield SalvagedMessage(*self._channels[channel], record_ns, data[22:])


def _text(data: bytes, at: int) -> str:
    (size,) = struct.unpack_from("<I", data, at)
    return data[at + 4 : at + 4 + size].decode()
