"""Projective correspondences of two sweeps and their point-to-plane residuals, in compiled loops.

Each point of the current sweep corresponds to the pixel of the previous one that it is projected into. The pixels are
as measured, each at its own time: points are taken to that time, projected, and compared there.

Points are worked on in blocks, of which a processor takes eight numbers of single precision at once: each quantity of a
block lies in a part of one array, so that the compiler sees that no two overlap.
"""

import math
from typing import NamedTuple

import numpy as np

from lidarslam.core.compiled import compiled_part
from lidarslam.core.geometry import FloatArray
from lidarslam.odometry.images.projection import Floats, arc_tangent

# Points that are worked on together.
BLOCK = 256
# From one quantity of a block to the next. Were it a power of two, the processor would take a store for what the next
# load needs, and wait.
STRIDE = BLOCK + 32
# Where the quantities of a block begin. Of the points: coordinates, normals and seconds from the middle of the sweep.
_POINT_X, _POINT_Y, _POINT_Z, _POINT_U, _POINT_V, _POINT_W, POINT_T = (n * STRIDE for n in range(7))
# Coordinates in the frame of the previous sweep at the time of the pixel, normals in that of its middle.
X, Y, Z, TURNED_U, TURNED_V, TURNED_W = (n * STRIDE for n in range(7, 13))
# The index of the pixel, and its point, normal and seconds.
_PIXEL, _AT_X, _AT_Y, _AT_Z, U, V, W, _T = (n * STRIDE for n in range(13, 21))
# 1 or 0: whether the point falls into the image, and whether it is an inlier.
IN_VIEW, INLIER = (n * STRIDE for n in range(21, 23))
# The Jacobian (6,) and the residual, times the root of the weight; the residual as it is.
ROW, WEIGHTED, RESIDUAL = 23 * STRIDE, 29 * STRIDE, 30 * STRIDE
SIZE = 31 * STRIDE
# A point is an outlier farther from its pixel than this, metres: at the sensor, and for each metre of range where the
# beam meets the surface at a right angle; or where the cosine between the two normals is less.
_GATE_M, _GATE_PER_M, _LEAST_COSINE = np.float32(0.2), np.float32(0.04), np.float32(0.8)
# Sine of the angle between beam and surface below which pixels are not taken as any wider.
_MOST_GRAZING = np.float32(0.2)
_ZERO, _HALF, _ONE, _TWO, _TINY = (np.float32(x) for x in (0.0, 0.5, 1.0, 2.0, 1e-6))
_TURN = np.float32(2.0 * math.pi)


class Planes(NamedTuple):
    """The image that points are projected into."""

    pixels: Floats  # (H * W, 7) point, normal and seconds from the middle of the sweep, of each pixel
    # height, width: H and W
    height: int
    width: int
    # low, high: elevation of the centres of the first and the last row, radians
    low: float
    high: float
    rolling: bool  # whether any of the seconds is not zero


class Motion(NamedTuple):
    """T_prev_curr (4, 4), and the velocities (6,) in the middles of the previous and of the current sweep."""

    T: FloatArray
    early: FloatArray
    late: FloatArray


@compiled_part
def correspond(size: int, planes: Planes, motion: Motion, scale_m: np.float32, is_robust: bool, work: Floats) -> None:
    """Find the correspondences of a block of points.

    The time of a pixel is found by projecting without motion within the previous sweep, which is exact but at its seam.
    """
    _move(size, _single(motion.T.reshape(16)), _single(motion.late), work)
    for taken_back in range(2 if planes.rolling else 1):
        if taken_back:
            _take_back(size, _single(motion.early), work)
        _project(size, planes, work)
        _look_up(size, planes.pixels, work)
    _judge(size, scale_m, is_robust, work)


@compiled_part
def _single(values: FloatArray) -> Floats:
    rounded = np.empty(len(values), dtype=np.float32)
    for i in range(len(values)):
        rounded[i] = values[i]
    return rounded


@compiled_part
def _compensate(
    x: np.float32, y: np.float32, z: np.float32, t: np.float32, velocity: Floats
) -> tuple[np.float32, np.float32, np.float32]:
    """A point measured t seconds after the middle of the sweep, in the frame of the middle, at an even velocity.

    The exponential map to second order.
    """
    a, b, c = velocity[0], velocity[1], velocity[2]
    u = b * z - c * y + velocity[3]
    v = c * x - a * z + velocity[4]
    w = a * y - b * x + velocity[5]
    half = _HALF * t
    return (
        x + t * (u + half * (b * w - c * v)),
        y + t * (v + half * (c * u - a * w)),
        z + t * (w + half * (a * v - b * u)),
    )


@compiled_part
def _move(size: int, T: Floats, late: Floats, work: Floats) -> None:
    """Take points and normals to the frame of the previous sweep by T_prev_curr, row by row (16,)."""
    for k in range(size):
        x, y, z = _compensate(work[_POINT_X + k], work[_POINT_Y + k], work[_POINT_Z + k], work[POINT_T + k], late)
        work[X + k] = T[0] * x + T[1] * y + T[2] * z + T[3]
        work[Y + k] = T[4] * x + T[5] * y + T[6] * z + T[7]
        work[Z + k] = T[8] * x + T[9] * y + T[10] * z + T[11]
    for k in range(size):
        u, v, w = work[_POINT_U + k], work[_POINT_V + k], work[_POINT_W + k]
        work[TURNED_U + k] = T[0] * u + T[1] * v + T[2] * w
        work[TURNED_V + k] = T[4] * u + T[5] * v + T[6] * w
        work[TURNED_W + k] = T[8] * u + T[9] * v + T[10] * w


@compiled_part
def _take_back(size: int, early: Floats, work: Floats) -> None:
    """Take points from the middle of the previous sweep to the time of their pixels, which their own seconds get."""
    for k in range(size):
        work[POINT_T + k] += work[_T + k]
        x, y, z = _compensate(work[X + k], work[Y + k], work[Z + k], -work[_T + k], early)
        work[X + k], work[Y + k], work[Z + k] = x, y, z


@compiled_part
def _project(size: int, planes: Planes, work: Floats) -> None:
    """Write the pixels of a block of points, and whether they are in view."""
    height, width, low = np.float32(planes.height), np.float32(planes.width), np.float32(planes.low)
    per_radian = np.float32((planes.height - 1) / (planes.high - planes.low))
    columns_per_radian = width / _TURN
    for k in range(size):
        x, y = work[X + k], work[Y + k]
        elevation = arc_tangent(work[Z + k], np.sqrt(x * x + y * y))
        row = np.floor((elevation - low) * per_radian + _HALF)
        work[IN_VIEW + k] = _ONE if row >= _ZERO and row < height else _ZERO
        row = row if row > _ZERO else _ZERO  # NaN lies in the first row
        row = row if row < height else height - _ONE
        azimuth = arc_tangent(y, x)
        column = np.floor((azimuth + (_TURN if azimuth < _ZERO else _ZERO)) * columns_per_radian)
        column = column if column < width - _ONE else width - _ONE  # NaN lies in the last column
        work[_PIXEL + k] = row * width + column


@compiled_part
def _look_up(size: int, pixels: Floats, work: Floats) -> None:
    """Write the point, the normal and the seconds of the pixels."""
    for k in range(size):
        pixel = pixels[int(work[_PIXEL + k])]
        work[_AT_X + k], work[_AT_Y + k], work[_AT_Z + k] = pixel[0], pixel[1], pixel[2]
        work[U + k], work[V + k], work[W + k], work[_T + k] = pixel[3], pixel[4], pixel[5], pixel[6]


@compiled_part
def _judge(size: int, scale_m: np.float32, is_robust: bool, work: Floats) -> None:
    """Write the residuals, and which points are inliers: in view, near enough to their pixel, and turned like it.

    The gate is the width of a pixel on the surface: farther points are of another surface, seen past an edge. On ground
    at grazing incidence pixels are metres wide; a narrower gate would keep points on their own rings, which move with
    the sensor, and bias the motion.
    """
    most_m = np.float32(np.inf) if is_robust else _TWO * scale_m
    for k in range(size):
        x, y, z, u, v, w = work[X + k], work[Y + k], work[Z + k], work[U + k], work[V + k], work[W + k]
        dx, dy, dz = x - work[_AT_X + k], y - work[_AT_Y + k], z - work[_AT_Z + k]
        squared = x * x + y * y + z * z
        across, least = abs(x * u + y * v + z * w), _MOST_GRAZING * np.sqrt(squared)
        across = across if across > least else least
        across = across if across > _TINY else _TINY
        gate = _GATE_M + _GATE_PER_M * squared / across + scale_m
        cosine = work[TURNED_U + k] * u + work[TURNED_V + k] * v + work[TURNED_W + k] * w
        residual = dx * u + dy * v + dz * w
        near = dx * dx + dy * dy + dz * dz < gate * gate and abs(residual) < most_m
        seen = work[IN_VIEW + k] > _ZERO
        work[INLIER + k] = _ONE if seen and near and cosine > _LEAST_COSINE else _ZERO
        work[RESIDUAL + k] = residual
