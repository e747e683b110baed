"""Files that hold one scan each: their order, their numbers, and the formats, read into tables of points."""

import re
import stat
from collections.abc import Callable, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import cast

import lzf
import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.files import read_array, reading
from lidarslam.datasets.recording import KITTI_FIELDS

# No sweep is larger; reading more would fill the memory.
_LARGEST_BYTES = 1 << 31
# A larger number is no scan's, such as a time.
_MOST_SCANS = 10**7

SCAN_SUFFIXES = (".bin", ".pcd", ".ply", ".npy")
TableReader = Callable[[Path], NDArray[np.void]]
# Fields of the float32 numbers of a .bin point, by their number; in the order of preference.
_BIN_FIELDS = {5: (*KITTI_FIELDS, "ring"), 4: KITTI_FIELDS, 3: ("x", "y", "z")}
_MOST_RINGS = 256
# Numbers of values per point that are tried, by their type, and bytes of a file in which they are; the shares of
# successive points with one sign of x, and of y, from which on a number is right, and below which it may be wrong.
_TRIED, _TRIED_BYTES = {"<f4": range(3, 9), "<f8": range(3, 6)}, 1 << 20
_AGREES, _DIFFERS, _FEWEST_COMPARED = 0.9, 0.75, 400
_WIDEST_ARRAY = 16
# Bytes; no format has larger points.
_WIDEST_POINT = 1 << 16
_LONGEST_HEADER = 1 << 16
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "int64": "i8", "uint64": "u8",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDER = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_KINDS = {"F": "f", "I": "i", "U": "u"}
_SIZES = ("1", "2", "4", "8")
# LZF's longest copy is of 264 bytes and takes three.
_MOST_OF_A_BYTE = 88


def natural_key(name: str) -> list[tuple[bool, int, str]]:
    """Sort key by numbers: scan_2 comes before scan_10."""
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in re.split(r"([0-9]+)", name)]


def numbered_scans(folder: Path, suffix: str = ".bin") -> tuple[list[Path], NDArray[np.intp]]:
    """The scan files of a folder with numbers for names, such as 000004.bin, in their order, and the numbers.

    The number is the scan's row in the stamp and pose files, since recordings may have gaps.
    """
    files = [path for path in folder.glob(f"*{suffix}") if not path.name.startswith(".")]
    if not files:
        raise InputError(f"{folder}: holds no {suffix} scan")
    for path in files:
        if not (path.stem.isascii() and path.stem.isdecimal() and int(path.stem) < _MOST_SCANS):
            raise InputError(
                f"{path}: expected a name that is the scan's number, such as 000004{suffix}, at most"
                f" {_MOST_SCANS - 1:,}; rename it or move it away"
            )
    files.sort(key=lambda path: int(path.stem))
    if suffix == ".bin":
        _require_layout(files[0], _agreement(files[0]))
    numbers = np.array([int(path.stem) for path in files], dtype=np.intp)
    if not np.diff(numbers).all():
        raise InputError(f"{folder}: two of its {suffix} files have the same number; remove one")
    return files, numbers


def read_bytes(path: Path) -> bytes:
    """The content of a scan file."""
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{path}: expected a file with a scan, it is none; move it away")
        if found.st_size > _LARGEST_BYTES:
            raise InputError(f"{path}: {found.st_size:,} bytes are no single scan; split it or move it away")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error})") from error


def read_bin(path: Path, columns: int = len(KITTI_FIELDS)) -> NDArray[np.float32]:
    """The (N, columns) little-endian float32 numbers of a `.bin` scan; an empty file is a scan of no points."""
    data = read_bytes(path)
    if len(data) % (4 * columns):
        raise InputError(
            f"{path}: expected points of {columns} float32 numbers, {4 * columns} bytes each, got {len(data)} bytes;"
            " the file is damaged or of another format: copy it again or remove it"
        )
    return np.frombuffer(data, dtype="<f4").astype(np.float32, copy=False).reshape(-1, columns)


def read_ascii_table(body: bytes, dtype: np.dtype[np.void], rows: int) -> NDArray[np.void]:
    """The first `rows` lines of blank-separated numbers; ValueError where there are fewer."""
    _require_points(body, rows)
    # A line takes a digit and a blank at least; NumPy makes room for all lines that it is told to expect.
    possible = dtype.itemsize <= _WIDEST_POINT and rows <= (len(body) + 1) // 2 and body.strip()
    table = np.loadtxt(BytesIO(body), dtype=dtype, max_rows=rows, ndmin=1, comments=None) if possible else np.empty(0)
    if len(table) != rows:
        raise ValueError(f"expected {rows} points, got {len(table)} in {len(body)} bytes of text: it is truncated")
    return np.asarray(table, dtype)


def read_binary_table(body: bytes, dtype: np.dtype[np.void], rows: int) -> NDArray[np.void]:
    """The first `rows` rows of packed numbers; ValueError where there are fewer."""
    _require_points(body, rows)
    if len(body) < rows * dtype.itemsize:
        raise ValueError(f"expected {rows} points of {dtype.itemsize} bytes, got {len(body)} bytes: it is truncated")
    return np.frombuffer(body, dtype, count=rows)


def _require_points(body: bytes, rows: int) -> None:
    if not rows and body.strip(b"\0\t\n\r "):
        raise ValueError(f"its header promises no points, and {len(body):,} bytes follow")


def table_reader(files: Sequence[Path]) -> TableReader:
    """The reader for scan files, all with one suffix."""
    suffix = files[0].suffix.lower()
    if suffix == ".bin":
        fields = _BIN_FIELDS[_bin_columns(files)]
        return lambda path: _as_table(read_bin(path, len(fields)), fields)
    return {".pcd": read_pcd, ".ply": read_ply, ".npy": read_npy}[suffix]


def _bin_columns(files: Sequence[Path]) -> int:
    """The number of values per point, by the sizes of most files, since the file itself does not state it.

    Four fit almost always where they are right; five, as nuScenes has them, only count where the fifth number is a
    small integer in every point. InputError where the values show another layout.
    """
    sizes = np.array([path.stat().st_size if path.exists() else 0 for path in files])
    fits = {columns: int(np.count_nonzero(sizes % (4 * columns) == 0)) for columns in _BIN_FIELDS}
    if fits[5] and not _fifth_is_ring(files[int(np.argmax(sizes * (sizes % 20 == 0)))]):
        fits[5] = 0
    largest = files[int(np.argmax(sizes))]
    agreement = _agreement(largest)
    columns = max(fits, key=lambda columns: (fits[columns], agreement["<f4", columns] > _AGREES))
    if not fits[columns]:
        raise InputError(
            f"{files[0]}: expected float32 points of x, y, z, intensity, 16 bytes each, or of 12 bytes, or of 20 bytes"
            f" with a ring, got {sizes[0]} bytes, which fit none; copy it again, or convert the scans to .npy or .ply"
        )
    _require_layout(largest, agreement, columns)
    return columns


def _require_layout(path: Path, agreement: dict[tuple[str, int], float], columns: int = len(KITTI_FIELDS)) -> None:
    """InputError where the agreement shows another number of values per point of a .bin scan, or another type."""
    kind, other = max(agreement, key=lambda tried: agreement[tried])
    if 0.0 < agreement["<f4", columns] < _DIFFERS and agreement[kind, other] > _AGREES:
        size = other * np.dtype(kind).itemsize
        raise InputError(
            f"{path}: expected points of x, y, z, intensity as float32; by its values they have {size} bytes, as with"
            " further fields or float64; convert the scans to .npy or .ply"
        )


def _agreement(path: Path) -> dict[tuple[str, int], float]:
    """Share of successive points with one sign, in the worse of x and y, by type and number of values per point.

    Successive points have nearly one azimuth, whatever their elevations and ranges. 0 with too few points.
    """
    data = b""
    with suppress(InputError):  # counted when the scan is read
        data = read_bytes(path)[:_TRIED_BYTES]
    return {(kind, columns): _agreeing(data, kind, columns) for kind, tried in _TRIED.items() for columns in tried}


def _agreeing(data: bytes, kind: str, columns: int) -> float:
    size = columns * np.dtype(kind).itemsize
    rows = np.frombuffer(data[: len(data) // size * size], kind).reshape(-1, columns)
    with np.errstate(invalid="ignore"):  # of another type they may be any numbers
        products = np.sign(rows[1:, :2]) * np.sign(rows[:-1, :2])
    compared = np.count_nonzero(np.abs(products) == 1.0, axis=0)
    if compared.min() < _FEWEST_COMPARED:
        return 0.0
    return float((np.count_nonzero(products == 1.0, axis=0) / compared).min())


def _fifth_is_ring(path: Path) -> bool:
    fifth = read_bin(path, 5)[:, 4]
    with np.errstate(invalid="ignore"):  # of another type they may be any numbers
        return bool(len(fifth) and ((fifth >= 0) & (fifth < _MOST_RINGS) & (fifth == np.floor(fifth))).all())


def read_npy(path: Path) -> NDArray[np.void]:
    """The points (N,) of a .npy file: a structured array with fields, or (N, >=3) numbers that begin with x, y, z.

    Four columns are x, y, z and intensity. Organised arrays are flattened.
    """
    with reading(path, "cannot be read as .npy", "it is truncated or damaged: copy it again or remove it"):
        array = read_array(BytesIO(read_bytes(path)))
    if array.dtype.names:
        return cast("NDArray[np.void]", array.reshape(-1))
    if array.ndim < 2 or not 3 <= array.shape[-1] <= _WIDEST_ARRAY or array.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: expected an array (N, 3) or wider of numbers that begin with x, y, z, or a structured array,"
            f" got {array.shape} of {array.dtype}"
        )
    further = tuple(f"column_{column}" for column in range(3, array.shape[-1]))
    names = KITTI_FIELDS if len(further) == 1 else (*"xyz", *further)
    return _as_table(array.reshape(-1, array.shape[-1]), names)


def _as_table(numbers: NDArray[np.generic], names: tuple[str, ...]) -> NDArray[np.void]:
    """An array (N, columns) of one type as a structured array (N,) with these names."""
    dtype = np.dtype([(name, numbers.dtype) for name in names])
    return np.ascontiguousarray(numbers).view(dtype).reshape(-1)


def read_ply(path: Path) -> NDArray[np.void]:
    """The vertices (N,) of a PLY file, ascii or binary; other elements, such as faces, are left out."""
    with reading(path, "not a readable PLY file", "copy it again or remove it"):
        return _ply_table(read_bytes(path))


def read_pcd(path: Path) -> NDArray[np.void]:
    """The points (N,) of a PCD file, ascii, binary or binary_compressed; organised clouds are flattened."""
    with reading(path, "not a readable PCD file", "copy it again or remove it"):
        return _pcd_table(read_bytes(path))


def _ply_table(data: bytes) -> NDArray[np.void]:
    lines, length = _split_header(data, "end_header")
    if lines[0] != ["ply"]:
        raise ValueError("expected a header that begins with `ply`")
    encoding = next((words[1] for words in lines if len(words) > 1 and words[0] == "format"), "")
    if encoding not in _BYTE_ORDER:
        raise ValueError(f"expected the format {', '.join(_BYTE_ORDER)}, got {encoding!r}")
    (name, rows, kinds), *others = _ply_elements(lines) or [("", 0, [])]
    if name != "vertex":
        raise ValueError("expected the element `vertex` before any others")
    dtype = _ply_row_type(kinds, _BYTE_ORDER[encoding])
    if dtype.itemsize > _WIDEST_POINT:
        raise ValueError(f"expected points of at most {_WIDEST_POINT} bytes, got {dtype.itemsize}")
    if (further := sum(count for _, count, _ in others)) > len(data):
        raise ValueError(f"expected {further:,} other elements in {len(data):,} bytes: it is truncated")
    if not rows and further:
        return np.empty(0, dtype)
    return (read_ascii_table if encoding == "ascii" else read_binary_table)(data[length:], dtype, rows)


def _ply_elements(lines: list[list[str]]) -> list[tuple[str, int, list[list[str]]]]:
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in lines:
        if words[:1] == ["element"] and len(words) == 3:
            elements.append((words[1], _whole_number("elements", words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words[1:])
    return elements


def _whole_number(noun: str, word: str) -> int:
    if not word.isdecimal():
        raise ValueError(f"expected a number of {noun}, got {word[:40]!r}: it is invalid")
    return int(word)


def _split_header(data: bytes, last: str) -> tuple[list[list[str]], int]:
    """The words of each header line up to the one that begins with the last word, and the header's length in bytes."""
    lines: list[list[str]] = [[]]
    at = 0
    while lines[-1][:1] != [last]:
        end = data.find(b"\n", at, _LONGEST_HEADER)
        if end < 0:
            raise ValueError(f"expected a header that ends in a line `{last}`, found none")
        lines.append(data[at:end].decode("ascii", errors="replace").split())
        at = end + 1
    return lines[1:], at


def _ply_row_type(properties: list[list[str]], order: str) -> np.dtype[np.void]:
    columns = []
    for words in properties:
        if len(words) != 2 or words[0] not in _TYPES:
            raise ValueError(f"expected vertices with properties of a plain type, got {' '.join(words)!r}")
        columns.append((words[1], order + _TYPES[words[0]]))
    return np.dtype(columns)


def _pcd_table(data: bytes) -> NDArray[np.void]:
    lines, length = _split_header(data, "DATA")
    entries = {words[0].upper(): words[1:] for words in lines if words and not words[0].startswith("#")}
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("expected FIELDS, SIZE, TYPE and COUNT of one length each")
    if len(entries.get("POINTS", [])) != 1:
        raise ValueError("expected a line POINTS with their number")
    encoding, rows = " ".join(entries["DATA"]), _whole_number("POINTS", entries["POINTS"][0])
    dtype, body = _pcd_row_type(names, sizes, kinds, counts), data[length:]
    match encoding:
        case "ascii":
            return read_ascii_table(body, dtype, rows)
        case "binary":
            return read_binary_table(body, dtype, rows)
        case "binary_compressed":
            return _read_compressed(body, dtype, rows)
    raise ValueError(f"expected DATA ascii, binary or binary_compressed, got {encoding!r}")


def _pcd_row_type(names: list[str], sizes: list[str], kinds: list[str], counts: list[str]) -> np.dtype[np.void]:
    columns: list[tuple[str, str, tuple[int, ...]]] = []
    for place, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        if kind not in _KINDS:
            raise ValueError(f"expected the TYPE F, I or U, got {kind!r}")
        if size not in _SIZES or not count.isdecimal():
            raise ValueError(f"expected sizes of 1, 2, 4 or 8 bytes and a COUNT, got {size[:20]!r} and {count[:20]!r}")
        # PCL calls every padding field `_`, and NumPy wants names to differ.
        unique = name if name not in names[:place] else f"{name}{place}"
        columns.append((unique, f"<{_KINDS[kind]}{size}", () if count == "1" else (int(count),)))
    return np.dtype(columns)


def _read_compressed(body: bytes, dtype: np.dtype[np.void], rows: int) -> NDArray[np.void]:
    """The body is two sizes and an LZF stream that holds the fields one after another, not the points."""
    if len(body) < 8:
        raise ValueError("expected two sizes before the compressed points: it is truncated")
    compressed, size = (int(word) for word in np.frombuffer(body, "<u4", count=2))
    expected = rows * dtype.itemsize
    if size != expected or len(body) < 8 + compressed:
        raise ValueError(
            f"expected {expected} bytes in {compressed} compressed ones, got {size} in {len(body) - 8}: it is truncated"
        )
    if size > _MOST_OF_A_BYTE * compressed:
        raise ValueError(f"expected {size} bytes in {compressed} compressed ones, more than LZF can hold")
    data = lzf.decompress(body[8 : 8 + compressed], size)
    if data is None or len(data) != size:
        raise ValueError("the compressed points are damaged")
    table = np.empty(rows, dtype)
    at = 0
    for name in dtype.names or ():
        column = table[name]
        table[name] = np.frombuffer(data, column.dtype, count=column.size, offset=at).reshape(column.shape)
        at += column.nbytes
    return table
