"""Compiled loop of spherical projection; `odometry.images.projection` documents it."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray

Floats = NDArray[np.float32]

_TURN = 2.0 * math.pi
_TINY = 1e-30
# Nearer to the middle of a pixel than this, in pixels, no rounding of single precision leads out of it.
_SURE = 0.499
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


_ZERO, _ONE, _HALF_PI, _PI, _QUARTER = (np.float32(x) for x in (0.0, 1.0, 0.5 * math.pi, math.pi, 0.25 * math.pi))
_STEEP, _LEAST = np.float32(math.sqrt(2.0) - 1.0), np.float32(_TINY)
_P0, _P1, _P2, _P3 = (
    np.float32(x) for x in (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1)
)  # fmt: skip


@compiled
def _rough_arc_tangent(y: np.float32, x: np.float32) -> np.float32:
    """As `_arc_tangent`, to single precision in a fraction of the time; Cephes, atanf.c."""
    ax, ay = abs(x), abs(y)
    large = ax if ax > ay else ay
    small = ay if ax > ay else ax
    t = small / (large if large > _LEAST else _LEAST)
    steep = t > _STEEP
    r = (t - _ONE if steep else t) / (t + _ONE if steep else _ONE)
    z = r * r
    angle = (((_P0 * z + _P1) * z + _P2) * z + _P3) * z * r + r
    angle = angle + (_QUARTER if steep else _ZERO)
    angle = _HALF_PI - angle if ay > ax else angle
    angle = _PI - angle if x < _ZERO else angle
    return -angle if y < _ZERO else angle


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
def write_angles(x: Floats, y: Floats, z: Floats, elevations: Floats, azimuths: Floats) -> None:
    """Write the angles of a block of points to single precision, in loops each of which takes several at once."""
    for i in range(len(x)):
        elevations[i] = _rough_arc_tangent(z[i], np.sqrt(x[i] * x[i] + y[i] * y[i]))
    for i in range(len(x)):
        azimuths[i] = _rough_arc_tangent(y[i], x[i])


class Raster(NamedTuple):
    """The pixels of one range image, and which points they show.

    Attributes:
        height, width: H and W; an image without rows is not made.
        low: elevation of the centre of row 0.
        rows_per_radian: of elevation.
        shown: (H * W,), written: the nearest point of each pixel, -1 where there is none.
        ranges: (H * W,), written: its range; infinite where there is none.
    """

    height: int
    width: int
    low: float
    rows_per_radian: float
    shown: NDArray[np.int64]
    ranges: Floats


@compiled
def nearest_in_pixels(points: FloatArray | Floats, rows: NDArray[np.int64], first: Raster, second: Raster) -> None:
    """Write the nearest of the points (M, 3) in each pixel of two images; of equally near ones, the first.

    Both are made in one go because the angles take most of the time.

    Args:
        points: those that are not finite or at the origin are left out; taken in float32.
        rows: (M,) of the points in the first image where they are known, else empty: then they follow from elevations.
        first, second: the images.
    """
    for raster in (first, second):
        raster.shown[:] = -1
        raster.ranges[:] = np.inf
    x, y, z = np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.float32)
    elevations, azimuths = np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.float32)
    distances = np.empty(BLOCK, dtype=np.float32)
    block = Block(x, y, z, distances, elevations, azimuths, np.empty(BLOCK), np.empty(BLOCK))
    for begin in range(0, len(points), BLOCK):
        size = min(BLOCK, len(points) - begin)
        for i in range(size):
            x[i], y[i], z[i] = points[begin + i, 0], points[begin + i, 1], points[begin + i, 2]
        for i in range(size):
            distances[i] = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])
        write_angles(x[:size], y[:size], z[:size], elevations, azimuths)
        _keep_nearest(begin, size, block, rows, first)
        if second.height > 0:
            _keep_nearest(begin, size, block, rows[:0], second)


class Block(NamedTuple):
    """Points that are put into images together, each (256,): coordinates, ranges, angles, and room for their pixels."""

    x: Floats
    y: Floats
    z: Floats
    distances: Floats
    elevations: Floats
    azimuths: Floats
    rows: FloatArray
    columns: FloatArray


@compiled
def _keep_nearest(begin: int, size: int, block: Block, rings: NDArray[np.int64], raster: Raster) -> None:
    """Put a block of points into an image.

    Single precision tells the pixel of all points but those next to its border, whose angles are taken anew.
    """
    height, width, low, per_radian = raster.height, raster.width, raster.low, raster.rows_per_radian
    shown, ranges, distances, rows, columns = raster.shown, raster.ranges, block.distances, block.rows, block.columns
    per_column = width / _TURN
    for i in range(size):
        rows[i] = (block.elevations[i] - low) * per_radian + 0.5
    for i in range(size):
        azimuth = np.float64(block.azimuths[i])
        columns[i] = (azimuth + _TURN if azimuth < 0.0 else azimuth) * per_column
    for i in range(size):
        distance = distances[i]
        if not (distance > 0.0 and distance < np.inf):
            continue
        row, column = int(rows[i]), int(columns[i])  # what is below 0 is cut to more, and so is not sure
        if len(rings) > 0:
            row = rings[begin + i]
        elif abs(rows[i] - row - 0.5) > _SURE:
            x, y, z = np.float64(block.x[i]), np.float64(block.y[i]), np.float64(block.z[i])
            row = int(row_of(_arc_tangent(z, math.sqrt(x * x + y * y)), low, per_radian))
        if abs(columns[i] - column - 0.5) > _SURE:
            column = int(column_of(_arc_tangent(np.float64(block.y[i]), np.float64(block.x[i])), width))
        if row >= 0 and row < height:
            pixel = row * width + column
            if distance < ranges[pixel]:
                shown[pixel], ranges[pixel] = begin + i, distance


@compiled
def write_pixels(
    points: FloatArray | Floats, times: FloatArray, middle: float, shown: NDArray[np.int64], ranges: Floats,
    image: Floats, offsets: Floats,
) -> None:  # fmt: skip
    """Write what the pixels show; zero where they show nothing.

    Args:
        points: (M, 3).
        times: (M,) seconds, or empty where they are not known.
        middle: of the sweep, seconds.
        shown, ranges: (H * W,) as `nearest_in_pixels` wrote them.
        image: (4, H * W) x, y, z and range, written.
        offsets: (H * W,) seconds from the middle of the sweep, written.
    """
    timed = len(times) > 0
    for pixel in range(len(shown)):
        n = shown[pixel]
        if n < 0:
            image[0, pixel], image[1, pixel], image[2, pixel], image[3, pixel] = 0.0, 0.0, 0.0, 0.0
            offsets[pixel] = 0.0
            continue
        image[0, pixel], image[1, pixel], image[2, pixel] = points[n, 0], points[n, 1], points[n, 2]
        image[3, pixel] = ranges[pixel]
        offsets[pixel] = times[n] - middle if timed else 0.0
