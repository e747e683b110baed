"""Point-to-plane correspondences of points with surfels: the compiled loops of `SurfelMap.match`.

The columns of surfels (M, 15) are as in `mapping.surfels.grid`: mean, normal, direction, standard deviations
(three each), standard deviation of the elevation, number of points, whether it is a plane.
"""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.registration.surfaces import Surfaces
from lidarslam.mapping.surfels.surfel_kernels import is_steep

# A single ring bent around a corner spans a plane too, that of its own rays. A plane seen at a grazing angle counts
# only when its points differ so much in height across the rings.
_LEAST_HEIGHT_M = 0.05
_FEWEST_POINTS = 6
# The plane of a surfel is as uncertain as if this many of its points counted as one: neighbours share their errors.
_SHARED = 120.0
# Largest cosine between the axis of a compact object and the direction from ring to ring.
_MOST_ACROSS = 0.5


@compiled
def match_planes(
    points: FloatArray, unmatched: NDArray[np.intp], rows: NDArray[np.int32], surfels: FloatArray, sensor: FloatArray,
    spread_m: FloatArray, certain_tilt: float, found: Surfaces,
) -> int:  # fmt: skip
    """Write the surface of every unmatched point (N, 3) whose cell has a plane, unless it has a better one already.

    A better one is known better and its points are spread less: across steps, a coarse plane's are spread more.
    `unmatched` (W,) has the indices of the points, `rows` (W,) those of their cells in `surfels` (M, 15), or -1. Points
    without a plane, or with one whose normal has a standard deviation of `certain_tilt` and more, are moved to the
    beginning of `unmatched`. `spread_m` (N,) has the standard deviations of each plane's points across it, and is
    written.

    Returns:
        Number of the points that were moved.
    """
    left = 0
    for w in range(len(unmatched)):
        n, row = unmatched[w], rows[w]
        if row >= 0:
            p = surfels[row]
            x, y, z = points[n, 0] - sensor[0], points[n, 1] - sensor[1], points[n, 2] - sensor[2]
            distance = math.sqrt(x * x + y * y + z * z)
            along = x * p[3] + y * p[4] + z * p[5]
            faced, behind = is_steep(-along, distance), is_steep(along, distance)
            if p[14] > 0.0 and not behind and (p[12] * distance > _LEAST_HEIGHT_M or faced):
                tilt = p[9] / (max(p[10], 1e-9) * math.sqrt(p[13]))
                spread = p[9] * math.sqrt(p[13] / (p[13] - 3.0))  # three points make the plane
                if found.counts[n] == 0 or (spread < spread_m[n] and _thickness_m(p, 0) < found.thickness_m[n, 0]):
                    found.counts[n], spread_m[n] = 0, spread
                    _write(found, n, p, 0, p[3], p[4], p[5], tilt)
                if tilt < certain_tilt:
                    continue
        unmatched[left] = n
        left += 1
    return left


@compiled
def match_compact(
    points: FloatArray, unmatched: NDArray[np.intp], rows: NDArray[np.int32], surfels: FloatArray,
    T_world_lidar: FloatArray, largest_m: float, found: Surfaces,
) -> None:  # fmt: skip
    """Write the surfaces of unmatched points whose surfel is no plane: across its short axes, through its mean.

    The mean of a surfel is a point on the object only where the object ends within it, not in grass. Across the rings a
    surfel is as short as its rings are close: these axes are left out, or the map would follow the sensor.

    `unmatched` (W,) has the indices of the points (N, 3), `rows` (N,) the cells of all points, or -1. Axes are short
    below a standard deviation of `largest_m`.
    """
    sensor = T_world_lidar[:3, 3]
    ax, ay, az = T_world_lidar[0, 2], T_world_lidar[1, 2], T_world_lidar[2, 2]
    for n in unmatched:
        if rows[n] < 0 or found.counts[n]:
            continue
        p = surfels[rows[n]]
        x, y, z = points[n, 0] - sensor[0], points[n, 1] - sensor[1], points[n, 2] - sensor[2]
        distance = math.sqrt(x * x + y * y + z * z)
        if p[14] > 0.0 or p[13] < _FEWEST_POINTS or not p[12] * distance > _LEAST_HEIGHT_M:
            continue
        distance = max(distance, 1e-9)
        x, y, z = x / distance, y / distance, z / distance
        # From one ring to the next: the axis of rotation, less its part along the ray.
        along = x * ax + y * ay + z * az
        rx, ry, rz = ax - along * x, ay - along * y, az - along * z
        length = max(math.sqrt(rx * rx + ry * ry + rz * rz), 1e-9)
        for axis in range(3):
            u, v, w = _axis(p, axis)
            across_rings = abs(u * rx + v * ry + w * rz) / length
            if p[9 + axis] < largest_m and across_rings < _MOST_ACROSS:
                _write(found, n, p, axis, u, v, w, 0.0)


@compiled_part
def _axis(p: FloatArray, axis: int) -> tuple[float, float, float]:
    """A principal axis of a surfel (15,), by ascending extent."""
    if axis == 0:
        return p[3], p[4], p[5]
    if axis == 1:
        return p[7] * p[5] - p[8] * p[4], p[8] * p[3] - p[6] * p[5], p[6] * p[4] - p[7] * p[3]
    return p[6], p[7], p[8]


@compiled_part
def _thickness_m(surfel: FloatArray, axis: int) -> float:
    """Standard deviation of a surfel (15,) along a principal axis, with that of its position."""
    return float(surfel[9 + axis] * math.sqrt(1.0 + _SHARED / surfel[13]))


@compiled_part
def _write(found: Surfaces, n: int, surfel: FloatArray, axis: int, u: float, v: float, w: float, tilt: float) -> None:
    residual = found.counts[n]
    for i in range(3):
        found.points[n, i] = surfel[i]
    normal = found.normals[n, residual]
    normal[0], normal[1], normal[2] = u, v, w
    found.thickness_m[n, residual], found.tilt[n, residual] = _thickness_m(surfel, axis), tilt
    found.counts[n] += 1
