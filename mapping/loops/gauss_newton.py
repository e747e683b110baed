"""Robust Gauss-Newton on SE(3) with a prior, the solver of both registrations of loop closures."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, displacement_m, exp, inverse, log


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


def geman_mcclure(residuals: FloatArray, scale: float) -> FloatArray:
    """Weights of the robust kernel of Geman and McClure."""
    return np.asarray((1.0 + (residuals / scale) ** 2) ** -2, dtype=np.float64)


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
