"""Projective correspondences and point-to-plane residuals of two sweeps, in compiled loops.

Each point of the current sweep corresponds to the pixel of the previous one that it is projected into. The pixels are
as measured, each at its own time: points are taken to that time, projected, and compared there.

Points are worked on in blocks, of which a processor takes eight numbers of single precision at once: each quantity of a
block lies in a part of one array, so that the compiler sees that no two overlap.
"""

import math
from typing import NamedTuple

import numpy as np

from lidarslam.core.compiled import compiled, compiled_part, compiled_sums
from lidarslam.core.geometry import FloatArray
from lidarslam.odometry.images.projection import Floats, arc_tangent

# Points that are worked on together.
_BLOCK = 256
# From one quantity of a block to the next. Were it a power of two, the processor would take a store for what the next
# load needs, and wait.
_STRIDE = _BLOCK + 32
# Where the quantities of a block begin. Of the points: coordinates, normals and seconds from the middle of the sweep.
_POINT_X, _POINT_Y, _POINT_Z, _POINT_U, _POINT_V, _POINT_W, _POINT_T = (n * _STRIDE for n in range(7))
# Coordinates in the frame of the previous sweep at the time of the pixel, normals in that of its middle.
_X, _Y, _Z, _TURNED_U, _TURNED_V, _TURNED_W = (n * _STRIDE for n in range(7, 13))
# The index of the pixel, and its point, normal and seconds.
_PIXEL, _AT_X, _AT_Y, _AT_Z, _U, _V, _W, _T = (n * _STRIDE for n in range(13, 21))
# 1 or 0: whether the point falls into the image, and whether it is an inlier.
_IN_VIEW, _INLIER = (n * _STRIDE for n in range(21, 23))
# The Jacobian (6,) and the residual, times the root of the weight; the residual as it is.
_ROW, _WEIGHTED, _RESIDUAL = 23 * _STRIDE, 29 * _STRIDE, 30 * _STRIDE
_SIZE = 31 * _STRIDE
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


@compiled
def accumulate(
    points: Floats, count: int, planes: Planes, motion: Motion, scale_m: float, is_robust: bool, total: FloatArray,
    in_view: FloatArray, inlier: FloatArray,
) -> tuple[int, int]:  # fmt: skip
    """Sums over the correspondences of the first `count` points (7, N).

    A point seen t seconds after the middle of its sweep, on a pixel seen t' after that of its own, moves with the
    change of velocity (t + t') times as it does with the motion.

    Args:
        points, count, planes, motion: see above.
        scale_m: of the residuals.
        is_robust: all inliers, with Geman and McClure's weights; else those within twice the scale, unweighted.
        total: (13, 13), zero, written: H (12, 12) and, in the last column, g (12,) and the sum of squared residuals.
        in_view, inlier: (3, 3), zero, written unless robust: sums of squared normals in the previous frame, of points
            in view and of inliers.

    Returns:
        How many points are in view, and how many are inliers.
    """
    work = np.zeros(_SIZE, dtype=np.float32)
    seen, matches = 0.0, 0.0
    for begin in range(0, count, _BLOCK):
        size = min(_BLOCK, count - begin)
        for quantity in range(7):
            work[quantity * _STRIDE : quantity * _STRIDE + size] = points[quantity, begin : begin + size]
        _correspond(size, planes, motion, np.float32(scale_m), is_robust, work)
        _weigh(size, np.float32(scale_m), is_robust, work)
        for p in range(7):
            for q in range(p, 7):
                one, by_time, by_time_twice = _products(size, _ROW + p * _STRIDE, _ROW + q * _STRIDE, _POINT_T, work)
                last = q == 6
                total[p if p < 6 else 12, 12 if last else q] += one
                if p < 6:
                    total[p + 6, 12 if last else q + 6] += by_time if last else by_time_twice
                    if not last:
                        total[p, q + 6] += by_time
        counts = _products(size, _IN_VIEW, _IN_VIEW, _INLIER, work)
        seen, matches = seen + counts[0], matches + counts[1]
        if not is_robust:
            for p in range(3):
                for q in range(p, 3):
                    sums = _products(size, _TURNED_U + p * _STRIDE, _TURNED_U + q * _STRIDE, _INLIER, work)
                    in_view[p, q] += sums[0]
                    inlier[p, q] += sums[1]
    _mirror(total, in_view, inlier)
    return int(seen), int(matches)


@compiled_part
def _correspond(size: int, planes: Planes, motion: Motion, scale_m: np.float32, is_robust: bool, work: Floats) -> None:
    """Find the correspondences of a block of points.

    The time of a pixel is found by projecting without motion within the previous sweep, which is exact but at its seam.
    """
    _move(size, motion.T.astype(np.float32), motion.late.astype(np.float32), work)
    _project(size, planes, work)
    if planes.rolling:
        _look_up(size, planes.pixels, work)
        _take_back(size, motion.early.astype(np.float32), work)
        _project(size, planes, work)
    for k in range(size):
        work[_POINT_T + k] += work[_T + k]
    _look_up(size, planes.pixels, work)
    _judge(size, scale_m, is_robust, work)


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
    """Take points and normals to the frame of the previous sweep; their pixels' seconds are not known yet."""
    for k in range(size):
        x, y, z = _compensate(work[_POINT_X + k], work[_POINT_Y + k], work[_POINT_Z + k], work[_POINT_T + k], late)
        work[_X + k] = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        work[_Y + k] = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        work[_Z + k] = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        work[_T + k] = _ZERO
    for k in range(size):
        u, v, w = work[_POINT_U + k], work[_POINT_V + k], work[_POINT_W + k]
        work[_TURNED_U + k] = T[0, 0] * u + T[0, 1] * v + T[0, 2] * w
        work[_TURNED_V + k] = T[1, 0] * u + T[1, 1] * v + T[1, 2] * w
        work[_TURNED_W + k] = T[2, 0] * u + T[2, 1] * v + T[2, 2] * w


@compiled_part
def _take_back(size: int, early: Floats, work: Floats) -> None:
    """Take points from the middle of the previous sweep to the time of their pixels."""
    for k in range(size):
        x, y, z = _compensate(work[_X + k], work[_Y + k], work[_Z + k], -work[_T + k], early)
        work[_X + k], work[_Y + k], work[_Z + k] = x, y, z


@compiled_part
def _project(size: int, planes: Planes, work: Floats) -> None:
    """Write the pixels of a block of points, and whether they are in view."""
    height, width, low = np.float32(planes.height), np.float32(planes.width), np.float32(planes.low)
    per_radian = np.float32((planes.height - 1) / (planes.high - planes.low))
    columns_per_radian = width / _TURN
    for k in range(size):
        x, y = work[_X + k], work[_Y + k]
        elevation = arc_tangent(work[_Z + k], np.sqrt(x * x + y * y))
        row = np.floor((elevation - low) * per_radian + _HALF)
        work[_IN_VIEW + k] = _ONE if row >= _ZERO and row < height else _ZERO
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
        work[_U + k], work[_V + k], work[_W + k], work[_T + k] = pixel[3], pixel[4], pixel[5], pixel[6]


@compiled_part
def _judge(size: int, scale_m: np.float32, is_robust: bool, work: Floats) -> None:
    """Write the residuals, and which points are inliers: in view, near enough to their pixel, and turned like it.

    The gate is the width of a pixel on the surface: farther points are of another surface, seen past an edge. On ground
    at grazing incidence pixels are metres wide; a narrower gate would keep points on their own rings, which move with
    the sensor, and bias the motion.
    """
    most_m = np.float32(np.inf) if is_robust else _TWO * scale_m
    for k in range(size):
        x, y, z, u, v, w = work[_X + k], work[_Y + k], work[_Z + k], work[_U + k], work[_V + k], work[_W + k]
        dx, dy, dz = x - work[_AT_X + k], y - work[_AT_Y + k], z - work[_AT_Z + k]
        squared = x * x + y * y + z * z
        across, least = abs(x * u + y * v + z * w), _MOST_GRAZING * np.sqrt(squared)
        across = across if across > least else least
        across = across if across > _TINY else _TINY
        gate = _GATE_M + _GATE_PER_M * squared / across + scale_m
        cosine = work[_TURNED_U + k] * u + work[_TURNED_V + k] * v + work[_TURNED_W + k] * w
        residual = dx * u + dy * v + dz * w
        near = dx * dx + dy * dy + dz * dz < gate * gate and abs(residual) < most_m
        seen = work[_IN_VIEW + k] > _ZERO
        work[_INLIER + k] = _ONE if seen and near and cosine > _LEAST_COSINE else _ZERO
        work[_RESIDUAL + k] = residual


@compiled_part
def _weigh(size: int, scale_m: np.float32, is_robust: bool, work: Floats) -> None:
    """Write Jacobians and residuals times the roots of their weights, zero of outliers; and normals of what is seen."""
    each = _ONE / scale_m if is_robust else _ZERO
    for k in range(size):
        x, y, z, u, v, w = work[_X + k], work[_Y + k], work[_Z + k], work[_U + k], work[_V + k], work[_W + k]
        residual, keep = work[_RESIDUAL + k], work[_INLIER + k] > _ZERO
        share = residual * each
        root = _ONE / (_ONE + share * share)
        # Not times zero: what is no number would stay none.
        work[_ROW + k] = root * (y * w - z * v) if keep else _ZERO
        work[_ROW + _STRIDE + k] = root * (z * u - x * w) if keep else _ZERO
        work[_ROW + 2 * _STRIDE + k] = root * (x * v - y * u) if keep else _ZERO
        work[_ROW + 3 * _STRIDE + k] = root * u if keep else _ZERO
        work[_ROW + 4 * _STRIDE + k] = root * v if keep else _ZERO
        work[_ROW + 5 * _STRIDE + k] = root * w if keep else _ZERO
        work[_WEIGHTED + k] = root * residual if keep else _ZERO
    for k in range(size):
        seen = work[_IN_VIEW + k] > _ZERO
        work[_TURNED_U + k] = work[_TURNED_U + k] if seen else _ZERO
        work[_TURNED_V + k] = work[_TURNED_V + k] if seen else _ZERO
        work[_TURNED_W + k] = work[_TURNED_W + k] if seen else _ZERO


@compiled_sums
def _products(size: int, first: int, second: int, by: int, work: Floats) -> tuple[float, float, float]:
    """The sum of the products of two quantities of a block, the same times a third, and times its square.

    In double precision, so that rounding leaves no information along directions that have none.
    """
    a, b, times = work[first : first + size], work[second : second + size], work[by : by + size]
    one, two, three = 0.0, 0.0, 0.0
    for k in range(size):
        product, time = np.float64(a[k]) * np.float64(b[k]), np.float64(times[k])
        one += product
        two += product * time
        three += product * time * time
    return one, two, three


@compiled_part
def _mirror(total: FloatArray, in_view: FloatArray, inlier: FloatArray) -> None:
    """Complete the sums from what is above the diagonals of their blocks."""
    for p in range(6):
        for q in range(p):
            total[p, q + 6] = total[q, p + 6]
    for p in range(13):
        for q in range(p):
            total[p, q] = total[q, p]
    for p in range(3):
        for q in range(p):
            in_view[p, q], inlier[p, q] = in_view[q, p], inlier[q, p]
