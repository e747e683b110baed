"""Maps on disk.

Written here rather than by Open3D 0.20, whose writer says nothing when the disk is full and leaves half a file.
"""

from pathlib import Path

import numpy as np

from lidarslam.core.errors import OutputError
from lidarslam.mapping.global_map.global_map import PointCloud

_POINTS_AT_A_TIME = 1_000_000


def write_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a binary .ply or .pcd file with float32 points and normals.

    Raises:
        OutputError: the file could not be written, or the cloud is empty.
    """
    if not len(cloud):
        raise OutputError(f"{path.parent}: a map without points cannot be written")
    header = _HEADERS[path.suffix](len(cloud))
    try:
        with path.open("wb") as out:
            out.write(header.encode("ascii"))
            for first in range(0, len(cloud), _POINTS_AT_A_TIME):
                rows = slice(first, first + _POINTS_AT_A_TIME)
                out.write(np.hstack([cloud.points[rows], cloud.normals[rows]]).astype("<f4").tobytes())
    except OSError as error:
        raise OutputError(
            f"{path.parent}: the {path.suffix} map cannot be written there ({error.strerror or error})"
        ) from error


def _ply_header(points: int) -> str:
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {points}\n{properties}end_header\n"


def _pcd_header(points: int) -> str:
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        "FIELDS x y z normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\nCOUNT 1 1 1 1 1 1\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary\n"
    )


_HEADERS = {".ply": _ply_header, ".pcd": _pcd_header}
