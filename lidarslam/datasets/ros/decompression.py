"""Chunks and messages of bags are unpacked up to a bound: some hundred kilobytes can hold gigabytes of zeros.

Importing it bounds the readers of rosbags.
"""

from bz2 import BZ2Decompressor
from collections.abc import Callable
from typing import Any

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.rosbag1.reader import Compression, decompressors
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS, zstd  # type: ignore[attr-defined] # Python's, or as in Python

# Recorders write chunks of 1 to 16 MB, and a cloud of two million points has some 100 MB.
MOST_BYTES = 1 << 28


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


DECOMPRESSORS["lz4"] = lambda data, _: unpacked(data, LZ4FrameDecompressor)
DECOMPRESSORS["zstd"] = lambda data, _: unpacked_message(data)
decompressors[Compression.LZ4.value] = lambda data: unpacked(data, LZ4FrameDecompressor)
decompressors[Compression.BZ2.value] = lambda data: unpacked(data, BZ2Decompressor)
