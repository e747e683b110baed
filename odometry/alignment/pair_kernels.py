"""Compiled loops over correspondences of alignment; `odometry.alignment.pair_sums` documents the sums."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from odometry.images.image_kernels import column_of, row_of, write_angles

Floats = NDArray[np.float32]

# Points that are worked on together, so that the processor takes several at once.
BLOCK = 256
# Sine of the angle between beam and surface below which pixels are not taken as any wider.
_MOST_GRAZING = 0.2


class Sweep(NamedTuple):
    """Points that are held against an image.

    Attributes:
        points: (N, 7) point, normal and seconds from the middle of the sweep.
    """

    points: Floats


class Planes(NamedTuple):
    """An image that points are held against.

    Attributes:
        pixels: (H * W, 7) point, normal and seconds from the middle of the sweep, of each pixel.
        height, width: H and W.
        low, high: elevation of the centres of the first and the last row, radians.
        rolling: whether any of the seconds is not zero.
    """

    pixels: Floats
    height: int
    width: int
    low: float
    high: float
    rolling: bool


class Gates(NamedTuple):
    """What a point may differ by from the pixel it is held against; see `AlignmentConfig`."""

    gate_m: float
    gate_share: float
    least_cosine: float


class Motion(NamedTuple):
    """T_prev_curr (4, 4), and the velocities (6,) in the middles of the previous and of the current sweep."""

    T: FloatArray
    early: FloatArray
    late: FloatArray


class Held(NamedTuple):
    """A block of points held against planes, each (256,).

    Attributes:
        x, y, z: points in the frame of the previous sweep at the time of their pixel.
        u, v, w: normals of the planes.
        residuals: distances from the planes, metres.
        offsets_s: of both times from the middles of their sweeps together: what a bend shifts them by.
        inside: in view of the previous sweep.
        kept: near enough to their pixel, and turned like it.
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    u: FloatArray
    v: FloatArray
    w: FloatArray
    residuals: FloatArray
    offsets_s: FloatArray
    inside: NDArray[np.bool_]
    kept: NDArray[np.bool_]


@compiled
def sample(points: Floats, normals: Floats, offsets: Floats, step: int, fewer: int, chosen: Floats) -> int:
    """Write one of `step * fewer` pixels of each row, if it has a normal, (N, 7) as of `Sweep`, and tell how many.

    So many rows in turn begin a step later.
    """
    height, width = offsets.shape
    count = 0
    for i in range(height):
        for j in range(i % fewer * step, width, step * fewer):
            u, v, w = normals[0, i, j], normals[1, i, j], normals[2, i, j]
            if u * u + v * v + w * w > 0.5:
                point = chosen[count]
                point[0], point[1], point[2] = points[0, i, j], points[1, i, j], points[2, i, j]
                point[3], point[4], point[5], point[6] = u, v, w, offsets[i, j]
                count += 1
    return count


@compiled
def fill(points: Floats, normals: Floats, offsets: Floats, columns: int, pixels: Floats) -> None:
    """Write the pixels (H * W, 7) of images (3, H, W), (3, H, W), (H, W).

    Those without a normal stand for the nearest in their row that has one, up to so many columns away.
    """
    height, width = offsets.shape
    there = np.empty(width, dtype=np.bool_)
    for i in range(height):
        for j in range(width):
            u, v, w = normals[0, i, j], normals[1, i, j], normals[2, i, j]
            there[j] = u * u + v * v + w * w > 0.5
        for j in range(width):
            source = j
            if not there[j]:
                for distance in range(1, columns + 1):
                    left, right = j - distance, j + distance
                    left = left + width if left < 0 else left
                    right = right - width if right >= width else right
                    if there[left] or there[right]:
                        source = left if there[left] else right
                        break
            pixel = pixels[i * width + j]
            for axis in range(3):
                pixel[axis], pixel[3 + axis] = points[axis, i, source], normals[axis, i, source]
            pixel[6] = offsets[i, source]


@compiled
def _compensate(x: float, y: float, z: float, t: float, velocity: FloatArray) -> tuple[float, float, float]:
    """A point as seen from the middle of the sweep, t seconds before it was measured, for a body that moves
    evenly: the exponential map to second order.
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


@compiled
def _place(
    held: Held,
    size: int,
    planes: Planes,
    angles: tuple[Floats, Floats, Floats, Floats, Floats],
    pixels: NDArray[np.int64],
) -> None:
    """Write the pixels of a block of points, and whether they are inside; `angles` (5, 256) are room."""
    x, y, z, elevations, azimuths = angles
    per_radian = (planes.height - 1) / (planes.high - planes.low)
    for i in range(size):
        x[i], y[i], z[i] = held.x[i], held.y[i], held.z[i]
    write_angles(x[:size], y[:size], z[:size], elevations, azimuths)
    for i in range(size):
        row = row_of(elevations[i], planes.low, per_radian)
        held.inside[i] = row >= 0.0 and row < planes.height
        row = row if row > 0.0 else 0.0  # NaN lies in the first row
        row = row if row < planes.height else planes.height - 1.0
        pixels[i] = int(row) * planes.width + int(column_of(azimuths[i], planes.width))


@compiled
def _hold(
    begin: int, size: int, sweep: Sweep, planes: Planes, motion: Motion, scale_m: float, gates: Gates, held: Held
) -> None:
    """Hold a block of points against the planes of the pixels that they fall into.

    The time is that of the pixel they would fall into if nothing moved within the previous sweep, which is right but
    for its seam. What lies farther along the surface than pixels are wide is another surface seen past an edge. On
    ground that the beams graze, pixels are metres wide; were they not, rings, which go along with the sensor, would
    hold it back.
    """
    T, pixels, angles = motion.T, np.empty(BLOCK, dtype=np.int64), _angles()
    for i in range(size):
        n = begin + i
        a, b, c, t = sweep.points[n, 0], sweep.points[n, 1], sweep.points[n, 2], np.float64(sweep.points[n, 6])
        x, y, z = _compensate(np.float64(a), np.float64(b), np.float64(c), t, motion.late)
        held.x[i] = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        held.y[i] = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        held.z[i] = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        held.offsets_s[i] = t
    _place(held, size, planes, angles, pixels)
    if planes.rolling:
        for i in range(size):
            t = np.float64(planes.pixels[pixels[i], 6])
            held.offsets_s[i] += t
            held.x[i], held.y[i], held.z[i] = _compensate(held.x[i], held.y[i], held.z[i], -t, motion.early)
        _place(held, size, planes, angles, pixels)
    for i in range(size):
        n, p = begin + i, planes.pixels[pixels[i]]
        x, y, z = held.x[i], held.y[i], held.z[i]
        u, v, w = np.float64(p[3]), np.float64(p[4]), np.float64(p[5])
        dx, dy, dz = x - p[0], y - p[1], z - p[2]
        squared = x * x + y * y + z * z
        across = max(abs(x * u + y * v + z * w), _MOST_GRAZING * math.sqrt(squared))
        gate = gates.gate_m + gates.gate_share * squared / max(across, 1e-6) + scale_m
        a, b, c = sweep.points[n, 3], sweep.points[n, 4], sweep.points[n, 5]
        cosine = (
            (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c) * u
            + (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c) * v
            + (T[2, 0] * a + T[2, 1] * b + T[2, 2] * c) * w
        )
        near = dx * dx + dy * dy + dz * dz < gate * gate
        held.kept[i] = held.inside[i] and near and cosine > gates.least_cosine
        held.u[i], held.v[i], held.w[i] = u, v, w
        held.residuals[i] = dx * u + dy * v + dz * w


@compiled
def _angles() -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Room for points and their angles."""
    x, y, z = np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.float32)
    return x, y, z, np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.float32)


@compiled
def _room() -> Held:
    # Arrays of their own: of views of one, the compiler cannot tell that they do not overlap.
    x, y, z, residuals = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    u, v, w, offsets_s = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    inside, kept = np.empty(BLOCK, dtype=np.bool_), np.empty(BLOCK, dtype=np.bool_)
    return Held(x, y, z, u, v, w, residuals, offsets_s, inside, kept)


@compiled
def normal_equations(
    sweep: Sweep, planes: Planes, motion: Motion, scale_m: float, gates: Gates, H: FloatArray, g: FloatArray
) -> None:
    """Write H (12, 12) and g (12,) of the squares of residuals, with Geman and McClure's weights of this scale."""
    total, rows, held = np.zeros((13, 13)), np.empty((BLOCK, 13)), _room()
    for begin in range(0, len(sweep.points), BLOCK):
        size, count = min(BLOCK, len(sweep.points) - begin), 0
        _hold(begin, size, sweep, planes, motion, scale_m, gates, held)
        for i in range(size):
            if held.kept[i]:
                _write_row(i, held, 1.0 / (1.0 + (held.residuals[i] / scale_m) ** 2), rows[count])
                count += 1
        total += np.dot(rows[:count].T, rows[:count])
    H[:], g[:] = total[:12, :12], total[:12, 12]


@compiled
def judge(
    sweep: Sweep, planes: Planes, motion: Motion, scale_m: float, gates: Gates, H: FloatArray, in_view: FloatArray,
    matched: FloatArray,
) -> tuple[int, int, float]:  # fmt: skip
    """Sums over the points in view, and over those that lie well, which is within twice the scale.

    Args:
        sweep, planes, motion, scale_m, gates: as for `normal_equations`.
        H: (12, 12), written: as of `normal_equations`, with weights of 1, of those that lie well.
        in_view, matched: (3, 3), written: of the squares of the normals in the previous frame.

    Returns:
        How many are in view, how many lie well, and the sum of the latter's squared residuals.
    """
    in_view[:], matched[:], total, rows, held = 0.0, 0.0, np.zeros((13, 13)), np.empty((BLOCK, 13)), _room()
    seen, matches, turned = 0, 0, np.empty(3)
    for begin in range(0, len(sweep.points), BLOCK):
        size, count = min(BLOCK, len(sweep.points) - begin), 0
        _hold(begin, size, sweep, planes, motion, scale_m, gates, held)
        for i in range(size):
            if not held.inside[i]:
                continue
            seen += 1
            a, b, c = sweep.points[begin + i, 3], sweep.points[begin + i, 4], sweep.points[begin + i, 5]
            for j in range(3):
                turned[j] = motion.T[j, 0] * a + motion.T[j, 1] * b + motion.T[j, 2] * c
            _add_square(turned, in_view)
            if held.kept[i] and abs(held.residuals[i]) < 2.0 * scale_m:
                _add_square(turned, matched)
                _write_row(i, held, 1.0, rows[count])
                count += 1
        matches += count
        total += np.dot(rows[:count].T, rows[:count])
    H[:] = total[:12, :12]
    return seen, matches, total[12, 12]


@compiled
def _add_square(vector: FloatArray, total: FloatArray) -> None:
    for i in range(3):
        for j in range(3):
            total[i, j] += vector[i] * vector[j]


@compiled
def _write_row(i: int, held: Held, root: float, row: FloatArray) -> None:
    """Write a point's Jacobian (12,) and residual, times the root of its weight.

    A point that is seen t seconds after the middle of its sweep, on a pixel seen t' after that of its own, moves with
    the bend (t + t') times as it does with the motion.
    """
    x, y, z, u, v, w = held.x[i], held.y[i], held.z[i], held.u[i], held.v[i], held.w[i]
    row[0], row[1], row[2] = root * (y * w - z * v), root * (z * u - x * w), root * (x * v - y * u)
    row[3], row[4], row[5] = root * u, root * v, root * w
    for j in range(6):
        row[6 + j] = held.offsets_s[i] * row[j]
    row[12] = root * held.residuals[i]
