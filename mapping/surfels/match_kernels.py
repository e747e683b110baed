"""Which points are pulled towards the surfaces in cells: the loops behind `LocalMap.match_planes`, compiled.

The columns of patches (M, 15) are those of `mapping.surfels.patches`: point, normal, direction, spreads (three each),
spread of the elevation, points, whether it is a plane.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from mapping.surfels.patch_kernels import is_steep

Rows = NDArray[np.int32]

# A single ring bent around a corner spans a plane too, the one of its own rays. A plane that holds the rays it was seen
# by, being seen at a flat angle, counts only when the rays differ so much in height.
_LEAST_HEIGHT_M = 0.05
_FEWEST_POINTS = 6
_MOST_ACROSS = 0.5


class Pulls(NamedTuple):
    """Room for pulls, one a row, and the number of the point of each; see `mapping.surfels.surfel_map.Matches`."""

    number: NDArray[np.intp]
    points: FloatArray
    normals: FloatArray
    thickness_m: FloatArray
    tilt: FloatArray


class Bodies(NamedTuple):
    """Room for points (N,) in cells that show no plane but hold points enough, and the rows (N,) of their cells."""

    number: NDArray[np.intp]
    rows: Rows


@compiled
def pull_to_planes(
    points: FloatArray, waiting: NDArray[np.intp], rows: Rows, patches: FloatArray, sensor: FloatArray,
    pulls: Pulls, begin: int, bodies: Bodies,
) -> tuple[int, int, int]:  # fmt: skip
    """Write a pull for every point whose cell shows a plane, after the `begin` there are; the others go on waiting.

    Args:
        points: (N, 3) in the world.
        waiting: (W,) which of them look for a plane; those that found none come to its beginning.
        rows: (W,) of the cells of these, -1 where there is none.
        patches: (M, 15).
        sensor: (3,) in the world.
        pulls: where the pulls are written.
        begin: how many there are.
        bodies: where those that found no plane, but other things, are written.

    Returns:
        How many pulls there are now, points that wait, and bodies.
    """
    count, left, others = begin, 0, 0
    for w in range(len(waiting)):
        n, row = waiting[w], rows[w]
        if row >= 0:
            p = patches[row]
            x, y, z = points[n, 0] - sensor[0], points[n, 1] - sensor[1], points[n, 2] - sensor[2]
            distance = math.sqrt(x * x + y * y + z * z)
            several_rings = p[12] * distance > _LEAST_HEIGHT_M
            along = x * p[3] + y * p[4] + z * p[5]
            faced, behind = is_steep(-along, distance), is_steep(along, distance)
            if p[14] > 0.0 and not behind and (several_rings or faced):
                tilt = p[9] / (max(p[10], 1e-9) * math.sqrt(p[13]))
                _write(pulls, count, n, p[0:3], p[3], p[4], p[5], p[9], tilt)
                count += 1
                continue
            if not p[14] > 0.0 and several_rings and p[13] >= _FEWEST_POINTS:
                bodies.number[others], bodies.rows[others] = n, row
                others += 1
        waiting[left] = n
        left += 1
    return count, left, others


@compiled
def pull_to_bodies(
    points: FloatArray, waits: NDArray[np.bool_], bodies: Bodies, patches: FloatArray, T_world_lidar: FloatArray,
    short_m: float, pulls: Pulls, begin: int,
) -> int:  # fmt: skip
    """Write pulls of the bodies that still wait (N,), towards the middle along those axes that they are short along.

    Where the surface goes on beyond the patch, as grass does, the patch's middle is no place on it. Across the rings,
    a patch is as short as the few rings on it are close, wherever the sensor is: the map would follow the sensor.

    Returns:
        How many pulls there are now.
    """
    count = begin
    sensor = T_world_lidar[:3, 3]
    ax, ay, az = T_world_lidar[0, 2], T_world_lidar[1, 2], T_world_lidar[2, 2]
    for b in range(len(bodies.number)):
        n, p = bodies.number[b], patches[bodies.rows[b]]
        if not waits[n]:
            continue
        x, y, z = points[n, 0] - sensor[0], points[n, 1] - sensor[1], points[n, 2] - sensor[2]
        distance = max(math.sqrt(x * x + y * y + z * z), 1e-9)
        x, y, z = x / distance, y / distance, z / distance
        # From one ring to the next: the axis of rotation, less its part along the ray.
        along = x * ax + y * ay + z * az
        rx, ry, rz = ax - along * x, ay - along * y, az - along * z
        length = max(math.sqrt(rx * rx + ry * ry + rz * rz), 1e-9)
        for axis in range(3):
            if axis == 0:
                u, v, w = p[3], p[4], p[5]
            elif axis == 1:
                u, v, w = p[7] * p[5] - p[8] * p[4], p[8] * p[3] - p[6] * p[5], p[6] * p[4] - p[7] * p[3]
            else:
                u, v, w = p[6], p[7], p[8]
            across_rings = abs(u * rx + v * ry + w * rz) / length
            if p[9 + axis] < short_m and across_rings < _MOST_ACROSS:
                _write(pulls, count, n, p[0:3], u, v, w, p[9 + axis], 0.0)
                count += 1
    return count


@compiled
def _write(
    pulls: Pulls, row: int, n: int, point: FloatArray, u: float, v: float, w: float, thickness_m: float, tilt: float
) -> None:
    pulls.number[row] = n
    for axis in range(3):
        pulls.points[row, axis] = point[axis]
    pulls.normals[row, 0], pulls.normals[row, 1], pulls.normals[row, 2] = u, v, w
    pulls.thickness_m[row] = thickness_m
    pulls.tilt[row] = tilt
