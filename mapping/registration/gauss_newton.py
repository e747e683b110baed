"""Robust Gauss-Newton on SE(3) for residuals `n . (T p - q)` and motions `T exp(xi)`, rotation first; degeneracy."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray, displacement_m, exp, inverse, log
from lidarslam.core.tracking import Degeneracy

# Least mean constraint of a direction. Noisy normals of a corridor's walls constrain it as well: the share that their
# uncertainty explains does not count.
_LEAST_SHARE = 0.0005
_NOISE_FACTOR = 1.25


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


def geman_mcclure(residuals: FloatArray, squared_scale: float) -> FloatArray:
    """Weights (M,) of residuals (M,) under the kernel of Geman and McClure: `1 / (1 + r^2 / s^2)^2`."""
    return np.asarray(1.0 / (1.0 + residuals**2 / squared_scale) ** 2, dtype=np.float64)


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
    linearise: Callable[[FloatArray], NormalEquations | None], T: FloatArray, prior: FloatArray,
    prior_information: FloatArray, most_steps: int, lever_m: float, settled_m: float,
) -> tuple[FloatArray, FloatArray] | None:  # fmt: skip
    """The pose at the minimum, from T (4, 4) on, and the Hessian (6, 6), with a prior (4, 4) of an information (6, 6).

    None where the correspondences are too few.
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


def find_degeneracy(jacobian: FloatArray, weights: FloatArray, tilt: FloatArray, lever_m: float) -> Degeneracy:
    """Find the directions of motion that a set of correspondences does not constrain.

    The Jacobian (M, 6) of the residuals, rotation first, is in the LiDAR frame; weights (M,); the tilt (M,) is the
    standard deviation of each normal, radians; the lever the root mean square range. The eigenvalues of the mean of
    `J^T J`, rotations made comparable by the lever, lie between 0 and about 1, whatever the number, unit or noise of
    the residuals. Zhang, Kaess and Singh, "On Degeneracy of Optimization-based State Estimation Problems" (ICRA
    2016), take the eigenvalues of the sum, whose threshold depends on all three.
    """
    constraint = (jacobian * weights[:, None]).T @ jacobian
    return Degeneracy(open_directions(constraint, float(weights @ tilt**2), float(weights.sum()), lever_m), lever_m)


@compiled
def open_directions(constraint: FloatArray, tilt: float, weight: float, lever_m: float) -> FloatArray:
    """Directions (D, 6) as of `find_degeneracy`, from the weighted sums of `J^T J` (6, 6) and of the squared tilt."""
    if weight <= 0.0:
        return np.eye(6)
    scaled, count = np.empty((6, 6)), 0
    for i in range(6):
        for j in range(6):
            levers = (lever_m if i < 3 else 1.0) * (lever_m if j < 3 else 1.0)
            scaled[i, j] = constraint[i, j] / weight / levers
    shares, axes = np.linalg.eigh(scaled)
    while count < 6 and shares[count] < max(_LEAST_SHARE, _NOISE_FACTOR * (tilt / weight)):
        count += 1
    directions = np.empty((count, 6))
    for d in range(count):
        for i in range(6):
            directions[d, i] = axes[i, d]
    return directions
