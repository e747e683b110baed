"""Lines and planes through the nearest voxels of features, compiled.

The map has the moments of the points in each voxel, hashed as in `mapping.surfels.hash_kernels`: the five nearest to a
point, by their means, are looked for in its voxel and the 26 around it.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.registration.surfaces import Surfaces
from lidarslam.mapping.surfels.hash_kernels import ABSENT, Keys, Rows, find_one, key_at, neighbour_key, prefetch_around
from lidarslam.mapping.surfels.symmetric import SYMMETRIC, write_eigenvalues, write_eigenvector

# Voxels whose points a plane or line is fitted to, and the least number for a line, which passes through few.
NEIGHBOURS, _LINE_VOXELS = 5, 3
# Least ratio of the two largest variances of a line's neighbours, and of a plane's: points of one ring span no plane.
_LINE_RATIO, _PLANE_RATIO = 3.0, 0.0225
# Least ratio of the two smallest variances of a plane's.
_FLAT_RATIO = 3.0
# Largest distance of a plane's neighbours from it: of these, the smaller one.
_PLANE_M, _PLANE_CELLS = 0.2, 0.5
# Standard deviation of a range, and the number of points it counts as in the scatter of few.
_RANGE_NOISE_M, _COUNTED = 0.02, 2.0
# A line or plane is as uncertain as if this many of its points counted as one: neighbours share their errors.
_SHARED = 120.0
# Largest standard deviation of the direction of a line or plane: across the corner of a floor and a wall, and along a
# ring, five points make planes of any direction, and these move with the rings.
_MOST_TILT = 0.05
# From this on, a plane of coarser voxels is asked for.
_CERTAIN_TILT = 0.03
# Least cosine of the angle between a plane's normal and the beam. The beams of a ring span a plane of their own.
_LEAST_COSINE = 0.1
# Points whose slots are prefetched.
_PREFETCHED = 4
# A voxel with this many points is frozen, so that drift does not smear it.
_MOST_POINTS = 60.0


class Voxels(NamedTuple):
    """The arrays of a map of M voxels."""

    cell_m: float  # edge of a voxel
    bits: int  # binary logarithm of the number of slots
    # table_keys, table_rows: of the hash
    table_keys: Keys
    table_rows: Rows
    sums: FloatArray  # (M, 10) number of points, sums of their coordinates in the world, and of the products of these


@compiled
def add_moments(points: FloatArray, rows: Rows, sums: FloatArray) -> None:
    """Add points (N, 3) to the sums (M, 10) of their rows (N,), unless these are frozen."""
    for n in range(len(points)):
        cell = sums[rows[n]]
        if cell[0] < _MOST_POINTS:
            cell[0] += 1.0
            for axis in range(3):
                cell[1 + axis] += points[n, axis]
            for entry in range(6):
                i, j = SYMMETRIC[entry]
                cell[4 + entry] += points[n, i] * points[n, j]


@compiled
def match_features(
    points: FloatArray, unmatched: NDArray[np.intp], is_line: bool, voxels: Voxels, sensor: FloatArray, found: Surfaces
) -> int:  # fmt: skip
    """Write the line or plane of every unmatched point (N, 3) whose nearest neighbours are on one.

    `unmatched` (W,) has the indices of the points; those without a line or plane, or with a plane of an uncertain
    normal, are moved to its beginning. A plane that is known better takes the place of another. The normal of a plane
    faces the sensor (3,), the first of a line points from that to the point.

    Returns:
        Number of the points that were moved.
    """
    left, scale = 0, 1.0 / voxels.cell_m
    around, near = np.empty(27, dtype=np.int64), np.empty(NEIGHBOURS, dtype=np.int64)
    squared = np.empty(NEIGHBOURS)
    scatter = np.empty(6)
    mean, variances, axis = np.empty(3), np.empty(3), np.empty(3)
    most_off = min(_PLANE_M, _PLANE_CELLS * voxels.cell_m)
    for w in range(len(unmatched)):
        ahead = points[unmatched[min(w + _PREFETCHED, len(unmatched) - 1)]]
        prefetch_around(key_at(ahead, scale), voxels.bits, voxels.table_keys, voxels.table_rows)
        n = unmatched[w]
        count = _nearest(points[n], key_at(points[n], scale), voxels, around, near, squared)
        if count >= (_LINE_VOXELS if is_line else NEIGHBOURS):
            number = _moments(points[n], near[:count], voxels.sums, mean, scatter)
            write_eigenvalues(scatter, variances)
            if is_line and variances[2] > _LINE_RATIO * variances[1]:
                thickness_m, tilt = _uncertainty(variances[1], variances[2], number, 2.0)
                if tilt < _MOST_TILT:
                    write_eigenvector(scatter, variances[2], axis)
                    _write_line(found, n, points[n], mean, axis, thickness_m, tilt)
                    continue
            if not is_line and variances[1] > max(_PLANE_RATIO * variances[2], _FLAT_RATIO * variances[0]):
                thickness_m, tilt = _uncertainty(variances[0], variances[1], number, 3.0)
                write_eigenvector(scatter, variances[0], axis)
                if (
                    tilt < _MOST_TILT
                    and _cosine(mean, axis, sensor) > _LEAST_COSINE
                    and _farthest(near[:count], voxels.sums, mean, axis) < most_off
                ):
                    if found.counts[n] == 0 or thickness_m < found.thickness_m[n, 0]:
                        _write_plane(found, n, mean, axis, thickness_m, tilt, sensor)
                    if tilt < _CERTAIN_TILT:
                        continue
        unmatched[left] = n
        left += 1
    return left


@compiled_part
def _nearest(
    point: FloatArray, key: int, voxels: Voxels, around: NDArray[np.int64], near: NDArray[np.int64], squared: FloatArray
) -> int:  # fmt: skip
    """Write the rows of the nearest voxels to a point (3,), and their squared distances; return their number.

    `around` (27,) holds the rows of all while their sums are prefetched.
    """
    found = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                row = find_one(neighbour_key(key, i, j, k), voxels.bits, voxels.table_keys, voxels.table_rows)
                if row != ABSENT:
                    prefetch(voxels.sums, row)
                    around[found] = row
                    found += 1
    count, most = 0, len(near)
    for row in around[:found]:
        cell = voxels.sums[row]
        x, y, z = cell[1] / cell[0] - point[0], cell[2] / cell[0] - point[1], cell[3] / cell[0] - point[2]
        distance = x * x + y * y + z * z
        if count == most and distance >= squared[most - 1]:
            continue
        place = min(count, most - 1)
        while place > 0 and squared[place - 1] > distance:
            squared[place], near[place] = squared[place - 1], near[place - 1]
            place -= 1
        squared[place], near[place] = distance, row
        count = min(count + 1, most)
    return count


@compiled_part
def _moments(
    point: FloatArray, near: NDArray[np.int64], sums: FloatArray, mean: FloatArray, scatter: FloatArray
) -> float:
    """Write mean (3,) and covariance (6,) of the points in the nearest voxels (K,); return their number.

    Sums are taken about a point (3,) nearby, for the sake of rounding.
    """
    number = 0.0
    mean[:], scatter[:] = 0.0, 0.0
    for row in near:
        cell = sums[row]
        number += cell[0]
        for axis in range(3):
            mean[axis] += cell[1 + axis] - cell[0] * point[axis]
        for entry in range(6):
            i, j = SYMMETRIC[entry]
            crossed = point[i] * cell[1 + j] + point[j] * cell[1 + i]
            scatter[entry] += cell[4 + entry] - crossed + cell[0] * point[i] * point[j]
    for entry in range(6):
        i, j = SYMMETRIC[entry]
        scatter[entry] = scatter[entry] / number - mean[i] * mean[j] / (number * number)
    for axis in range(3):
        mean[axis] = point[axis] + mean[axis] / number
    return number


@compiled_part
def _farthest(near: NDArray[np.int64], sums: FloatArray, mean: FloatArray, axis: FloatArray) -> float:
    """Largest distance of the neighbours (K,) from the plane through their mean across an axis (3,)."""
    farthest = 0.0
    for row in near:
        distance = 0.0
        for i in range(3):
            distance += (sums[row, 1 + i] / sums[row, 0] - mean[i]) * axis[i]
        farthest = max(farthest, abs(distance))
    return farthest


@compiled_part
def _cosine(point: FloatArray, normal: FloatArray, sensor: FloatArray) -> float:
    """Cosine of the angle between a normal (3,) and the beam from the sensor (3,) to a point (3,)."""
    along, squared = 0.0, 0.0
    for i in range(3):
        beam = point[i] - sensor[i]
        along, squared = along + beam * normal[i], squared + beam * beam
    return abs(along) / math.sqrt(max(squared, 1e-12))


@compiled_part
def _uncertainty(across: float, along: float, number: float, spent: float) -> tuple[float, float]:
    """Standard deviations of a line or plane across it, with that of its position, and of its direction.

    Args:
        across, along: variances of its points.
        number: of the points.
        spent: residuals that the fit takes.
    """
    noise = _COUNTED * _RANGE_NOISE_M * _RANGE_NOISE_M
    variance = (number * max(across, 0.0) + noise) / (max(number - spent, 0.0) + _COUNTED)
    thickness_m = math.sqrt(variance * (1.0 + _SHARED / number))
    return thickness_m, math.sqrt(variance / (number * max(along, 1e-12)))


@compiled_part
def _write_plane(
    found: Surfaces, n: int, mean: FloatArray, normal: FloatArray, thickness_m: float, tilt: float, sensor: FloatArray
) -> None:
    found.thickness_m[n, 0], found.tilt[n, 0] = thickness_m, tilt
    facing = 0.0
    for i in range(3):
        facing += (sensor[i] - mean[i]) * normal[i]
    for i in range(3):
        found.points[n, i] = mean[i]
        found.normals[n, 0, i] = normal[i] if facing >= 0.0 else -normal[i]
    found.counts[n] = 1


@compiled_part
def _write_line(
    found: Surfaces, n: int, point: FloatArray, mean: FloatArray, along: FloatArray, thickness_m: float, tilt: float
) -> None:
    x, y, z = point[0] - mean[0], point[1] - mean[1], point[2] - mean[2]
    part = x * along[0] + y * along[1] + z * along[2]
    x, y, z = x - part * along[0], y - part * along[1], z - part * along[2]
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-9:  # on the line: any direction across it
        x, y, z = (0.0, along[2], -along[1]) if abs(along[0]) < 0.7 else (along[2], 0.0, -along[0])
        length = math.sqrt(x * x + y * y + z * z)
    first, second = found.normals[n, 0], found.normals[n, 1]
    first[0], first[1], first[2] = x / length, y / length, z / length
    second[0] = along[1] * first[2] - along[2] * first[1]
    second[1] = along[2] * first[0] - along[0] * first[2]
    second[2] = along[0] * first[1] - along[1] * first[0]
    for axis in range(3):
        found.points[n, axis] = mean[axis]
    for residual in range(2):
        found.thickness_m[n, residual], found.tilt[n, residual] = thickness_m, tilt
    found.counts[n] = 2
