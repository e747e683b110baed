"""Maps on disk.

PLY and PCD are written here rather than by Open3D 0.20, whose writer says nothing when the disk is full and leaves half
a file.
"""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import OutputError
from lidarslam.mapping.global_map.survey_formats import Cloud, write_e57, write_laz

_POINTS_AT_A_TIME = 1_000_000
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def require_format(name: str) -> None:
    """Check that maps can be written in a format.

    Raises:
        OutputError: a library for it is not installed.
    """
    if name == "e57" and find_spec("pye57") is None:
        raise OutputError("E57 maps need pye57; type: pip install 'lidarslam[e57]'")


def write_cloud(path: Path, cloud: Cloud, brightest: float | None = None) -> None:
    """Write a binary .ply, .pcd, .laz or .e57 file with points, normals and attributes; E57 holds no normals.

    Args:
        path: of the file, with one of these suffixes.
        cloud: with at least one point.
        brightest: the largest intensity of the map that the cloud is a part of, for .laz; None: it is the whole map.

    Raises:
        OutputError: the file could not be written, has another suffix, or the cloud is empty.
    """
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        raise OutputError(f"{path}: expected a name that ends in {', '.join(_WRITERS)}")
    require_format(suffix[1:])
    if not len(cloud):
        raise OutputError(f"{path.parent}: a map without points cannot be written")
    write, failure = _WRITERS[suffix]
    try:
        if brightest is None:
            write(path, cloud)
        else:
            write_laz(path, cloud, brightest=brightest)
    except failure as error:
        reason = getattr(error, "strerror", None) or next(iter(str(error).splitlines()), type(error).__name__)
        raise OutputError(f"{path.parent}: the {path.suffix} map cannot be written there ({reason})") from error


def _write_ply(path: Path, cloud: Cloud) -> None:
    columns = _columns(cloud)
    properties = "".join(f"property {_PLY_TYPES[values.dtype.str[1:]]} {name}\n" for name, values in columns.items())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    _write_table(path, header, columns)


def _write_pcd(path: Path, cloud: Cloud) -> None:
    columns = {name.replace("n", "normal_", 1) if name in _NORMALS else name: v for name, v in _columns(cloud).items()}
    if cloud.attributes.rgb is not None:  # the Point Cloud Library packs colours into the bits of a float
        red, green, blue = (columns.pop(name).astype(np.uint32) for name in _COLOURS)
        columns["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    types = [values.dtype for values in columns.values()]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(columns)}\nSIZE {' '.join(str(one.itemsize) for one in types)}\n"
        f"TYPE {' '.join(one.kind.upper() for one in types)}\nCOUNT {' '.join('1' for _ in types)}\n"
        f"WIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(cloud)}\nDATA binary\n"
    )
    _write_table(path, header, columns)


_NORMALS = ("nx", "ny", "nz")
_COLOURS = ("red", "green", "blue")
_Columns = dict[str, NDArray[np.generic]]


def _columns(cloud: Cloud) -> _Columns:
    """The columns (N,) of a table of the points, by the names of PLY properties."""
    known = cloud.attributes
    columns: _Columns = dict(zip("xyz", cloud.points.astype(np.float32).T, strict=True))
    columns |= zip(_NORMALS, cloud.normals.astype(np.float32).T, strict=True)
    if known.intensity is not None:
        columns["intensity"] = known.intensity
    if known.rgb is not None:
        columns |= zip(_COLOURS, known.rgb.T, strict=True)
    if known.ring is not None:
        columns["ring"] = known.ring
    if known.time is not None:
        columns["time"] = known.time
    return columns


def _write_table(path: Path, header: str, columns: _Columns) -> None:
    dtype = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    count = len(columns["x"])
    with path.open("wb") as out:
        out.write(header.encode("ascii"))
        for first in range(0, count, _POINTS_AT_A_TIME):
            table = np.empty(min(_POINTS_AT_A_TIME, count - first), dtype=dtype)
            for name, values in columns.items():
                table[name] = values[first : first + len(table)]
            out.write(table.tobytes())


# With what they raise where a file cannot be written; laspy, its compressor and libE57Format raise anything.
_WRITERS: dict[str, tuple[Callable[[Path, Cloud], None], type[Exception]]] = {
    ".ply": (_write_ply, OSError),
    ".pcd": (_write_pcd, OSError),
    ".laz": (write_laz, Exception),
    ".e57": (write_e57, Exception),
}
