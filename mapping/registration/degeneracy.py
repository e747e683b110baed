"""Degenerate directions of a registration: along a corridor, around the axis of a tank."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Degeneracy, lever_scale

# Least mean constraint of a direction. Noisy normals of a corridor's walls constrain it as well: the share that their
# uncertainty explains does not count.
_LEAST_SHARE = 0.0005
_NOISE_FACTOR = 1.25
# Information of the prediction along degenerate directions: that of a tenth of a millimetre.
DEGENERATE_INFORMATION = 1e8


def find_degeneracy(jacobian: FloatArray, weights: FloatArray, tilt: FloatArray, lever_m: float) -> Degeneracy:
    """Find the directions of motion that a set of correspondences does not constrain.

    The eigenvalues of the mean of `J^T J`, rotations made comparable by `lever_m`, lie between 0 and about 1, whatever
    the number, unit or noise of the residuals. Zhang, Kaess and Singh, "On Degeneracy of Optimization-based State
    Estimation Problems" (ICRA 2016), take the eigenvalues of the sum, whose threshold depends on all three.

    Args:
        jacobian: (M, 6) of the residuals, rotation first, in the LiDAR frame.
        weights: (M,).
        tilt: (M,) standard deviation of each normal, radians.
        lever_m: root mean square range of the points.
    """
    constraint = (jacobian * weights[:, None]).T @ jacobian
    return degenerate_directions(constraint, float(weights @ tilt**2), float(weights.sum()), lever_m)


def degenerate_directions(constraint: FloatArray, tilt: float, weight: float, lever_m: float) -> Degeneracy:
    """As `find_degeneracy`, from the weighted sums of `J^T J` (6, 6) and of the squared tilt, and the total weight."""
    if weight <= 0.0:
        return Degeneracy(np.eye(6), lever_m)
    scale = lever_scale(lever_m)
    shares, axes = np.linalg.eigh(constraint / weight / np.outer(scale, scale))
    return Degeneracy(axes[:, shares < max(_LEAST_SHARE, _NOISE_FACTOR * (tilt / weight))].T, lever_m)
