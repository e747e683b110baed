"""Robust Gauss-Newton on SE(3) for residuals `n . (T p - q)` and motions `T exp(xi)`, rotation first."""

import numpy as np

from lidarslam.core.geometry import FloatArray


def point_to_plane_jacobian(points: FloatArray, normals: FloatArray) -> FloatArray:
    """(M, 6) of the residuals of points (M, 3) with normals (M, 3), both in the frame that is moved.

    The cross product is written out: several times as fast as NumPy's.
    """
    J = np.empty((len(points), 6))
    J[:, 0] = points[:, 1] * normals[:, 2] - points[:, 2] * normals[:, 1]
    J[:, 1] = points[:, 2] * normals[:, 0] - points[:, 0] * normals[:, 2]
    J[:, 2] = points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]
    J[:, 3:] = normals
    return J


def geman_mcclure(residuals: FloatArray, squared_scale: FloatArray | float, variance: FloatArray | float) -> FloatArray:
    """Information (M,) of residuals (M,) under the kernel of Geman and McClure: `1 / ((1 + r^2 / s^2)^2 variance)`."""
    return np.asarray(1.0 / ((1.0 + residuals**2 / squared_scale) ** 2 * variance), dtype=np.float64)
