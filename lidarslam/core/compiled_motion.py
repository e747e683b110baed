"""Motions of SE(3) within compiled loops: the functions of `lidarslam.core.geometry` for one transform (4, 4)."""

import math

import numpy as np

from lidarslam.core.compiled import compiled_part
from lidarslam.core.geometry import FloatArray, coefficients, exp_rows, log_translation, rotation_vector

_coefficients, _exp_rows = compiled_part(coefficients), compiled_part(exp_rows)
_rotation_vector, _log_translation = compiled_part(rotation_vector), compiled_part(log_translation)


@compiled_part
def write_product(T_a_b: FloatArray, T_b_c: FloatArray, T_a_c: FloatArray) -> None:
    """Write the product (4, 4) of two transforms, none of which it may be."""
    for i in range(4):
        for j in range(4):
            total = 0.0
            for k in range(4):
                total += T_a_b[i, k] * T_b_c[k, j]
            T_a_c[i, j] = total


@compiled_part
def orthonormalize_nearly(T: FloatArray) -> None:
    """Take rounding off the rotation of a nearly rigid transform: a Newton step towards the nearest rotation."""
    # Loops: each expression of arrays takes a second to compile.
    products, rotation = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            products[i, j], rotation[i, j] = 0.0, T[i, j]
            for k in range(3):
                products[i, j] += T[k, i] * T[k, j]
    for i in range(3):
        for j in range(3):
            T[i, j] = 1.5 * rotation[i, j]
            for k in range(3):
                T[i, j] -= 0.5 * rotation[i, k] * products[k, j]


@compiled_part
def write_inverse(T: FloatArray, inverted: FloatArray) -> None:
    """Write the inverse (4, 4) of a rigid transform."""
    for i in range(3):
        inverted[i, 3], inverted[3, i] = 0.0, 0.0
        for j in range(3):
            inverted[i, j] = T[j, i]
            inverted[i, 3] -= T[j, i] * T[j, 3]
    inverted[3, 3] = 1.0


@compiled_part
def write_exp(xi: FloatArray, T: FloatArray) -> None:
    """Write the exponential (4, 4) of a tangent vector (6,)."""
    a, b, c = xi[0], xi[1], xi[2]
    s, v, w = _coefficients(math.sqrt(a * a + b * b + c * c))
    rows = _exp_rows(a, b, c, xi[3], xi[4], xi[5], s, v, w)
    for i in range(12):
        T[i // 4, i % 4] = rows[i]
        T[3, i % 4] = 0.0
    T[3, 3] = 1.0


@compiled_part
def write_log(T: FloatArray, xi: FloatArray) -> None:
    """Write the logarithm (6,) of a transform."""
    a, b, c, angle = _rotation_vector(
        T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2]
    )  # fmt: skip
    s, v, _ = _coefficients(angle)
    xi[0], xi[1], xi[2] = a, b, c
    xi[3], xi[4], xi[5] = _log_translation(a, b, c, T[0, 3], T[1, 3], T[2, 3], angle, s, v)
