"""Motion compensation: every point of a sweep where it would have been seen at the scan's stamp."""

import math

import numpy as np

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray, log

# Below this angle, squared, series are exact to double precision.
_SERIES_ANGLE2 = 0.25
_SINE = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(8))
_VERSINE = tuple((-1) ** k / math.factorial(2 * k + 2) for k in range(8))
_CUBIC = tuple((-1) ** k / math.factorial(2 * k + 3) for k in range(8))


def body_velocity(T_prev_curr: FloatArray, interval_s: float) -> FloatArray:
    """The constant velocity (6,) in the body's frame, rotation first, that makes a motion in a time."""
    return log(T_prev_curr) / interval_s


def deskew(
    points: FloatArray, time_offsets: FloatArray, velocity_before: FloatArray, velocity_after: FloatArray
) -> FloatArray:
    """Move points to the scan's stamp, given how the sensor moved up to it and from it on.

    A point seen at offset t from the stamp lies at `exp(t * velocity)` in the frame of the stamp.

    Args:
        points: (N, 3) as measured, each in the LiDAR frame of its own instant.
        time_offsets: (N,) seconds from the stamp.
        velocity_before: (6,) for points before the stamp, rotation first, in the frame of the stamp.
        velocity_after: (6,) for points after it.
    """
    if not len(points):
        return points
    if time_offsets.min() >= 0.0 or np.array_equal(velocity_before, velocity_after):
        return move(points, time_offsets, velocity_after)
    if time_offsets.max() <= 0.0:
        return move(points, time_offsets, velocity_before)
    before = time_offsets < 0.0
    moved = np.empty_like(points)
    moved[before] = move(points[before], time_offsets[before], velocity_before)
    moved[~before] = move(points[~before], time_offsets[~before], velocity_after)
    return moved


def move(points: FloatArray, t: FloatArray, velocity: FloatArray) -> FloatArray:
    """`exp(t * velocity)` applied to points (N, 3), each at its own time (N,), without a matrix a point.

    Rodrigues' formula for the rotation, the left Jacobian for the translation.
    """
    moved = np.empty((len(points), 3))
    _move(np.ascontiguousarray(points), np.ascontiguousarray(t), np.ascontiguousarray(velocity), moved)
    return moved


@compiled
def _move(points: FloatArray, t: FloatArray, velocity: FloatArray, moved: FloatArray) -> None:
    rate2 = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    longest = 0.0
    for n in range(len(t)):
        longest = max(longest, abs(t[n]))
    # Without branches and functions the processor takes several points at once.
    if rate2 * longest * longest < _SERIES_ANGLE2:
        for n in range(len(points)):
            _move_one(n, points, t[n], velocity, _series(rate2 * t[n] * t[n]), moved)
    else:
        for n in range(len(points)):
            _move_one(n, points, t[n], velocity, _closed(rate2 * t[n] * t[n]), moved)


@compiled
def _move_one(
    n: int, points: FloatArray, s: float, velocity: FloatArray, coefficients: tuple[float, float, float],
    moved: FloatArray,
) -> None:  # fmt: skip
    """The exponential of s times the velocity, applied to a point."""
    sine, versine, cubic = coefficients
    x, y, z = points[n, 0], points[n, 1], points[n, 2]
    a, b, c = s * velocity[0], s * velocity[1], s * velocity[2]
    u, v, w = s * velocity[3], s * velocity[4], s * velocity[5]
    # The rotation vector's cross product with the point, and again with that; and so with the translation.
    px, py, pz = b * z - c * y, c * x - a * z, a * y - b * x
    qx, qy, qz = b * pz - c * py, c * px - a * pz, a * py - b * px
    gx, gy, gz = b * w - c * v, c * u - a * w, a * v - b * u
    hx, hy, hz = b * gz - c * gy, c * gx - a * gz, a * gy - b * gx
    moved[n, 0] = x + sine * px + versine * (qx + gx) + u + cubic * hx
    moved[n, 1] = y + sine * py + versine * (qy + gy) + v + cubic * hy
    moved[n, 2] = z + sine * pz + versine * (qz + gz) + w + cubic * hz


@compiled
def _series(squared: float) -> tuple[float, float, float]:
    """sin(a)/a, (1-cos(a))/a^2 and (a-sin(a))/a^3 of a^2 below a quarter, to double precision."""
    x, s, v, c = squared, _SINE, _VERSINE, _CUBIC
    sine = s[0] + x * (s[1] + x * (s[2] + x * (s[3] + x * (s[4] + x * (s[5] + x * (s[6] + x * s[7]))))))
    versine = v[0] + x * (v[1] + x * (v[2] + x * (v[3] + x * (v[4] + x * (v[5] + x * (v[6] + x * v[7]))))))
    cubic = c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * (c[5] + x * (c[6] + x * c[7]))))))
    return sine, versine, cubic


@compiled
def _closed(squared: float) -> tuple[float, float, float]:
    """The same of any a^2."""
    if squared < _SERIES_ANGLE2:
        return _series(squared)
    angle = math.sqrt(squared)
    sine, half = math.sin(angle), math.sin(0.5 * angle)
    return sine / angle, 2.0 * half * half / squared, (angle - sine) / (squared * angle)
