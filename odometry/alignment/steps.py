"""One Gauss-Newton step of an alignment, compiled: for so little arithmetic, arrays cost ten times as much."""

import math

import numpy as np

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray

# Information that keeps the normal equations solvable.
_DAMPING = 1e-3
_UNKNOWNS = 12


@compiled
def gauss_newton_step(
    H: FloatArray, g: FloatArray, per_unit: float, information: FloatArray, away: FloatArray, expected: FloatArray,
    innovation: FloatArray,
) -> FloatArray:  # fmt: skip
    """One step (12,) of the motion, from the left, and of the innovation.

    Args:
        H, g: (12, 12) and (12,) normal equations of the images, overwritten.
        per_unit: by which they become information.
        information, away: (6, 6) of the prior and (6,) what the motion is away from it.
        expected, innovation: (6, 6) of the innovation being zero, and (6,) what it is.
    """
    for i in range(_UNKNOWNS):
        g[i] *= per_unit
        for j in range(_UNKNOWNS):
            H[i, j] *= per_unit
        H[i, i] += _DAMPING
    for i in range(6):
        for j in range(6):
            H[i, j] += information[i, j]
            H[6 + i, 6 + j] += expected[i, j]
            g[i] += information[i, j] * away[j]
            g[6 + i] += expected[i, j] * innovation[j]
    step = np.empty(_UNKNOWNS)
    _solve(H, g, step)
    return -step


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
