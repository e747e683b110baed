"""PLY files (Stanford polygon format 1.0): the vertices as a structured array, every property in its own type.

Read here because Open3D 0.20 drops properties of unsigned types, such as `uint t` and `ushort ring`, and plyfile 1.1
takes eight times as long for ascii files (4.3 s for 100,000 points).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.datasets.folders.point_table import read_ascii_table, read_binary_table
from lidarslam.datasets.folders.scan_files import read_bytes

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "int64": "i8", "uint64": "u8",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDER = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 65536
# Bytes; no point has so many fields.
_WIDEST_POINT = 1 << 16


def read_ply(path: Path) -> NDArray[np.void]:
    """The vertices (N,) of a PLY file, ascii or binary; other elements, such as faces, are left out.

    Raises:
        InputError: the file cannot be read, is no PLY file, or is damaged.
    """
    data = read_bytes(path)
    try:
        lines, length = _split_header(data)
        encoding, rows, dtype, skipped = _parse_header(lines)
        if dtype.itemsize > _WIDEST_POINT:
            raise ValueError(f"expected points of at most {_WIDEST_POINT} bytes, got {dtype.itemsize}")
        if encoding == "ascii":
            return read_ascii_table(_after_lines(data[length:], skipped[0]), dtype, rows)
        return read_binary_table(data[length + skipped[1] :], dtype, rows)
    except ValueError as error:
        raise InputError(f"{path}: not a readable PLY file: {error}; copy it again or remove it") from None


def _after_lines(body: bytes, lines: int) -> bytes:
    """What follows so many lines."""
    parts = body.split(b"\n", lines) if lines <= len(body) else []
    if len(parts) <= lines:
        raise ValueError(f"expected {lines} lines before the vertices, found fewer: it is truncated")
    return parts[-1]


def _split_header(data: bytes) -> tuple[list[list[str]], int]:
    """The words of each header line and the header's length in bytes."""
    lines: list[list[str]] = []
    at = 0
    while not lines or lines[-1] != ["end_header"]:
        end = data.find(b"\n", at, _LONGEST_HEADER)
        if end < 0 or (lines and lines[0] != ["ply"]):
            raise ValueError("expected a header from `ply` to `end_header`, found none")
        lines.append(data[at:end].decode("ascii", errors="replace").split())
        at = end + 1
    return lines, at


def _parse_header(lines: list[list[str]]) -> tuple[str, int, np.dtype[np.void], tuple[int, int]]:
    """Encoding, number of vertices, their type, and the (lines, bytes) of the elements before them."""
    encoding = next((words[1] for words in lines if len(words) > 1 and words[0] == "format"), "")
    if encoding not in _BYTE_ORDER:
        raise ValueError(f"expected the format {', '.join(_BYTE_ORDER)}, got {encoding!r}")
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in lines:
        if words[:1] == ["element"] and len(words) == 3:
            if not words[2].isdecimal():
                raise ValueError(f"expected a number of elements, got {words[2][:40]!r}: it is invalid")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words[1:])
    skipped_lines = skipped_bytes = 0
    for name, rows, properties in elements:
        dtype = _row_type(properties, _BYTE_ORDER[encoding])
        if name == "vertex":
            return encoding, rows, dtype, (skipped_lines, skipped_bytes)
        skipped_lines += rows
        skipped_bytes += rows * dtype.itemsize
    raise ValueError("expected an element `vertex`, found none")


def _row_type(properties: list[list[str]], order: str) -> np.dtype[np.void]:
    columns = []
    for words in properties:
        if len(words) != 2 or words[0] not in _TYPES:
            raise ValueError(f"expected properties of a plain type up to the vertices, got {' '.join(words)!r}")
        columns.append((words[1], order + _TYPES[words[0]]))
    return np.dtype(columns)
