"""Point clouds on disk, as scanners, surveyors and mapping programs write them."""

import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.folders.scan_files import read_pcd, read_ply
from lidarslam.datasets.point_table import coordinates

# Surveys end well within this; squares of much more overflow.
_FARTHEST_M = 1e9
# Of LAS: where the points begin, and their format, in which two bits mark LAZ. There: the place of the table of chunks,
# which begins with its version and their number.
_LAS_HEADER, _IS_LAZ = struct.Struct("<96xI4xB"), 0xC0
_PLACE, _CHUNK_TABLE = struct.Struct("<q"), struct.Struct("<II")
# Read at a time: a damaged header may promise any number of points.
_PIECE_BYTES = 1 << 26


def read_cloud(path: Path) -> FloatArray:
    """The finite points (N, 3), metres, of a .pcd, .ply, .las, .laz or .e57 file, in the file's own frame.

    Coordinates stay in double precision, because surveys count metres from far away. The scans of an E57 file are
    put together by their poses.
    """
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}; name a point cloud")
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(f"{path}: not a point cloud that can be read; it must end in {', '.join(_READERS)}")
    try:
        points = read(path)
    except InputError:
        raise
    except Exception as error:  # damaged files make laspy, its decompressors and libE57Format raise anything
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        kind = path.suffix[1:].upper()
        raise InputError(f"{path}: not a readable {kind} file ({reason}); copy it again or remove it") from error
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(f"{path}: holds no point; choose another file")
    farthest = float(np.abs(points).max())
    if farthest > _FARTHEST_M:
        raise InputError(f"{path}: a point lies {farthest:.3g} m from the origin; expected metres on this planet")
    return points


def _read_las(path: Path) -> FloatArray:
    import laspy

    _require_chunks(path)
    with laspy.open(path) as file:
        at_a_time = max(1, _PIECE_BYTES // file.header.point_format.size)
        pieces = [np.stack([piece.x, piece.y, piece.z], axis=1) for piece in file.chunk_iterator(at_a_time)]
        points = np.concatenate([np.empty((0, 3)), *pieces])
        if len(points) != file.header.point_count:
            raise ValueError(f"{len(points):,} of {file.header.point_count:,} points")
        return points


def _require_chunks(path: Path) -> None:
    """Refuse a LAZ file that counts more chunks than it has bytes: lazrs makes room for all, and ends the program."""
    with path.open("rb") as file:
        header = file.read(_LAS_HEADER.size)
        data, point_format = _LAS_HEADER.unpack(header)
        if not point_format & _IS_LAZ:
            return
        file.seek(data)
        (table,) = _PLACE.unpack(file.read(_PLACE.size))
        if table == -1:  # written at the end by a program that could not go back
            file.seek(-_PLACE.size, os.SEEK_END)
            (table,) = _PLACE.unpack(file.read(_PLACE.size))
        file.seek(table)
        _, chunks = _CHUNK_TABLE.unpack(file.read(_CHUNK_TABLE.size))
        if chunks > path.stat().st_size:
            raise ValueError(f"{chunks:,} chunks")


def _read_e57(path: Path) -> FloatArray:
    try:
        import pye57
    except ImportError as error:
        raise InputError(f"{path}: E57 files need pye57; type: pip install pye57") from error
    file = pye57.E57(str(path))
    try:
        scans = [file.read_scan(number, ignore_missing_fields=True) for number in range(file.scan_count)]
    finally:
        file.close()
    columns = [np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1) for scan in scans]
    return np.concatenate([np.empty((0, 3)), *columns])


_READERS: dict[str, Callable[[Path], FloatArray]] = {
    ".ply": lambda path: coordinates(read_ply(path)),
    ".pcd": lambda path: coordinates(read_pcd(path)),
    ".las": _read_las,
    ".laz": _read_las,
    ".e57": _read_e57,
}
