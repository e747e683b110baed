"""Normals that agree with those around them: means over what belongs to the same surface.

A plane fitted to few rings is tilted by their noise and by the offsets of single lasers, which go along with the
sensor. A point on level ground is then held against a plane that leans, the more so the farther it is from the pixel's
own point, and all of them together hold the sensor back. Means over several rings have little of it.
"""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled

Floats = NDArray[np.float32]

# How far along rows and columns is averaged, in pixels.
_ROWS, _COLUMNS = 3, 8
# Cosine between normals, and distance between points, of what belongs to the same surface.
_LEAST_COSINE = np.float32(0.9)
_MOST_APART_M = np.float32(2.0)


def smoothed(points: Floats, normals: Floats) -> Floats:
    """Unit normals (3, H, W), averaged along rows and then along columns; zero where there was none.

    Args:
        points, normals: (3, H, W) float32, zero where there is none.
    """
    along, both = np.zeros_like(normals), np.zeros_like(normals)
    _average(points, normals, 0, _COLUMNS, along)
    _average(points, along, _ROWS, 0, both)
    return both


@compiled
def _average(points: Floats, normals: Floats, rows: int, columns: int, means: Floats) -> None:
    """Write the means (3, H, W) over pixels up to so many rows or columns away; one of the two is zero."""
    _, height, width = points.shape
    apart2 = _MOST_APART_M * _MOST_APART_M
    for i in range(height):
        for j in range(width):
            u, v, w = normals[0, i, j], normals[1, i, j], normals[2, i, j]
            if u == 0.0 and v == 0.0 and w == 0.0:
                continue
            x, y, z = points[0, i, j], points[1, i, j], points[2, i, j]
            a, b, c = u, v, w
            for step in range(-max(rows, columns), max(rows, columns) + 1):
                k = i + step if rows > 0 else i
                m = j + step if columns > 0 else j
                if step == 0 or k < 0 or k >= height:
                    continue
                if m < 0:
                    m += width
                elif m >= width:
                    m -= width
                p, q, r = normals[0, k, m], normals[1, k, m], normals[2, k, m]
                if u * p + v * q + w * r < _LEAST_COSINE:
                    continue
                dx, dy, dz = points[0, k, m] - x, points[1, k, m] - y, points[2, k, m] - z
                if dx * dx + dy * dy + dz * dz < apart2:
                    a, b, c = a + p, b + q, c + r
            scale = np.float32(1.0 / math.sqrt(a * a + b * b + c * c))
            means[0, i, j], means[1, i, j], means[2, i, j] = a * scale, b * scale, c * scale
