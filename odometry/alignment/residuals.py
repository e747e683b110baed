"""Projective correspondences and point-to-plane residuals of two sweeps, in compiled loops.

Each point of the current sweep corresponds to the pixel of the previous one that it is projected into. The pixels are
as measured, each at its own time: points are taken to that time, projected, and compared there.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray
from lidarslam.odometry.images.projection import Floats, column_of, row_of, write_angles

# Points that are worked on together, so that the processor takes several at once.
_BLOCK = 256
# A point is an outlier farther from its pixel than this, metres: at the sensor, and for each metre of range where the
# beam meets the surface at a right angle; or where the cosine between the two normals is less.
_GATE_M, _GATE_PER_M, _LEAST_COSINE = 0.2, 0.04, 0.8
# Sine of the angle between beam and surface below which pixels are not taken as any wider.
_MOST_GRAZING = 0.2


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


class _Block(NamedTuple):
    """A block of points and their correspondences, each (256,)."""

    # x, y, z: points in the frame of the previous sweep at the time of their pixel
    x: FloatArray
    y: FloatArray
    z: FloatArray
    # u, v, w: normals of the planes
    u: FloatArray
    v: FloatArray
    w: FloatArray
    residuals: FloatArray  # distances from the planes, metres
    offsets_s: FloatArray  # seconds of point and pixel from the middles of their sweeps, added up
    pixels: NDArray[np.int64]  # flat indices
    in_view: NDArray[np.bool_]  # whether the point falls into the image
    inlier: NDArray[np.bool_]  # whether it is in view, near enough to its pixel, and turned like it


@compiled
def accumulate(
    points: Floats, planes: Planes, motion: Motion, scale_m: float, is_robust: bool, total: FloatArray,
    in_view: FloatArray, inlier: FloatArray,
) -> tuple[int, int]:  # fmt: skip
    """Sums over the correspondences of points (N, 7).

    Args:
        points, planes, motion: see above.
        scale_m: of the residuals.
        is_robust: all inliers, with Geman and McClure's weights; else those within twice the scale, unweighted.
        total: (13, 13), zero, written: H (12, 12) and, in the last column, g (12,) and the sum of squared residuals.
        in_view, inlier: (3, 3), zero, written unless robust: sums of squared normals in the previous frame, of points
            in view and of inliers.

    Returns:
        How many points are in view, and how many are inliers.
    """
    rows, block, turned = np.empty((_BLOCK, 13)), _room(), np.empty(3)
    seen, matches = 0, 0
    for begin in range(0, len(points), _BLOCK):
        size, count = min(_BLOCK, len(points) - begin), 0
        _correspond(points[begin : begin + size], planes, motion, scale_m, block)
        for i in range(size):
            if not block.in_view[i]:
                continue
            seen += 1
            residual = block.residuals[i]
            is_inlier = block.inlier[i] and (is_robust or abs(residual) < 2.0 * scale_m)
            if not is_robust:
                _rotate(motion.T, points[begin + i], turned)
                _add_square(turned, in_view)
                if is_inlier:
                    _add_square(turned, inlier)
            if is_inlier:
                root = 1.0 / (1.0 + (residual / scale_m) ** 2) if is_robust else 1.0
                _write_row(i, block, root, rows[count])
                count += 1
        matches += count
        total += np.dot(rows[:count].T, rows[:count])
    return seen, matches


@compiled_part
def _correspond(points: Floats, planes: Planes, motion: Motion, scale_m: float, block: _Block) -> None:
    """Find the correspondences of a block of points.

    The time of a pixel is found by projecting without motion within the previous sweep, which is exact but at its seam.
    The gate is the width of a pixel on the surface: farther points are of another surface, seen past an edge. On ground
    at grazing incidence pixels are metres wide; a narrower gate would keep points on their own rings, which move with
    the sensor, and bias the motion.
    """
    T, size = motion.T, len(points)
    for i in range(size):
        t = np.float64(points[i, 6])
        a, b, c = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        x, y, z = _compensate(a, b, c, t, motion.late)
        block.x[i] = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        block.y[i] = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        block.z[i] = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        block.offsets_s[i] = t
    _project(size, planes, block)
    if planes.rolling:
        for i in range(size):
            t = np.float64(planes.pixels[block.pixels[i], 6])
            block.offsets_s[i] += t
            block.x[i], block.y[i], block.z[i] = _compensate(block.x[i], block.y[i], block.z[i], -t, motion.early)
        _project(size, planes, block)
    turned = np.empty(3)
    for i in range(size):
        pixel = planes.pixels[block.pixels[i]]
        x, y, z = block.x[i], block.y[i], block.z[i]
        u, v, w = np.float64(pixel[3]), np.float64(pixel[4]), np.float64(pixel[5])
        dx, dy, dz = x - pixel[0], y - pixel[1], z - pixel[2]
        squared = x * x + y * y + z * z
        across = max(abs(x * u + y * v + z * w), _MOST_GRAZING * math.sqrt(squared))
        gate = _GATE_M + _GATE_PER_M * squared / max(across, 1e-6) + scale_m
        _rotate(T, points[i], turned)
        cosine = turned[0] * u + turned[1] * v + turned[2] * w
        near = dx * dx + dy * dy + dz * dz < gate * gate
        block.inlier[i] = block.in_view[i] and near and cosine > _LEAST_COSINE
        block.u[i], block.v[i], block.w[i] = u, v, w
        block.residuals[i] = dx * u + dy * v + dz * w


@compiled_part
def _compensate(x: float, y: float, z: float, t: float, velocity: FloatArray) -> tuple[float, float, float]:
    """A point measured t seconds after the middle of the sweep, in the frame of the middle, at an even velocity.

    The exponential map to second order.
    """
    a, b, c = velocity[0], velocity[1], velocity[2]
    u = b * z - c * y + velocity[3]
    v = c * x - a * z + velocity[4]
    w = a * y - b * x + velocity[5]
    half = 0.5 * t
    return (
        x + t * (u + half * (b * w - c * v)),
        y + t * (v + half * (c * u - a * w)),
        z + t * (w + half * (a * v - b * u)),
    )


@compiled_part
def _project(size: int, planes: Planes, block: _Block) -> None:
    """Write the pixels of a block of points, and whether they are in view."""
    x, y, z = np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32)
    elevations, azimuths = np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32)
    per_radian = (planes.height - 1) / (planes.high - planes.low)
    for i in range(size):
        x[i], y[i], z[i] = block.x[i], block.y[i], block.z[i]
    write_angles(x, y, z, elevations, azimuths)
    for i in range(size):
        row = row_of(elevations[i], planes.low, per_radian)
        block.in_view[i] = row >= 0.0 and row < planes.height
        row = row if row > 0.0 else 0.0  # NaN lies in the first row
        row = row if row < planes.height else planes.height - 1.0
        block.pixels[i] = int(row) * planes.width + int(column_of(azimuths[i], planes.width))


@compiled_part
def _write_row(i: int, block: _Block, root: float, row: FloatArray) -> None:
    """Write a point's Jacobian (12,) and residual, times the root of its weight.

    A point seen t seconds after the middle of its sweep, on a pixel seen t' after that of its own, moves with the
    change of velocity (t + t') times as it does with the motion.
    """
    x, y, z, u, v, w = block.x[i], block.y[i], block.z[i], block.u[i], block.v[i], block.w[i]
    row[0], row[1], row[2] = root * (y * w - z * v), root * (z * u - x * w), root * (x * v - y * u)
    row[3], row[4], row[5] = root * u, root * v, root * w
    for j in range(6):
        row[6 + j] = block.offsets_s[i] * row[j]
    row[12] = root * block.residuals[i]


@compiled_part
def _rotate(T: FloatArray, point: Floats, turned: FloatArray) -> None:
    """Write the normal (3,) of a point (7,) in the previous frame."""
    for j in range(3):
        turned[j] = T[j, 0] * point[3] + T[j, 1] * point[4] + T[j, 2] * point[5]


@compiled_part
def _add_square(vector: FloatArray, total: FloatArray) -> None:
    for i in range(3):
        for j in range(3):
            total[i, j] += vector[i] * vector[j]


@compiled_part
def _room() -> _Block:
    # Arrays of their own: views of one might overlap, and the compiler would not vectorise.
    x, y, z, residuals = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    u, v, w, offsets_s = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    in_view, inlier = np.empty(_BLOCK, dtype=np.bool_), np.empty(_BLOCK, dtype=np.bool_)
    return _Block(x, y, z, u, v, w, residuals, offsets_s, np.empty(_BLOCK, dtype=np.int64), in_view, inlier)
