"""The loop over points behind projection on a processor, compiled; `odometry.projection` says what it computes."""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray

Floats = NDArray[np.float32]

_TURN = 2.0 * math.pi
_TINY = 1e-30
# Points that are taken through angles together, so that the processor takes several at once.
BLOCK = 256


@compiled
def _arc_tangent(y: float, x: float) -> float:
    """atan2, of a rational function without branches, so that the processor takes several at once; NaN for NaN.

    Cephes Mathematical Library, atan.c (Moshier, 1989), exact to double precision.
    """
    ax, ay = abs(x), abs(y)
    large = ax if ax > ay else ay
    small = ay if ax > ay else ax
    t = small / (large if large > _TINY else _TINY)
    steep = t > 0.66
    numerator = t - 1.0 if steep else t
    denominator = t + 1.0 if steep else 1.0
    r = numerator / denominator
    z = r * r
    p = -8.750608600031904e-1
    p = p * z - 1.615753718733365e1
    p = p * z - 7.500855792314705e1
    p = p * z - 1.228866684490136e2
    p = p * z - 6.485021904942025e1
    q = z + 2.485846490142306e1
    q = q * z + 1.650270098316989e2
    q = q * z + 4.328810604912903e2
    q = q * z + 4.853903996359137e2
    q = q * z + 1.945506571482614e2
    angle = r + r * (z * p / q)
    angle = angle + (0.25 * math.pi if steep else 0.0)
    angle = 0.5 * math.pi - angle if ay > ax else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@compiled
def row_of(elevation: float, low: float, rows_per_radian: float) -> float:
    """A whole number, which may lie outside of the image."""
    return float(np.floor((elevation - low) * rows_per_radian + 0.5))


@compiled
def column_of(azimuth: float, width: int) -> float:
    """A whole number."""
    azimuth = azimuth + _TURN if azimuth < 0.0 else azimuth
    column = np.floor(azimuth * (width / _TURN))
    return column if column < width - 1.0 else width - 1.0  # NaN lies in the last column


@compiled
def write_angles(x: FloatArray, y: FloatArray, z: FloatArray, elevations: FloatArray, azimuths: FloatArray) -> None:
    """Write the angles of a block of points, in separate loops, each of which takes several at once."""
    for i in range(len(x)):
        elevations[i] = _arc_tangent(z[i], math.sqrt(x[i] * x[i] + y[i] * y[i]))
    for i in range(len(x)):
        azimuths[i] = _arc_tangent(y[i], x[i])


@compiled
def nearest_in_pixels(
    points: Floats, rows: NDArray[np.int64], low: float, rows_per_radian: float, height: int, width: int,
    index: NDArray[np.int64], ranges: Floats,
) -> None:  # fmt: skip
    """Write the nearest of the points (M, 3) in each pixel (H * W,), -1 where there is none, and its range.

    Args:
        points: those that are not finite or at the origin are left out.
        rows: (M,) of the points where they are known, else empty: then they follow from elevations.
        low: elevation of the centre of row 0.
        rows_per_radian: of elevation.
        height, width: H and W.
        index: (H * W,), written.
        ranges: (H * W,), written.
    """
    index[:] = -1
    ranges[:] = np.inf
    x, y, z = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    elevations, azimuths = np.empty(BLOCK), np.empty(BLOCK)
    distances = np.empty(BLOCK, dtype=np.float32)
    for begin in range(0, len(points), BLOCK):
        size = min(BLOCK, len(points) - begin)
        for i in range(size):
            a, b, c = points[begin + i, 0], points[begin + i, 1], points[begin + i, 2]
            x[i], y[i], z[i] = a, b, c
            distances[i] = np.sqrt(a * a + b * b + c * c)
        write_angles(x[:size], y[:size], z[:size], elevations, azimuths)
        for i in range(size):
            elevations[i] = row_of(elevations[i], low, rows_per_radian)
            azimuths[i] = column_of(azimuths[i], width)
        for i in range(size):
            row, distance = elevations[i] if len(rows) == 0 else float(rows[begin + i]), distances[i]
            if not (row >= 0.0 and row < height and distance > 0.0 and distance < np.inf):
                continue
            pixel = int(row) * width + int(azimuths[i])
            if distance < ranges[pixel]:
                index[pixel], ranges[pixel] = begin + i, distance
