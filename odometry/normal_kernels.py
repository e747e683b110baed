"""The loops over pixels and their neighbourhoods behind `odometry.normals`, compiled."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled

Floats = NDArray[np.float32]

_TINY = 1e-30
# A neighbourhood that is narrower than this share of its range is narrower than the rounding of its coordinates.
_NARROWEST = 1e-5
# Range noise spreads the points of a single ring over a plane that holds the rays themselves. Such a plane, 2.3
# degrees or less from the ray, says nothing of the surface, and which of its sides faces the sensor is chance.
_MOST_GRAZING = 0.04
# Pixels that are worked on together, so that the processor takes several at once.
BLOCK = 256


class Neighbourhood(NamedTuple):
    """Which neighbours count, and which neighbourhoods are planes; see `NormalConfig`."""

    rows: int
    columns: int
    gate_m: float
    most_apart_m: float
    min_neighbours: int
    max_flatness: float
    min_spread: float


@compiled
def pad(image: Floats, rows: int, columns: int, padded: Floats) -> None:
    """Write an image (4, H, W) with rows above and below, and columns that go on round; empty is infinitely far."""
    height, width = image.shape[1:]
    padded[:3, :rows], padded[3, :rows] = 0.0, np.inf
    padded[:3, rows + height :], padded[3, rows + height :] = 0.0, np.inf
    for channel in range(4):
        for i in range(height):
            row = padded[channel, rows + i]
            row[columns : columns + width] = image[channel, i]
            row[:columns] = image[channel, i, width - columns :]
            row[columns + width :] = image[channel, i, :columns]
    for i in range(height):
        ranges = padded[3, rows + i]
        for j in range(len(ranges)):
            ranges[j] = ranges[j] if ranges[j] > 0.0 else np.inf


@compiled
def planes(padded: Floats, margin: int, around: Neighbourhood, normals: Floats) -> None:
    """Write unit normals (3, H, W) that face the sensor, of pixels that have none yet and lie on a plane.

    Args:
        padded: (4, H + 2 rows, W + 2 margin) of x, y, z and range, with what lies beyond the image's borders;
            infinitely far where empty.
        margin: columns to either side, no fewer than those of the neighbourhood.
        around: the neighbourhood.
        normals: written.
    """
    height, width = normals.shape[1:]
    wanted, sums = np.empty(width, dtype=np.int64), np.empty((11, BLOCK), dtype=np.float32)
    centre, neighbours = np.empty((4, BLOCK), dtype=np.float32), np.empty((4, BLOCK), dtype=np.float32)
    for i in range(height):
        count, ranges = 0, padded[3, i + around.rows]
        for j in range(width):
            if ranges[margin + j] < np.inf and not (normals[0, i, j] or normals[1, i, j] or normals[2, i, j]):
                wanted[count] = margin + j
                count += 1
        for begin in range(0, count, BLOCK):
            block = wanted[begin : min(begin + BLOCK, count)]
            _scatter(padded, i, block, around, centre, neighbours, sums)
            for k in range(len(block)):
                j = block[k] - margin
                normals[0, i, j], normals[1, i, j], normals[2, i, j] = _normal(centre[:, k], sums[:, k], around)


@compiled
def _scatter(
    padded: Floats, i: int, block: NDArray[np.int64], around: Neighbourhood, centre: Floats, neighbours: Floats,
    sums: Floats,
) -> None:  # fmt: skip
    """Write what the neighbours of the pixels of a block, all of row i, are like, about the pixel itself.

    Coordinates of tens of metres would leave no digits to float32.

    Rows of `sums` (11, 256): number, squared distance of the nearest, sums of x, y, z, xx, yy, zz, xy, yz, xz. Each
    neighbour is added for the whole block, so that the processor takes several pixels at once.
    """
    size = len(block)
    for channel in range(4):
        _gather(padded[channel, i + around.rows], block, 0, centre[channel])
    sums[:] = 0.0
    sums[1] = np.inf
    gate_m = np.float32(around.gate_m)
    for down in range(2 * around.rows + 1):
        for right in range(-around.columns, around.columns + 1):
            for channel in range(4):
                _gather(padded[channel, i + down], block, right, neighbours[channel])
            x, y, z = neighbours[0], neighbours[1], neighbours[2]
            _differences(size, gate_m, centre, neighbours)
            if down != around.rows or right != 0:
                _keep_least(size, neighbours, sums[1])
            near = neighbours[3]
            _add(size, near, sums[0])
            _add(size, x, sums[2])
            _add(size, y, sums[3])
            _add(size, z, sums[4])
            _add_product(size, x, x, sums[5])
            _add_product(size, y, y, sums[6])
            _add_product(size, z, z, sums[7])
            _add_product(size, x, y, sums[8])
            _add_product(size, y, z, sums[9])
            _add_product(size, x, z, sums[10])


@compiled
def _gather(row: Floats, block: NDArray[np.int64], right: int, values: Floats) -> None:
    for k in range(len(block)):
        values[k] = row[block[k] + right]


@compiled
def _differences(size: int, gate_m: np.float32, centre: Floats, neighbours: Floats) -> None:
    """Make neighbours differences to the centre, zero where they are not near; their ranges become 1 where they are."""
    x, y, z, distance = neighbours[0], neighbours[1], neighbours[2], neighbours[3]
    cx, cy, cz, middle = centre[0], centre[1], centre[2], centre[3]
    for k in range(size):
        distance[k] = np.float32(1.0) if abs(distance[k] - middle[k]) <= gate_m else np.float32(0.0)
    for k in range(size):
        x[k] = (x[k] - cx[k]) * distance[k]
    for k in range(size):
        y[k] = (y[k] - cy[k]) * distance[k]
    for k in range(size):
        z[k] = (z[k] - cz[k]) * distance[k]


@compiled
def _keep_least(size: int, neighbours: Floats, nearest: Floats) -> None:
    x, y, z, near = neighbours[0], neighbours[1], neighbours[2], neighbours[3]
    for k in range(size):
        squared = x[k] * x[k] + y[k] * y[k] + z[k] * z[k]
        squared = squared if near[k] > 0.0 else np.float32(np.inf)
        nearest[k] = squared if squared < nearest[k] else nearest[k]


@compiled
def _add(size: int, values: Floats, total: Floats) -> None:
    for k in range(size):
        total[k] += values[k]


@compiled
def _add_product(size: int, values: Floats, others: Floats, total: Floats) -> None:
    for k in range(size):
        total[k] += values[k] * others[k]


@compiled
def _normal(centre: Floats, sums: Floats, around: Neighbourhood) -> tuple[float, float, float]:
    """The normal of a pixel (4,) that has these neighbours; zero if they lie on no plane."""
    x, y, z, distance = centre[0], centre[1], centre[2], centre[3]
    none = 0.0, 0.0, 0.0
    count = np.float64(sums[0])
    if count < around.min_neighbours or sums[1] > around.most_apart_m**2:
        return none
    mx, my, mz = sums[2] / count, sums[3] / count, sums[4] / count
    xx, yy, zz = sums[5] - sums[2] * mx, sums[6] - sums[3] * my, sums[7] - sums[4] * mz
    xy, yz, xz = sums[8] - sums[2] * my, sums[9] - sums[3] * mz, sums[10] - sums[2] * mz
    # Rounding may leave next to nothing, or less, of the scatter of points that are all but one.
    size = xx + yy + zz
    if not size > _TINY:
        return none
    xx, yy, zz, xy, yz, xz = xx / size, yy / size, zz / size, xy / size, yz / size, xz / size
    # Smith, "Eigenvalues of a symmetric 3 x 3 matrix", 1961. Where the two larger ones are nearly equal their
    # difference is inexact, but not the smallest.
    a, b, c = xx - 1.0 / 3.0, yy - 1.0 / 3.0, zz - 1.0 / 3.0
    radius = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + yz * yz + xz * xz)) / 6.0)
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    cosine = determinant / (2.0 * max(radius, 1e-9) ** 3)
    angle = math.acos(min(max(cosine, -1.0), 1.0)) / 3.0
    largest = 1.0 / 3.0 + 2.0 * radius * math.cos(angle)
    smallest = 1.0 / 3.0 + 2.0 * radius * math.cos(angle + 2.0 * math.pi / 3.0)
    middle = 1.0 - largest - smallest
    if not (smallest <= around.max_flatness * middle and middle >= around.min_spread * largest):
        return none
    if not middle * size > count * (_NARROWEST * distance) ** 2:
        return none
    # The rows of A - smallest I are at right angles to the normal: the longest of their cross products is along it.
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    first, second, third = b * c - yz * yz, a * c - xz * xz, a * b - xy * xy
    off_xy, off_yz, off_xz = xz * yz - xy * c, xy * xz - a * yz, xy * yz - xz * b
    if first >= second and first >= third:
        u, v, w = first, off_xy, off_xz
    elif second >= third:
        u, v, w = off_xy, second, off_yz
    else:
        u, v, w = off_xz, off_yz, third
    length = math.sqrt(u * u + v * v + w * w)
    away = (u * x + v * y + w * z) / max(length, _TINY)
    if not abs(away) >= _MOST_GRAZING * distance:
        return none
    length = max(length, _TINY) * (-1.0 if away > 0.0 else 1.0)
    return u / length, v / length, w / length
