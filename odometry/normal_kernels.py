"""The loops over pixels and their neighbourhoods behind `odometry.normals` on a processor, compiled."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled

Floats = NDArray[np.float32]

_TINY = 1e-30
_NARROWEST = 1e-5
_MOST_GRAZING = 0.04


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
def planes(image: Floats, padded: Floats, taken: NDArray[np.bool_], around: Neighbourhood, normals: Floats) -> None:
    """Write unit normals (3, H, W) that face the sensor, of pixels that have none yet and lie on a plane.

    Args:
        image: (4, H, W) of x, y, z and range; zero where empty.
        padded: (4, H + 2 rows, W + 2 columns), the same with what lies beyond its borders; infinitely far where empty.
        taken: (H, W) pixels that are left as they are.
        around: the neighbourhood.
        normals: written.
    """
    height, width = image.shape[1:]
    sums = np.empty(11, dtype=np.float32)
    for i in range(height):
        for j in range(width):
            if taken[i, j] or not image[3, i, j] > 0.0:
                continue
            _scatter(image, padded, i, j, around, sums)
            x, y, z = _normal(image[0, i, j], image[1, i, j], image[2, i, j], image[3, i, j], sums, around)
            normals[0, i, j], normals[1, i, j], normals[2, i, j] = x, y, z


@compiled
def _scatter(image: Floats, padded: Floats, i: int, j: int, around: Neighbourhood, sums: Floats) -> None:
    """Write what the neighbours of a pixel are like, about the pixel itself: coordinates of tens of metres would leave
    no digits to float32.

    Entries of `sums` (11,): number, squared distance of the nearest, sums of x, y, z, xx, yy, zz, xy, yz, xz.
    """
    cx, cy, cz, centre, gate_m = image[0, i, j], image[1, i, j], image[2, i, j], image[3, i, j], around.gate_m
    zero = np.float32(0.0)
    count, nearest, sx, sy, sz = 0, np.float32(np.inf), zero, zero, zero
    xx, yy, zz, xy, yz, xz = zero, zero, zero, zero, zero, zero
    for down in range(i, i + 2 * around.rows + 1):
        for right in range(j, j + 2 * around.columns + 1):
            if not abs(padded[3, down, right] - centre) <= gate_m:
                continue
            x, y, z = padded[0, down, right] - cx, padded[1, down, right] - cy, padded[2, down, right] - cz
            x2, y2, z2 = x * x, y * y, z * z
            if (down != i + around.rows or right != j + around.columns) and x2 + y2 + z2 < nearest:
                nearest = x2 + y2 + z2
            count += 1
            sx, sy, sz = sx + x, sy + y, sz + z
            xx, yy, zz = xx + x2, yy + y2, zz + z2
            xy, yz, xz = xy + x * y, yz + y * z, xz + x * z
    sums[0], sums[1], sums[2], sums[3], sums[4] = count, nearest, sx, sy, sz
    sums[5], sums[6], sums[7], sums[8], sums[9], sums[10] = xx, yy, zz, xy, yz, xz


@compiled
def _normal(
    x: float, y: float, z: float, distance: float, sums: Floats, around: Neighbourhood
) -> tuple[float, float, float]:
    """The normal of a pixel that has these neighbours; zero if they lie on no plane."""
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
    # Eigenvalues after Smith, 1961, as in `odometry.normals`.
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
