"""Chunks, messages and files of bags are unpacked up to a bound: some hundred kilobytes can hold gigabytes of zeros.

Importing it bounds the readers of rosbags.
"""

from bz2 import BZ2Decompressor
from collections.abc import Callable
from io import RawIOBase
from types import SimpleNamespace
from typing import Any, BinaryIO

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.rosbag1.reader import Compression, decompressors
from rosbags.rosbag2 import reader
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS, zstd  # type: ignore[attr-defined] # Python's, or as in Python

from lidarslam.core.errors import InputError

# Recorders write chunks of 1 to 16 MB, and a cloud of two million points has some 100 MB.
MOST_BYTES = 1 << 28
# How many times as large a file may become that is compressed as a whole; clouds do not become twenty times as large.
_MOST_GROWTH = 100


def unpacked(data: bytes, make: Callable[[], Any]) -> bytes:
    """The content of compressed frames, one after the other.

    Args:
        data: the frames.
        make: a decompressor of one frame, as of the standard library.

    Raises:
        ValueError: they are cut short, or there is too much.
    """
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


reader.zstd = SimpleNamespace(open=_UnpackedFile, decompress=unpacked_message)  # type: ignore[attr-defined,assignment]
DECOMPRESSORS["lz4"] = lambda data, _: unpacked(data, LZ4FrameDecompressor)
DECOMPRESSORS["zstd"] = lambda data, _: unpacked_message(data)
decompressors[Compression.LZ4.value] = lambda data: unpacked(data, LZ4FrameDecompressor)
decompressors[Compression.BZ2.value] = lambda data: unpacked(data, BZ2Decompressor)
