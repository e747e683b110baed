"""Maps in the formats of surveyors: LAZ by laspy, E57 by pye57."""

from pathlib import Path
from typing import Protocol

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import PointAttributes

# Metres; 32 bits of it reach 200 km to either side.
_LAZ_STEP_M = 1e-4
_LAZ_FULL = 65535.0
# LAS has no normals; these are the names of PDAL and CloudCompare.
_LAZ_NORMALS = ("NormalX", "NormalY", "NormalZ")
_POINTS_AT_A_TIME = 1_000_000


class Cloud(Protocol):
    """What is written: points (N, 3), their normals (N, 3) and attributes."""

    @property
    def points(self) -> FloatArray:
        """(N, 3) metres, in the world."""

    @property
    def normals(self) -> FloatArray:
        """(N, 3) of unit length."""

    @property
    def attributes(self) -> PointAttributes:
        """Of the points."""

    def __len__(self) -> int:
        """The number of points."""


def write_laz(path: Path, cloud: Cloud, wkt: str | None = None, brightest: float | None = None) -> None:
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
        for first in range(0, len(cloud), _POINTS_AT_A_TIME):
            rows = slice(first, first + _POINTS_AT_A_TIME)
            record = laspy.ScaleAwarePointRecord.zeros(len(cloud.points[rows]), header=header)
            for name, values in columns.items():
                record[name] = values[rows]
            file.write_points(record)


def write_e57(path: Path, cloud: Cloud) -> None:
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
