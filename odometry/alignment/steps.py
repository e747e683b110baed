"""Gauss-Newton steps of an alignment, compiled: for so little arithmetic, NumPy costs ten times as much."""

import math

import numpy as np

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import SMALL_ANGLE, FloatArray, coefficients

# Information that keeps the normal equations solvable.
_DAMPING = 1e-3
# No step of the motion is larger: radians and metres.
_LARGEST_STEP = 0.3
_UNKNOWNS = 12

_coefficients = compiled_part(coefficients)


@compiled
def take_step(
    T: FloatArray, innovation: FloatArray, H: FloatArray, g: FloatArray, T_curr_prev: FloatArray,
    information: FloatArray, expected: FloatArray,
) -> float:  # fmt: skip
    """Move T_prev_curr (4, 4), from the left, and the innovation (6,) by one Gauss-Newton step, in place.

    Args:
        T, innovation: see above.
        H, g: (12, 12) and (12,) normal equations of the images, as information; overwritten.
        T_curr_prev, information: (4, 4) inverse of the prior's motion and (6, 6) of a change from it.
        expected: (6, 6) information of the innovation being zero.

    Returns:
        The largest part of the step of the motion, radians or metres.
    """
    away, step, moved = np.empty(6), np.empty(_UNKNOWNS), np.empty((4, 4))
    _multiply(T, T_curr_prev, moved)
    _log(moved, away)
    for i in range(6):
        for j in range(6):
            H[i, j] += information[i, j]
            H[6 + i, 6 + j] += expected[i, j]
            g[i] += information[i, j] * away[j]
            g[6 + i] += expected[i, j] * innovation[j]
    for i in range(_UNKNOWNS):
        H[i, i] += _DAMPING
    _solve(H, g, step)
    largest = 0.0
    for i in range(6):
        largest = max(largest, abs(step[i]))
        innovation[i] -= step[6 + i]
    shortened, change = -_LARGEST_STEP / max(largest, _LARGEST_STEP), np.empty((4, 4))
    for i in range(6):
        step[i] *= shortened
    _exp(step, change)
    _multiply(change, T, moved)
    for i in range(4):
        for j in range(4):
            T[i, j] = moved[i, j]
    return largest * -shortened


@compiled
def write_velocities(
    T: FloatArray, innovation: FloatArray, interval_s: float, share: float, last: FloatArray, early: FloatArray,
    late: FloatArray,
) -> None:  # fmt: skip
    """Write the velocities (6,) in the middles of the previous and of the current sweep.

    The change of velocity is the innovation and a share of that from the last velocity (6,) to the mean one.
    """
    _log(T, late)
    for i in range(6):
        velocity = late[i] / interval_s
        change = innovation[i] + share * (velocity - last[i])
        early[i], late[i] = velocity - change, velocity + change


@compiled_part
def _solve(H: FloatArray, g: FloatArray, x: FloatArray) -> None:
    """Write the solution of a positive definite system by Cholesky's factor, which overwrites half of H."""
    for i in range(_UNKNOWNS):
        for j in range(i + 1):
            rest = H[i, j]
            for k in range(j):
                rest -= H[i, k] * H[j, k]
            H[i, j] = math.sqrt(rest) if i == j else rest / H[j, j]
    for i in range(_UNKNOWNS):
        rest = g[i]
        for k in range(i):
            rest -= H[i, k] * x[k]
        x[i] = rest / H[i, i]
    for i in range(_UNKNOWNS - 1, -1, -1):
        rest = x[i]
        for k in range(i + 1, _UNKNOWNS):
            rest -= H[k, i] * x[k]
        x[i] = rest / H[i, i]


@compiled_part
def _multiply(T_a_b: FloatArray, T_b_c: FloatArray, T_a_c: FloatArray) -> None:
    for i in range(4):
        for j in range(4):
            total = 0.0
            for k in range(4):
                total += T_a_b[i, k] * T_b_c[k, j]
            T_a_c[i, j] = total


@compiled_part
def _exp(xi: FloatArray, T: FloatArray) -> None:
    """Write `lidarslam.core.geometry.exp` of the first six numbers."""
    a, b, c, x, y, z = xi[0], xi[1], xi[2], xi[3], xi[4], xi[5]
    s, v, j = _coefficients(math.sqrt(a * a + b * b + c * c))
    aa, bb, cc, ab, ac, bc = a * a, b * b, c * c, a * b, a * c, b * c
    u, w, h = b * z - c * y, c * x - a * z, a * y - b * x  # omega x v
    T[0, 0], T[0, 1], T[0, 2], T[0, 3] = (
        1.0 - v * (bb + cc),
        v * ab - s * c,
        v * ac + s * b,
        x + v * u + j * (b * h - c * w),
    )
    T[1, 0], T[1, 1], T[1, 2], T[1, 3] = (
        v * ab + s * c,
        1.0 - v * (aa + cc),
        v * bc - s * a,
        y + v * w + j * (c * u - a * h),
    )
    T[2, 0], T[2, 1], T[2, 2], T[2, 3] = (
        v * ac - s * b,
        v * bc + s * a,
        1.0 - v * (aa + bb),
        z + v * h + j * (a * w - b * u),
    )
    T[3, 0], T[3, 1], T[3, 2], T[3, 3] = 0.0, 0.0, 0.0, 1.0


@compiled_part
def _log(T: FloatArray, xi: FloatArray) -> None:
    """Write `lidarslam.core.geometry.log` (6,), by the best conditioned of four multiples of the quaternion."""
    i, j, k = T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]
    p, q, r = T[0, 1] + T[1, 0], T[0, 2] + T[2, 0], T[1, 2] + T[2, 1]
    real = 1.0 + T[0, 0] + T[1, 1] + T[2, 2]
    by_x, by_y, by_z = (
        1.0 + T[0, 0] - T[1, 1] - T[2, 2], 1.0 - T[0, 0] + T[1, 1] - T[2, 2], 1.0 - T[0, 0] - T[1, 1] + T[2, 2]
    )  # fmt: skip
    if real >= by_x and real >= by_y and real >= by_z:
        w, a, b, c = real, i, j, k
    elif by_x >= by_y and by_x >= by_z:
        w, a, b, c = i, by_x, p, q
    elif by_y >= by_z:
        w, a, b, c = j, p, by_y, r
    else:
        w, a, b, c = k, q, r, by_z
    sine = math.sqrt(a * a + b * b + c * c)
    angle = 2.0 * math.atan2(sine, abs(w))
    scale = math.copysign(angle / sine if sine > 0.0 else 0.0, w)
    a, b, c = scale * a, scale * b, scale * c
    s, v, _ = _coefficients(angle)
    near = angle < SMALL_ANGLE
    coefficient = 1.0 / 12.0 + angle * angle / 720.0 if near else (1.0 - s / (2.0 * v)) / (angle * angle)
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    u, g, h = b * z - c * y, c * x - a * z, a * y - b * x  # omega x t
    xi[0], xi[1], xi[2] = a, b, c
    xi[3] = x - 0.5 * u + coefficient * (b * h - c * g)
    xi[4] = y - 0.5 * g + coefficient * (c * u - a * h)
    xi[5] = z - 0.5 * h + coefficient * (a * g - b * u)
