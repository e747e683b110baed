"""Projective correspondences of two sweeps, their point-to-plane residuals and normal equations, in compiled loops.

Each point of the current sweep corresponds to the pixel of the previous one that it is projected into. The pixels are
as measured, each at its own time: points are taken to that time, projected, and compared there.

Points are worked on in blocks, which are vectorised, eight numbers of single precision at a time: each quantity of a
block lies in a part of one array, so that the compiler sees that no two overlap.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarslam.core.compiled import compiled, compiled_part, compiled_sums
from lidarslam.core.geometry import FloatArray
from lidarslam.odometry.alignment.sweep_motion import SweepPair
from lidarslam.odometry.images.projection import Floats, arc_tangent

# Points that are worked on together.
_BLOCK = 256
# From one quantity of a block to the next. Were it a power of two, loads would wait for stores to other quantities.
_STRIDE = _BLOCK + 32
# Where the quantities of a block begin. Of the points: coordinates, normals and seconds from the middle of the sweep.
_POINT_X, _POINT_Y, _POINT_Z, _POINT_U, _POINT_V, _POINT_W, _POINT_T = (n * _STRIDE for n in range(7))
# Coordinates in the frame of the previous sweep at the time of the pixel, normals in that of its middle.
X, Y, Z, _TURNED_U, _TURNED_V, _TURNED_W = (n * _STRIDE for n in range(7, 13))
# The index of the pixel, and its point, normal and seconds.
_PIXEL, _AT_X, _AT_Y, _AT_Z, U, V, W, _T = (n * _STRIDE for n in range(13, 21))
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
# Twice as many rows add hardly any information if half as many points are taken of each.
_FULL_ROWS = 32
# Reach along its row within which a pixel without a normal takes one. A point is compared with a plane, which extends
# beyond its pixel; the gate limits the distance.
_FILL_COLUMNS = 4
# Scale of the residuals of inliers.
FINE_M = 0.05


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


class PairMotion(NamedTuple):
    """T_prev_curr (4, 4), and the velocities (6,) in the middles of the previous and of the current sweep."""

    T: FloatArray
    early: FloatArray
    late: FloatArray


@compiled_part
def _correspond(
    size: int, planes: Planes, motion: PairMotion, scale_m: np.float32, is_robust: bool, work: Floats
) -> None:
    """Find the correspondences of a block of points.

    The time of a pixel is found by projecting without motion within the previous sweep, which is exact but at its seam.
    """
    _move(size, motion.T.reshape(16).astype(np.float32), motion.late.astype(np.float32), work)
    for taken_back in range(2 if planes.rolling else 1):
        if taken_back:
            _take_back(size, motion.early.astype(np.float32), work)
        _project(size, planes, work)
        for k in range(size):
            pixel = planes.pixels[int(work[_PIXEL + k])]
            work[_AT_X + k], work[_AT_Y + k], work[_AT_Z + k] = pixel[0], pixel[1], pixel[2]
            work[U + k], work[V + k], work[W + k], work[_T + k] = pixel[3], pixel[4], pixel[5], pixel[6]
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
    """Take points and normals to the frame of the previous sweep by T_prev_curr, row by row (16,)."""
    for k in range(size):
        x, y, z = _compensate(work[_POINT_X + k], work[_POINT_Y + k], work[_POINT_Z + k], work[_POINT_T + k], late)
        work[X + k] = T[0] * x + T[1] * y + T[2] * z + T[3]
        work[Y + k] = T[4] * x + T[5] * y + T[6] * z + T[7]
        work[Z + k] = T[8] * x + T[9] * y + T[10] * z + T[11]
    for k in range(size):
        u, v, w = work[_POINT_U + k], work[_POINT_V + k], work[_POINT_W + k]
        work[_TURNED_U + k] = T[0] * u + T[1] * v + T[2] * w
        work[_TURNED_V + k] = T[4] * u + T[5] * v + T[6] * w
        work[_TURNED_W + k] = T[8] * u + T[9] * v + T[10] * w


@compiled_part
def _take_back(size: int, early: Floats, work: Floats) -> None:
    """Take points from the middle of the previous sweep to the time of their pixels, which their own seconds get."""
    for k in range(size):
        work[_POINT_T + k] += work[_T + k]
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
        work[_IN_VIEW + k] = _ONE if row >= _ZERO and row < height else _ZERO
        row = row if row > _ZERO else _ZERO  # NaN lies in the first row
        row = row if row < height else height - _ONE
        azimuth = arc_tangent(y, x)
        column = np.floor((azimuth + (_TURN if azimuth < _ZERO else _ZERO)) * columns_per_radian)
        column = column if column < width - _ONE else width - _ONE  # NaN lies in the last column
        work[_PIXEL + k] = row * width + column


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
        cosine = work[_TURNED_U + k] * u + work[_TURNED_V + k] * v + work[_TURNED_W + k] * w
        residual = dx * u + dy * v + dz * w
        near = dx * dx + dy * dy + dz * dz < gate * gate and abs(residual) < most_m
        seen = work[_IN_VIEW + k] > _ZERO
        work[_INLIER + k] = _ONE if seen and near and cosine > _LEAST_COSINE else _ZERO
        work[_RESIDUAL + k] = residual


@compiled
def _sum_up(
    points: Floats, count: int, planes: Planes, motion: PairMotion, scale_m: float, is_robust: bool, total: FloatArray,
    in_view: FloatArray, inlier: FloatArray,
) -> tuple[int, int]:  # fmt: skip
    """Sums over the correspondences of the first `count` points (7, N).

    A point seen t seconds after the middle of its sweep, on a pixel seen t' after that of its own, moves with the
    change of velocity (t + t') times as it does with the motion.

    Args:
        scale_m: of the residuals.
        is_robust: all inliers, with Geman and McClure's weights; else those within twice the scale, unweighted.
        total: (13, 13), zero, written: H (12, 12) and, in the last column, g (12,) and the sum of squared residuals.
        in_view, inlier: (3, 3), zero, written unless robust: sums of squared normals in the previous frame, of points
            in view and of inliers.

    Returns:
        Number of points in view, and of inliers.
    """
    work = np.zeros(_SIZE, dtype=np.float32)
    seen, matches = 0, 0
    for begin in range(0, count, _BLOCK):
        size = min(_BLOCK, count - begin)
        for quantity in range(7):
            row = points[quantity]
            for k in range(size):
                work[quantity * _STRIDE + k] = row[begin + k]
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
        for k in range(size):
            seen += 1 if work[_IN_VIEW + k] > _ZERO else 0
            matches += 1 if work[_INLIER + k] > _ZERO else 0
        if not is_robust:
            for p in range(3):
                for q in range(p, 3):
                    sums = _products(size, _TURNED_U + p * _STRIDE, _TURNED_U + q * _STRIDE, _INLIER, work)
                    in_view[p, q] += sums[0]
                    inlier[p, q] += sums[1]
    _mirror(total, in_view, inlier)
    return seen, matches


@compiled_part
def _weigh(size: int, scale_m: np.float32, is_robust: bool, work: Floats) -> None:
    """Write Jacobians and residuals times the roots of their weights, zero for outliers; and normals of points seen."""
    each = _ONE / scale_m if is_robust else _ZERO
    for k in range(size):
        x, y, z, u, v, w = work[X + k], work[Y + k], work[Z + k], work[U + k], work[V + k], work[W + k]
        residual, keep = work[_RESIDUAL + k], work[_INLIER + k] > _ZERO
        share = residual * each
        root = _ONE / (_ONE + share * share)
        # Not times zero: NaN would stay NaN.
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
    for p in range(6):
        for q in range(p):
            total[p, q + 6] = total[q, p + 6]
    for p in range(13):
        for q in range(p):
            total[p, q] = total[q, p]
    for p in range(3):
        for q in range(p):
            in_view[p, q], inlier[p, q] = in_view[q, p], inlier[q, p]


@dataclass(frozen=True, eq=False)
class InlierSums:
    """Sums over the inliers of a motion, which have residuals within twice the finest scale."""

    H: FloatArray  # (12, 12) of the normal equations, each inlier with a weight of 1
    # in_view, inlier: (3, 3) of the squares of normals in the previous frame: of all points in view, and of inliers
    in_view: FloatArray
    inlier: FloatArray
    share_in_view: float  # of the points with a normal
    inliers: int  # their number


class PointToPlane:
    """The points of every `column_step`-th column of the current sweep against the planes of the previous one."""

    def __init__(self, sweeps: SweepPair, column_step: int) -> None:
        current, previous = sweeps.current, sweeps.previous
        height, width = current.offsets.shape
        fewer = max(1, height // _FULL_ROWS)  # of more rows fewer points each
        self._points = np.empty((7, height * (width // (fewer * column_step) + 1)), dtype=np.float32)
        self._count = _sample(current.points, current.normals, current.offsets, column_step, fewer, self._points)
        height, width = previous.offsets.shape
        pixels = np.empty((height * width, 7), dtype=np.float32)
        _fill(previous.points, previous.normals, previous.offsets, min(_FILL_COLUMNS, width - 1), pixels)
        self._planes = Planes(pixels, height, width, previous.low, previous.high, bool(previous.offsets.any()))

    def normal_equations(self, motion: PairMotion, scale_m: float) -> tuple[FloatArray, FloatArray]:
        """H (12, 12) and g (12,) of squared residuals with Geman and McClure's weights of this scale.

        The unknowns are a change of T_prev_curr from the left, rotation first, and the change (6,) of velocity.
        """
        total, unused = np.zeros((13, 13)), np.zeros((3, 3))
        _sum_up(self._points, self._count, self._planes, motion, scale_m, True, total, unused, unused)
        return total[:12, :12].copy(), total[:12, 12].copy()

    def fit(self, motion: PairMotion) -> InlierSums:
        """The inliers of a motion."""
        total, in_view, inlier = np.zeros((13, 13)), np.zeros((3, 3)), np.zeros((3, 3))
        seen, count = _sum_up(self._points, self._count, self._planes, motion, FINE_M, False, total, in_view, inlier)
        return InlierSums(total[:12, :12], in_view, inlier, seen / max(self._count, 1), count)


@compiled
def _sample(points: Floats, normals: Floats, offsets: Floats, step: int, fewer: int, chosen: Floats) -> int:
    """Write (7, N) point, normal and seconds of one of `step * fewer` pixels of each row, if it has a normal; N.

    Row i begins at column `i % fewer * step`.
    """
    height, width = offsets.shape
    count = 0
    for i in range(height):
        for j in range(i % fewer * step, width, step * fewer):
            u, v, w = normals[0, i, j], normals[1, i, j], normals[2, i, j]
            if u * u + v * v + w * w > 0.5:
                for axis in range(3):
                    chosen[axis, count], chosen[3 + axis, count] = points[axis, i, j], normals[axis, i, j]
                chosen[6, count] = offsets[i, j]
                count += 1
    return count


@compiled
def _fill(points: Floats, normals: Floats, offsets: Floats, columns: int, pixels: Floats) -> None:
    """Write the pixels (H * W, 7) of images (3, H, W), (3, H, W), (H, W).

    Those without a normal get the nearest one in their row, up to `columns` columns away.
    """
    height, width = offsets.shape
    there = np.empty(width, dtype=np.bool_)
    for i in range(height):
        # Row by row: an index into all of an image is slower.
        x, y, z, u, v, w = points[0, i], points[1, i], points[2, i], normals[0, i], normals[1, i], normals[2, i]
        seconds = offsets[i]
        for j in range(width):
            there[j] = u[j] * u[j] + v[j] * v[j] + w[j] * w[j] > 0.5
        for j in range(width):
            source = j
            if not there[j]:
                for distance in range(1, columns + 1):
                    left, right = (j - distance) % width, (j + distance) % width
                    if there[left] or there[right]:
                        source = left if there[left] else right
                        break
            pixel = pixels[i * width + j]
            pixel[0], pixel[1], pixel[2], pixel[3] = x[source], y[source], z[source], u[source]
            pixel[4], pixel[5], pixel[6] = v[source], w[source], seconds[source]
