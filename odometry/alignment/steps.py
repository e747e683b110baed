"""Gauss-Newton steps of an alignment, compiled: for so little arithmetic, NumPy costs ten times as much."""

import math

import numpy as np

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.compiled_motion import write_exp, write_log, write_product
from lidarslam.core.geometry import FloatArray

# Information that keeps the normal equations solvable.
_DAMPING = 1e-3
# No step of the motion is larger: radians and metres.
_LARGEST_STEP = 0.3
_UNKNOWNS = 12


@compiled
def take_step(
    T: FloatArray, innovation: FloatArray, H: FloatArray, g: FloatArray, T_curr_prev: FloatArray,
    information: FloatArray, expected: FloatArray,
) -> float:  # fmt: skip
    """Move T_prev_curr (4, 4), from the left, and the innovation (6,) by one Gauss-Newton step, in place.

    Args:
        H, g: (12, 12) and (12,) normal equations of the images, as information; overwritten.
        T_curr_prev, information: (4, 4) inverse of the prior's motion and (6, 6) of a change from it.
        expected: (6, 6) information of the innovation being zero.

    Returns:
        The largest part of the step of the motion, radians or metres.
    """
    away, step, moved = np.empty(6), np.empty(_UNKNOWNS), np.empty((4, 4))
    write_product(T, T_curr_prev, moved)
    write_log(moved, away)
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
    write_exp(step, change)
    write_product(change, T, moved)
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
    write_log(T, late)
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
