"""Range images of point clouds by spherical projection."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray

Floats = NDArray[np.float32]
Points = FloatArray | Floats

# A scan's elevations are taken between these quantiles, so that single stray points do not stretch the rows.
_STRAY_SHARE = 0.002
# Rows of a scan with one ring only are this far apart in all: more than the noise of elevations.
_LEAST_HEIGHT = math.radians(1.0)
_HEIGHT_WITHOUT_POINTS = math.radians(15.0)
# Nearer to the middle of a pixel than this, in pixels, no rounding of single precision leads out of it.
_SURE = np.float32(0.498)
_TURN = 2.0 * math.pi
_ZERO, _HALF, _ONE, _HALF_PI, _PI, _QUARTER = (
    np.float32(x) for x in (0.0, 0.5, 1.0, 0.5 * math.pi, math.pi, 0.25 * math.pi)
)  # fmt: skip
_WHOLE, _FAR = np.float32(_TURN), np.float32(np.inf)
# Codes for the pixel of a point in none, and of one too near to a border; and the same as numbers of pixels,
# which are floats until they are stored.
_OUTSIDE, _UNSURE = -1, -2
_ABOVE_OR_BELOW, _NOT_SURE = np.float32(_OUTSIDE), np.float32(_UNSURE)
# The nearest point of a pixel as one number: the bits of its range above those of its index.
_INDEX_BITS, _NONE = 32, np.int64((1 << 63) - 1)
_INDEX_MASK = np.int64((1 << _INDEX_BITS) - 1)
# Points that are worked on together.
_BLOCK = 1024
_STEEP, _LEAST = np.float32(math.sqrt(2.0) - 1.0), np.float32(1e-30)
_P0, _P1, _P2, _P3 = (
    np.float32(x) for x in (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1)
)  # fmt: skip


@dataclass(frozen=True)
class ImageGrid:
    """The pixels of a range image: rows by elevation from the lowest up, columns by azimuth, without a seam."""

    rows: int  # H, 2 or more
    columns: int  # W; column c covers azimuths from c to c + 1 times 2 pi / W
    # elevation_low, elevation_high: elevations of the centres of rows 0 and H - 1, rad, ascending
    elevation_low: float
    elevation_high: float

    @classmethod
    def around(cls, points: Points, rows: int, columns: int) -> "ImageGrid":
        """The grid that spans the elevations of one scan, points (N, 3), but for the outermost 0.2 % on either side.

        It spans at least 1 degree, from the lowest point up; and -15 to 15 degrees if there are no points.
        """
        # Coordinates of a float32 have squares that are in range, or else are no point.
        squares = np.square(np.asarray(points, dtype=np.float32)).sum(axis=1)
        x, y, z = np.asarray(points, dtype=np.float64)[np.isfinite(squares) & (squares > 0.0)].T
        if not len(x):
            return cls(rows, columns, -_HEIGHT_WITHOUT_POINTS, _HEIGHT_WITHOUT_POINTS)
        strays = int(_STRAY_SHARE * len(x))
        last = len(x) - 1 - strays
        ordered = np.partition(np.arctan2(z, np.hypot(x, y)), (strays, last))
        low, high = float(ordered[strays]), float(ordered[last])
        return cls(rows, columns, low, max(high, low + _LEAST_HEIGHT))

    @property
    def rows_per_radian(self) -> float:
        """Of elevation."""
        return (self.rows - 1) / (self.elevation_high - self.elevation_low)


@dataclass(frozen=True, eq=False)
class Projection:
    """A range image, and which points it shows."""

    image: Floats  # (4, H, W) float32 of x, y, z and range, metres; zero where no point is
    index: NDArray[np.int64]  # (H, W) int64, the point in each pixel; -1 where there is none


def project(points: Points, grids: Sequence[ImageGrid]) -> list[Projection]:
    """The nearest of the points (M, 3), metres, in each pixel of several images; of equally near ones, the first.

    Points that are not finite, at the origin, or above or below a grid are left out.
    """
    x, y, z, ranges, elevations, azimuths = np.empty((6, len(points)), dtype=np.float32)
    _write_coordinates(np.ascontiguousarray(points, dtype=np.float64), x, y, z, ranges, elevations, azimuths)
    projections = []
    for grid in grids:
        nearest = np.full(grid.rows * grid.columns, _NONE)
        low, per_radian = grid.elevation_low, grid.rows_per_radian
        _keep_nearest(x, y, z, ranges, elevations, azimuths, grid.rows, grid.columns, low, per_radian, nearest)
        index, image = np.empty(len(nearest), dtype=np.int64), np.empty((4, len(nearest)), dtype=np.float32)
        _write_pixels(x, y, z, ranges, nearest, index, image)
        shape = (grid.rows, grid.columns)
        projections.append(Projection(image.reshape(4, *shape), index.reshape(shape)))
    return projections


@compiled
def _write_coordinates(
    points: FloatArray, x: Floats, y: Floats, z: Floats, ranges: Floats, elevations: Floats, azimuths: Floats
) -> None:
    """Write the coordinates of points (N, 3) and their angles to single precision, in vectorised loops."""
    for i in range(len(points)):
        x[i], y[i], z[i] = points[i, 0], points[i, 1], points[i, 2]
    for i in range(len(points)):
        ranges[i] = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])
    for i in range(len(points)):
        elevations[i] = arc_tangent(z[i], np.sqrt(x[i] * x[i] + y[i] * y[i]))
    for i in range(len(points)):
        azimuths[i] = arc_tangent(y[i], x[i])


@compiled
def _keep_nearest(
    x: Floats, y: Floats, z: Floats, ranges: Floats, elevations: Floats, azimuths: Floats,
    height: int, width: int, low: float, per_radian: float, nearest: NDArray[np.int64],
) -> None:  # fmt: skip
    """Write the nearest point (H * W,) of each pixel: the bits of its range, which ascend with it, and its index.

    Angles of single precision decide the pixel of all points but those next to its border, whose angles are recomputed.
    """
    pixels, bits = np.empty(_BLOCK, dtype=np.int32), ranges.view(np.int32)
    for begin in range(0, len(ranges), _BLOCK):
        end = min(begin + _BLOCK, len(ranges))
        _find_pixels(
            ranges[begin:end], elevations[begin:end], azimuths[begin:end], height, width, low, per_radian, pixels
        )
        for i in range(begin, end):
            pixel = pixels[i - begin]
            if pixel == _UNSURE:
                px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
                row = np.floor((math.atan2(pz, math.sqrt(px * px + py * py)) - low) * per_radian + 0.5)
                inside = row >= 0.0 and row < height
                pixel = int(row) * width + int(_column_of(math.atan2(py, px), width)) if inside else _OUTSIDE
            if pixel != _OUTSIDE:
                # Without a branch on which is nearer, which would be mispredicted.
                nearest[pixel] = min(nearest[pixel], (np.int64(bits[i]) << _INDEX_BITS) | i)


@compiled_part
def _find_pixels(
    ranges: Floats, elevations: Floats, azimuths: Floats, height: int, width: int, low: float, per_radian: float,
    pixels: NDArray[np.int32],
) -> None:  # fmt: skip
    """Write the pixels of a block of points in a vectorised loop, OUTSIDE or UNSURE."""
    rows, columns, lowest = np.float32(height), np.float32(width), np.float32(low)
    rows_per_radian, columns_per_radian = np.float32(per_radian), np.float32(width / _TURN)
    for k in range(len(ranges)):
        up = (elevations[k] - lowest) * rows_per_radian + _HALF
        across = (azimuths[k] + (_WHOLE if azimuths[k] < _ZERO else _ZERO)) * columns_per_radian
        row, column = np.floor(up), np.floor(across)
        sure = abs(up - row - _HALF) <= _SURE and abs(across - column - _HALF) <= _SURE
        pixel = row * columns + column if row >= _ZERO and row < rows else _ABOVE_OR_BELOW
        pixel = pixel if sure else _NOT_SURE
        there = ranges[k] > _ZERO and ranges[k] < _FAR
        pixels[k] = np.int32(pixel if there else _ABOVE_OR_BELOW)


@compiled
def _write_pixels(
    x: Floats, y: Floats, z: Floats, ranges: Floats, nearest: NDArray[np.int64], index: NDArray[np.int64], image: Floats
) -> None:
    """Write the indices (H * W,) and the points of an image (4, H * W) from the nearest points of `_keep_nearest`."""
    for pixel in range(len(index)):
        n = index[pixel] = nearest[pixel] & _INDEX_MASK if nearest[pixel] != _NONE else -1
        if n >= 0:
            image[0, pixel], image[1, pixel], image[2, pixel], image[3, pixel] = x[n], y[n], z[n], ranges[n]
        else:
            image[0, pixel], image[1, pixel], image[2, pixel], image[3, pixel] = _ZERO, _ZERO, _ZERO, _ZERO


@compiled_part
def _column_of(azimuth: float, width: int) -> float:
    """A whole number inside the image."""
    azimuth = azimuth + _TURN if azimuth < 0.0 else azimuth
    column = np.floor(azimuth * (width / _TURN))
    return column if column < width - 1.0 else width - 1.0  # NaN lies in the last column


@compiled_part
def arc_tangent(y: np.float32, x: np.float32) -> np.float32:
    """atan2 in single precision without branches, so that loops are vectorised; NaN for NaN.

    Cephes Mathematical Library, atanf.c (Moshier, 1989).
    """
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
