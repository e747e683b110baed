"""The loops over points and pixels behind projection and alignment on a processor, compiled.

What they compute is said where torch does it for batches and other devices: `odometry.projection`, `odometry.pairing`
and `odometry.alignment`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray

Floats = NDArray[np.float32]

_TURN = 2.0 * math.pi
_TINY = 1e-30
# Points that are taken through angles together, so that the processor takes several at once.
_BLOCK = 256
# Sine of the angle between beam and surface below which pixels are not taken as any wider.
_MOST_GRAZING = 0.2


class Planes(NamedTuple):
    """An image that points are held against.

    Attributes:
        pixels: (H * W, 7) point, normal and seconds from the middle of the sweep, of each pixel.
        height, width: H and W.
        low, high: elevation of the centres of the first and the last row, radians.
    """

    pixels: Floats
    height: int
    width: int
    low: float
    high: float


class Gates(NamedTuple):
    """What a point may differ by from the pixel it is held against; see `AlignmentConfig`."""

    gate_m: float
    gate_share: float
    least_cosine: float


class Held(NamedTuple):
    """A point held against a plane: see `odometry.pairing.Pairs`."""

    inside: bool
    kept: bool
    x: float
    y: float
    z: float
    u: float
    v: float
    w: float
    residual: float
    offset_s: float


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
def _row(elevation: float, low: float, rows_per_radian: float) -> float:
    """A whole number, which may lie outside of the image."""
    return float(np.floor((elevation - low) * rows_per_radian + 0.5))


@compiled
def _column(azimuth: float, width: int) -> float:
    """A whole number."""
    azimuth = azimuth + _TURN if azimuth < 0.0 else azimuth
    column = np.floor(azimuth * (width / _TURN))
    return column if column < width - 1.0 else width - 1.0  # NaN lies in the last column


@compiled
def _angles(points: Floats, begin: int, elevations: FloatArray, azimuths: FloatArray, ranges: Floats) -> None:
    """Write what is seen of the points (M, 3) from `begin` on: separate loops, each of which takes several at once."""
    size = len(ranges)
    x, y, z = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    for i in range(size):
        x[i], y[i], z[i] = points[begin + i, 0], points[begin + i, 1], points[begin + i, 2]
    for i in range(size):
        elevations[i] = _arc_tangent(z[i], math.sqrt(x[i] * x[i] + y[i] * y[i]))
    for i in range(size):
        azimuths[i] = _arc_tangent(y[i], x[i])
    for i in range(size):
        a, b, c = np.float32(x[i]), np.float32(y[i]), np.float32(z[i])
        ranges[i] = np.sqrt(a * a + b * b + c * c)


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
    elevations, azimuths = np.empty(_BLOCK), np.empty(_BLOCK)
    distances = np.empty(_BLOCK, dtype=np.float32)
    for begin in range(0, len(points), _BLOCK):
        size = min(_BLOCK, len(points) - begin)
        _angles(points, begin, elevations, azimuths, distances[:size])
        for i in range(size):
            elevations[i] = _row(elevations[i], low, rows_per_radian)
            azimuths[i] = _column(azimuths[i], width)
        for i in range(size):
            row, distance = elevations[i] if len(rows) == 0 else float(rows[begin + i]), distances[i]
            if not (row >= 0.0 and row < height and distance > 0.0 and distance < np.inf):
                continue
            pixel = int(row) * width + int(azimuths[i])
            if distance < ranges[pixel]:
                index[pixel], ranges[pixel] = begin + i, distance


@compiled
def fill(points: Floats, normals: Floats, offsets: Floats, columns: int, pixels: Floats) -> None:
    """Write the pixels (H * W, 7) of images (3, H, W), (3, H, W), (H, W); see `odometry.pairing.filled`."""
    height, width = offsets.shape
    for i in range(height):
        for j in range(width):
            source = j
            for step in range(2 * columns + 1):
                distance = (step + 1) // 2 * (1 if step % 2 == 1 else -1)  # 0, 1 to the left, 1 to the right, 2 ...
                c = (j - distance) % width
                u, v, w = normals[0, i, c], normals[1, i, c], normals[2, i, c]
                if u * u + v * v + w * w > 0.5:
                    source = c
                    break
            pixel = pixels[i * width + j]
            for axis in range(3):
                pixel[axis], pixel[3 + axis] = points[axis, i, source], normals[axis, i, source]
            pixel[6] = offsets[i, source]


@compiled
def _compensate(x: float, y: float, z: float, t: float, velocity: FloatArray) -> tuple[float, float, float]:
    """A point as seen from the middle of the sweep, t seconds before it was measured; see `odometry.sweeps`."""
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
def _pixel(x: float, y: float, z: float, planes: Planes) -> tuple[int, bool]:
    per_radian = (planes.height - 1) / (planes.high - planes.low)
    row = _row(_arc_tangent(z, math.sqrt(x * x + y * y)), planes.low, per_radian)
    inside = row >= 0.0 and row < planes.height
    row = row if row > 0.0 else 0.0  # and in the first row
    row = row if row < planes.height else planes.height - 1.0
    return int(row) * planes.width + int(_column(_arc_tangent(y, x), planes.width)), inside


@compiled
def _hold(
    n: int, points: Floats, normals: Floats, offsets: Floats, planes: Planes, T: FloatArray, early: FloatArray,
    late: FloatArray, scale_m: float, gates: Gates,
) -> Held:  # fmt: skip
    """Hold one point against the plane of the pixel that it falls into; see `odometry.pairing.pair`.

    `early` and `late` are the velocities (6,) in the middle of the previous and of the current sweep.
    """
    x, y, z = _compensate(
        np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2]), np.float64(offsets[n]), late
    )
    mx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    my = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    mz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    pixel, inside = _pixel(mx, my, mz, planes)
    t = np.float64(planes.pixels[pixel, 6])
    x, y, z = _compensate(mx, my, mz, -t, early)
    pixel, inside = _pixel(x, y, z, planes)
    p = planes.pixels[pixel]
    u, v, w = np.float64(p[3]), np.float64(p[4]), np.float64(p[5])
    dx, dy, dz = x - p[0], y - p[1], z - p[2]
    squared = x * x + y * y + z * z
    across = max(abs(x * u + y * v + z * w), _MOST_GRAZING * math.sqrt(squared))
    gate = gates.gate_m + gates.gate_share * squared / max(across, 1e-6) + scale_m
    a, b, c = normals[n, 0], normals[n, 1], normals[n, 2]
    cosine = (
        (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c) * u
        + (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c) * v
        + (T[2, 0] * a + T[2, 1] * b + T[2, 2] * c) * w
    )
    kept = inside and dx * dx + dy * dy + dz * dz < gate * gate and cosine > gates.least_cosine
    return Held(inside, kept, x, y, z, u, v, w, dx * u + dy * v + dz * w, np.float64(offsets[n]) + t)


@compiled
def normal_equations(
    points: Floats, normals: Floats, offsets: Floats, planes: Planes, T: FloatArray, early: FloatArray,
    late: FloatArray, scale_m: float, gates: Gates, H: FloatArray, g: FloatArray,
) -> None:  # fmt: skip
    """Write H (12, 12) and g (12,) of the squares of residuals, with Geman and McClure's weights.

    Args:
        points, normals: (N, 3) of the current sweep.
        offsets: (N,) seconds from its middle.
        planes: of the previous sweep.
        T: T_prev_curr (4, 4).
        early, late: (6,) velocities in the middles of the previous and of the current sweep.
        scale_m: of the weights.
        gates: what takes part.
    """
    H[:], g[:], J = 0.0, 0.0, np.empty(12)
    for n in range(len(points)):
        held = _hold(n, points, normals, offsets, planes, T, early, late, scale_m, gates)
        if held.kept:
            root = 1.0 + (held.residual / scale_m) ** 2
            _add(held, 1.0 / (root * root), H, g, J)
    _complete(H)


@compiled
def judge(
    points: Floats, normals: Floats, offsets: Floats, planes: Planes, T: FloatArray, early: FloatArray,
    late: FloatArray, scale_m: float, gates: Gates, H: FloatArray, seen: FloatArray, matched: FloatArray,
) -> tuple[int, int, float]:  # fmt: skip
    """Sums over the points that lie well, and over those in view.

    Args:
        points, normals, offsets, planes, T, early, late, gates: as for `normal_equations`.
        scale_m: half the distance within which a point lies well.
        H: (12, 12), written: as of `normal_equations`, with weights of 1, of those that lie well.
        seen, matched: (3, 3), written: of the squares of the normals in the previous frame, of those in view, and of
            those that lie well.

    Returns:
        How many are in view, how many lie well, and the sum of the latter's squared residuals.
    """
    H[:], seen[:], matched[:], J, g = 0.0, 0.0, 0.0, np.empty(12), np.zeros(12)
    turned = np.empty(3)
    in_view, count, squares = 0, 0, 0.0
    for n in range(len(points)):
        held = _hold(n, points, normals, offsets, planes, T, early, late, scale_m, gates)
        if not held.inside:
            continue
        in_view += 1
        for i in range(3):
            turned[i] = T[i, 0] * normals[n, 0] + T[i, 1] * normals[n, 1] + T[i, 2] * normals[n, 2]
        near = held.kept and abs(held.residual) < 2.0 * scale_m
        for i in range(3):
            for j in range(3):
                seen[i, j] += turned[i] * turned[j]
                if near:
                    matched[i, j] += turned[i] * turned[j]
        if near:
            count += 1
            squares += held.residual * held.residual
            _add(held, 1.0, H, g, J)
    _complete(H)
    return in_view, count, squares


@compiled
def _add(held: Held, weight: float, H: FloatArray, g: FloatArray, J: FloatArray) -> None:
    """Add one point's share to the lower triangle of H (12, 12) and to g (12,); J (12,) is room."""
    J[0] = held.y * held.w - held.z * held.v
    J[1] = held.z * held.u - held.x * held.w
    J[2] = held.x * held.v - held.y * held.u
    J[3], J[4], J[5] = held.u, held.v, held.w
    for i in range(6):
        J[6 + i] = held.offset_s * J[i]
    for i in range(12):
        weighted = weight * J[i]
        g[i] += weighted * held.residual
        for j in range(i + 1):
            H[i, j] += weighted * J[j]


@compiled
def _complete(H: FloatArray) -> None:
    """Write the upper triangle, which is the lower one's mirror image."""
    for i in range(len(H)):
        for j in range(i):
            H[j, i] = H[i, j]
