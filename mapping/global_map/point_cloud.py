"""A map as a point cloud with normals and attributes, and its files.

PLY and PCD are written here rather than by Open3D 0.20, whose writer says nothing when the disk is full and leaves half
a file. LAZ is written by laspy, E57 by pye57.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import OutputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.point_files import POINTS_AT_A_TIME, Columns, write_ply, write_table
from lidarslam.core.scan import PointAttributes

if TYPE_CHECKING:
    import open3d as o3d

# Nearest points that a normal is estimated from.
_NORMAL_NEIGHBOURS = 20
# Metres; 32 bits of it reach 200 km to either side.
_LAZ_STEP_M = 1e-4
_LAZ_FULL = 65535.0
# LAS has no normals; these are the names of PDAL and CloudCompare.
_LAZ_NORMALS = ("NormalX", "NormalY", "NormalZ")


@dataclass(frozen=True, eq=False)
class PointCloud:
    """A map or a part of it."""

    points: FloatArray  # (N, 3) float64, metres, in the world
    normals: FloatArray  # (N, 3) float64, unit length, towards the side it was seen from
    attributes: PointAttributes = field(default_factory=PointAttributes)  # of the points

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "PointCloud":
        """Some of the points, by a mask (N,) or by indices."""
        return PointCloud(self.points[chosen], self.normals[chosen], self.attributes.select(chosen))

    def save(self, path: str | PathLike[str]) -> None:
        """Write a file; see `write_cloud`."""
        write_cloud(Path(path), self)

    def to_open3d(self) -> "o3d.geometry.PointCloud":
        """The points and normals as a cloud of Open3D."""
        import open3d as o3d

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self.points))
        cloud.normals = o3d.utility.Vector3dVector(self.normals)
        return cloud


def estimate_normals(points: FloatArray) -> FloatArray:
    """Unit normals (N, 3) of points (N, 3) by PCA of the nearest ones; their sign is arbitrary."""
    if len(points) < 3:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    cloud.estimate_normals(max_nn=_NORMAL_NEIGHBOURS)  # type: ignore[call-arg] # the stub lacks the defaults
    return np.array(cloud.point.normals.numpy(), dtype=np.float64)


def require_format(name: str) -> None:
    """Raise an OutputError where the library for a format of maps is not installed."""
    if name == "e57" and find_spec("pye57") is None:
        raise OutputError("E57 maps need pye57; type: pip install 'lidarslam[e57]'")


def write_cloud(path: Path, cloud: PointCloud, brightest: float | None = None) -> None:
    """Write a binary .ply, .pcd, .laz or .e57 file with points, normals and attributes; E57 holds no normals.

    The cloud may be a part of a map, whose largest intensity is `brightest`, for .laz. OutputError where the file has
    another suffix or cannot be written, or the cloud is empty.
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


def _write_pcd(path: Path, cloud: PointCloud) -> None:
    columns = {name.replace("n", "normal_", 1) if name in _NORMALS else name: v for name, v in _columns(cloud).items()}
    if cloud.attributes.rgb is not None:  # the Point Cloud Library packs colours into the bits of a float
        red, green, blue = (columns.pop(name).astype(np.uint32) for name in COLOURS)
        columns["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    types = [values.dtype for values in columns.values()]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(columns)}\nSIZE {' '.join(str(one.itemsize) for one in types)}\n"
        f"TYPE {' '.join(one.kind.upper() for one in types)}\nCOUNT {' '.join('1' for _ in types)}\n"
        f"WIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(cloud)}\nDATA binary\n"
    )
    write_table(path, header, columns)


_MOST_ROUNDING_M = 1e-4
_NORMALS = ("nx", "ny", "nz")
COLOURS = ("red", "green", "blue")


def _columns(cloud: PointCloud) -> Columns:
    """The columns (N,) of a table of the points, by the names of PLY properties."""
    points: NDArray[np.floating] = cloud.points.astype(np.float32)
    if np.abs(points - cloud.points).max(initial=0.0) > _MOST_ROUNDING_M:  # survey coordinates, or kilometres
        points = cloud.points
    columns: Columns = dict(zip("xyz", points.T, strict=True))
    columns |= zip(_NORMALS, cloud.normals.astype(np.float32).T, strict=True)
    for name, values in cloud.attributes.present():
        columns |= zip(COLOURS, values.T, strict=True) if name == "rgb" else [(name, values)]
    return columns


def write_laz(path: Path, cloud: PointCloud, wkt: str | None = None, brightest: float | None = None) -> None:
    """Write a compressed LAS 1.4 file; normals and rings are extra dimensions, `wkt` is its coordinate system.

    Intensities and colours have 16 bits there: intensities up to 1 are scaled to 65535, others rounded. The cloud may
    be a part of a map, whose largest intensity is `brightest`.
    """
    import laspy

    known = cloud.attributes
    header = laspy.LasHeader(version="1.4", point_format=6 if known.rgb is None else 7)
    header.scales = np.full(3, _LAZ_STEP_M)
    header.offsets = np.round(0.5 * (cloud.points.min(axis=0) + cloud.points.max(axis=0)))
    if wkt is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    header.add_extra_dims([laspy.ExtraBytesParams(name, "float32") for name in _LAZ_NORMALS])
    if known.ring is not None:
        header.add_extra_dim(laspy.ExtraBytesParams("ring", "int32"))
    columns = dict(zip("xyz", cloud.points.T, strict=True)) | dict(zip(_LAZ_NORMALS, cloud.normals.T, strict=True))
    columns |= dict.fromkeys(("return_number", "number_of_returns"), np.ones(len(cloud), dtype=np.uint8))
    if known.intensity is not None:
        intensity = np.nan_to_num(known.intensity)
        scale = _LAZ_FULL if (intensity.max() if brightest is None else brightest) <= 1.0 else 1.0
        columns["intensity"] = np.clip(np.round(scale * intensity), 0.0, _LAZ_FULL).astype(np.uint16)
    if known.rgb is not None:
        columns |= zip(("red", "green", "blue"), known.rgb.T.astype(np.uint16) * 257, strict=True)
    if known.ring is not None:
        columns["ring"] = known.ring
    if known.time is not None:
        columns["gps_time"] = known.time
    with laspy.open(path, mode="w", header=header, do_compress=True) as file:
        for first in range(0, len(cloud), POINTS_AT_A_TIME):
            rows = slice(first, first + POINTS_AT_A_TIME)
            record = laspy.ScaleAwarePointRecord.zeros(len(cloud.points[rows]), header=header)
            for name, values in columns.items():
                record[name] = values[rows]
            file.write_points(record)


def write_e57(path: Path, cloud: PointCloud) -> None:
    """Write an E57 file of one scan with coordinates, intensity and colour; pye57 writes no other fields."""
    import pye57

    known = cloud.attributes
    axes = ("cartesianX", "cartesianY", "cartesianZ")
    data = {axis: np.ascontiguousarray(values) for axis, values in zip(axes, cloud.points.T, strict=True)}
    data["cartesianInvalidState"] = np.zeros(len(cloud), dtype=np.int8)  # without it pye57's own read_scan fails
    if known.intensity is not None:
        data["intensity"] = np.nan_to_num(known.intensity)
    if known.rgb is not None:
        data |= zip(("colorRed", "colorGreen", "colorBlue"), known.rgb.T, strict=True)
    file = pye57.E57(str(path), mode="w")
    try:
        file.write_scan_raw(data, name="map")
    finally:
        file.close()


# With their exceptions where a file cannot be written; laspy, its compressor and libE57Format raise any.
_WRITERS: dict[str, tuple[Callable[[Path, PointCloud], None], type[Exception]]] = {
    ".ply": (lambda path, cloud: write_ply(path, _columns(cloud)), OSError),
    ".pcd": (_write_pcd, OSError),
    ".laz": (write_laz, Exception),
    ".e57": (write_e57, Exception),
}
