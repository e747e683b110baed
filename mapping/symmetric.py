"""Eigenvalues and vectors of many symmetric 3x3 matrices at once, in closed form."""

import math

import numpy as np

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray

# Columns of the six distinct entries: xx, xy, xz, yy, yz, zz.
SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))

_TINY = 1e-30


def eigenvalues(M: FloatArray) -> FloatArray:
    """Eigenvalues (N, 3), ascending, of matrices given by their six distinct entries (N, 6).

    The trigonometric solution of the characteristic polynomial: Smith, "Eigenvalues of a symmetric 3x3 matrix",
    Communications of the ACM 4 (1961). Accurate to about 1e-8 of the largest one.
    """
    values = np.empty((len(M), 3))
    _write_values(np.ascontiguousarray(M), values)
    return values


def eigenvectors(M: FloatArray, values: FloatArray) -> FloatArray:
    """Unit eigenvectors (N, 3) to one simple eigenvalue (N,) of each of the matrices (N, 6).

    The rows of M - value * I span the plane across the eigenvector: the longest of their cross products is along it.
    Any unit vector where the eigenvalue is not simple.
    """
    vectors = np.empty((len(M), 3))
    _write_vectors(np.ascontiguousarray(M), np.ascontiguousarray(values), vectors)
    return vectors


@compiled
def _write_values(M: FloatArray, values: FloatArray) -> None:
    for n in range(len(M)):
        xx, xy, xz, yy, yz, zz = M[n, 0], M[n, 1], M[n, 2], M[n, 3], M[n, 4], M[n, 5]
        mean = (xx + yy + zz) / 3.0
        a, b, c = xx - mean, yy - mean, zz - mean
        off = xy * xy + xz * xz + yz * yz
        p = math.sqrt(max((a * a + b * b + c * c + 2.0 * off) / 6.0, _TINY))
        determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
        angle = math.acos(min(max(determinant / (2.0 * p * p * p), -1.0), 1.0)) / 3.0
        largest = mean + 2.0 * p * math.cos(angle)
        smallest = mean + 2.0 * p * math.cos(angle + 2.0 * math.pi / 3.0)
        values[n, 0], values[n, 1], values[n, 2] = smallest, 3.0 * mean - largest - smallest, largest


@compiled
def _write_vectors(M: FloatArray, values: FloatArray, vectors: FloatArray) -> None:
    for n in range(len(M)):
        xy, xz, yz = M[n, 1], M[n, 2], M[n, 4]
        a, b, c = M[n, 0] - values[n], M[n, 3] - values[n], M[n, 5] - values[n]
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
        vectors[n, 0], vectors[n, 1], vectors[n, 2] = x / length, y / length, z / length
