"""Eigenvalues and vectors of many symmetric 3x3 matrices at once, in closed form."""

import numpy as np

from lidarslam.core.geometry import FloatArray

# Columns of the six distinct entries: xx, xy, xz, yy, yz, zz.
SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))

_TINY = 1e-30


def eigenvalues(M: FloatArray) -> FloatArray:
    """Eigenvalues (N, 3), ascending, of matrices given by their six distinct entries (N, 6).

    The trigonometric solution of the characteristic polynomial: Smith, "Eigenvalues of a symmetric 3x3 matrix",
    Communications of the ACM 4 (1961). Accurate to about 1e-8 of the largest one.
    """
    xx, xy, xz, yy, yz, zz = M.T
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    off = xy * xy + xz * xz + yz * yz
    p = np.sqrt(np.maximum((a * a + b * b + c * c + 2.0 * off) / 6.0, _TINY))
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(np.clip(determinant / (2.0 * p**3), -1.0, 1.0)) / 3.0
    largest = mean + 2.0 * p * np.cos(angle)
    smallest = mean + 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0)
    return np.stack([smallest, 3.0 * mean - largest - smallest, largest], axis=1)


def eigenvectors(M: FloatArray, values: FloatArray) -> FloatArray:
    """Unit eigenvectors (N, 3) to one simple eigenvalue (N,) of each of the matrices (N, 6).

    The rows of M - value * I span the plane across the eigenvector: the longest of their cross products is along it.
    Any unit vector where the eigenvalue is not simple.
    """
    xx, xy, xz, yy, yz, zz = M.T
    a, b, c = xx - values, yy - values, zz - values
    crosses = np.stack(
        [
            np.stack([xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy], axis=1),
            np.stack([xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz], axis=1),
            np.stack([b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz], axis=1),
        ],
        axis=1,
    )
    squared = np.einsum("nij,nij->ni", crosses, crosses)
    longest = squared.argmax(axis=1)
    rows = np.arange(len(M))
    lengths = np.sqrt(squared[rows, longest])
    known = lengths > _TINY
    vectors = np.zeros((len(M), 3))
    vectors[:, 2] = 1.0
    vectors[known] = crosses[rows, longest][known] / lengths[known, None]
    return vectors
