"""Eigenvalues and eigenvectors of symmetric 3x3 matrices in closed form, compiled."""

import math

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray

# Columns of the six distinct entries: xx, xy, xz, yy, yz, zz.
SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))

_TINY = 1e-30


@compiled
def write_eigenvalues(M: FloatArray, values: FloatArray) -> None:
    """Write the eigenvalues (3,), ascending, of a matrix given by its six distinct entries (6,).

    The trigonometric solution of the characteristic polynomial: Smith, "Eigenvalues of a symmetric 3x3 matrix",
    Communications of the ACM 4 (1961). Accurate to about 1e-8 of the largest one.
    """
    xx, xy, xz, yy, yz, zz = M[0], M[1], M[2], M[3], M[4], M[5]
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    off = xy * xy + xz * xz + yz * yz
    p = math.sqrt(max((a * a + b * b + c * c + 2.0 * off) / 6.0, _TINY))
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = math.acos(min(max(determinant / (2.0 * p * p * p), -1.0), 1.0)) / 3.0
    largest = mean + 2.0 * p * math.cos(angle)
    smallest = mean + 2.0 * p * math.cos(angle + 2.0 * math.pi / 3.0)
    values[0], values[1], values[2] = smallest, 3.0 * mean - largest - smallest, largest


@compiled
def write_eigenvector(M: FloatArray, value: float, vector: FloatArray) -> None:
    """Write the unit eigenvector (3,) to a simple eigenvalue of a matrix (6,).

    The rows of M - value * I span the plane across the eigenvector: the longest of their cross products is along it.
    Any unit vector where the eigenvalue is not simple.
    """
    xy, xz, yz = M[1], M[2], M[4]
    a, b, c = M[0] - value, M[3] - value, M[5] - value
    x, y, z = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    squared = x * x + y * y + z * z
    for crosses in (
        (xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz),
        (b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz),
    ):
        u, v, w = crosses
        length = u * u + v * v + w * w
        if length > squared:
            x, y, z, squared = u, v, w, length
    length = math.sqrt(squared)
    if not length > _TINY:
        x, y, z, length = 0.0, 0.0, 1.0, 1.0
    vector[0], vector[1], vector[2] = x / length, y / length, z / length
