"""Robust Gauss-Newton on SE(3) for residuals `n . (T p - q)` and motions `T exp(xi)`, rotation first."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, displacement_m, exp, inverse, log


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


def geman_mcclure(
    residuals: FloatArray, squared_scale: FloatArray | float, variance: FloatArray | float = 1.0
) -> FloatArray:
    """Information (M,) of residuals (M,) under the kernel of Geman and McClure: `1 / ((1 + r^2 / s^2)^2 variance)`."""
    return np.asarray(1.0 / ((1.0 + residuals**2 / squared_scale) ** 2 * variance), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Hessian (6, 6) and gradient (6,) of half the squared residuals, for a motion from the right, rotation first."""

    hessian: FloatArray
    gradient: FloatArray

    @classmethod
    def of(cls, jacobian: FloatArray, residuals: FloatArray, information: FloatArray) -> "NormalEquations":
        """Of residuals (M,) with their Jacobian (M, 6) and information (M,)."""
        JW = jacobian * information[:, None]
        return cls(JW.T @ jacobian, JW.T @ residuals)


def gauss_newton(
    linearise: Callable[[FloatArray], NormalEquations | None],
    T: FloatArray,
    prior: FloatArray,
    prior_information: FloatArray,
    most_steps: int,
    lever_m: float,
    settled_m: float,
) -> tuple[FloatArray, FloatArray] | None:
    """Minimise from T (4, 4), with a prior (4, 4) of the given information (6, 6).

    Returns:
        The pose, and the Hessian (6, 6) with the prior; None where the correspondences are too few.
    """
    hessian = prior_information
    for _ in range(most_steps):
        system = linearise(T)
        if system is None:
            return None
        hessian = system.hessian + prior_information
        away = log(inverse(prior) @ T)
        xi = np.asarray(np.linalg.solve(hessian, -system.gradient - prior_information @ away), dtype=np.float64)
        T = T @ exp(xi)
        if displacement_m(xi, lever_m) < settled_m:
            break
    return T, hessian
