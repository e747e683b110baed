"""PCD files (Point Cloud Library, version 0.7): the points as a structured array, every field in its own type.

Not by a library: Open3D takes 260 ms for 100,000 binary points instead of 0.5 ms and fills cut ascii files with zeros,
pypcd4 refuses headers without COUNT and ascii rows with tabs, and mixes up compressed fields of several values.
"""

from dataclasses import dataclass
from pathlib import Path

import lzf
import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.datasets.folders.point_table import read_ascii_table, read_binary_table
from lidarslam.datasets.folders.scan_files import read_bytes

_KINDS = {"F": "f", "I": "i", "U": "u"}
_SIZES = ("1", "2", "4", "8")
_LONGEST_HEADER = 65536
# LZF's longest copy is of 264 bytes and takes three.
_MOST_OF_A_BYTE = 88


@dataclass(frozen=True)
class _Header:
    dtype: np.dtype[np.void]
    points: int
    encoding: str
    length: int


def read_pcd(path: Path) -> NDArray[np.void]:
    """The points (N,) of a PCD file, ascii, binary or binary_compressed; organised clouds are flattened.

    Raises:
        InputError: the file cannot be read, is no PCD file, or is damaged.
    """
    data = read_bytes(path)
    try:
        header = _parse_header(data)
        body = data[header.length :]
        if header.encoding == "ascii":
            return read_ascii_table(body, header.dtype, header.points)
        if header.encoding == "binary":
            return read_binary_table(body, header.dtype, header.points)
        return _read_compressed(body, header)
    except ValueError as error:
        raise InputError(f"{path}: not a readable PCD file: {error}; copy it again or remove it") from None


def _parse_header(data: bytes) -> _Header:
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = data.find(b"\n", at, _LONGEST_HEADER)
        if end < 0:
            raise ValueError("expected a header that ends in a DATA line, found none")
        words = data[at:end].decode("ascii", errors="replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("expected FIELDS, SIZE, TYPE and COUNT of one length each")
    points = entries.get("POINTS", [])
    if len(points) != 1:
        raise ValueError("expected a line POINTS with their number")
    encoding = " ".join(entries["DATA"])
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"expected DATA ascii, binary or binary_compressed, got {encoding!r}")
    if not points[0].isdecimal():
        raise ValueError(f"expected a number of POINTS, got {points[0][:40]!r}: it is invalid")
    return _Header(_row_type(names, sizes, kinds, counts), int(points[0]), encoding, at)


def _row_type(names: list[str], sizes: list[str], kinds: list[str], counts: list[str]) -> np.dtype[np.void]:
    columns: list[tuple[str, str, tuple[int, ...]]] = []
    for place, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        if kind not in _KINDS:
            raise ValueError(f"expected the TYPE F, I or U, got {kind!r}")
        if size not in _SIZES or not count.isdecimal():
            raise ValueError(f"expected sizes of 1, 2, 4 or 8 bytes and a COUNT, got {size[:20]!r} and {count[:20]!r}")
        # PCL calls every padding field `_`, and NumPy wants names to differ.
        unique = name if name not in names[:place] else f"{name}{place}"
        columns.append((unique, f"<{_KINDS[kind]}{size}", () if count == "1" else (int(count),)))
    try:
        return np.dtype(columns)
    except TypeError as error:
        raise ValueError(f"expected sizes of 1, 2, 4 or 8 bytes ({error})") from None


def _read_compressed(body: bytes, header: _Header) -> NDArray[np.void]:
    """The body is two sizes and an LZF stream that holds the fields one after another, not the points."""
    if len(body) < 8:
        raise ValueError("expected two sizes before the compressed points: it is truncated")
    compressed, size = (int(word) for word in np.frombuffer(body, "<u4", count=2))
    expected = header.points * header.dtype.itemsize
    if size != expected or len(body) < 8 + compressed:
        raise ValueError(
            f"expected {expected} bytes in {compressed} compressed ones, got {size} in {len(body) - 8}: it is truncated"
        )
    if size > _MOST_OF_A_BYTE * compressed:
        raise ValueError(f"expected {size} bytes in {compressed} compressed ones, more than LZF can hold")
    data = lzf.decompress(body[8 : 8 + compressed], size)
    if data is None or len(data) != size:
        raise ValueError("the compressed points are damaged")
    table = np.empty(header.points, header.dtype)
    at = 0
    for name in header.dtype.names or ():
        column = table[name]
        table[name] = np.frombuffer(data, column.dtype, count=column.size, offset=at).reshape(column.shape)
        at += column.nbytes
    return table
