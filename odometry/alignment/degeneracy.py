"""Degenerate directions of a pair of sweeps, along which the motion goes on as before.

Along an even tunnel the residuals are small for any translation. The remaining gradient is due to the noise of the
normals, and is biased towards no motion; so is a network's estimate from the same scans.
"""

import numpy as np

from lidarslam.core.directions.degeneracy import Degeneracy, lever_scale
from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.odometry.images.sweep_images import SweepImages

# Mean squared Jacobian of the points along a direction, from 0 to about 1. Where the end of a tunnel is in view it is
# 0.002 and more, in an even one 0.0006 and less.
_LEAST_SHARE = 0.001
# Standard deviation of a normal at one metre, radians, by a centimetre of range noise over a patch; it falls with the
# range. Along a direction with no more than this share of it, the constraint is that noise.
_TILT_AT_1_M, _NOISE_FACTOR = 0.09, 1.25
# Among leaves and wires most points have no normal, and a network that sees these as well knows more than alignment:
# unless so many have one, nothing is taken for degenerate.
_MOST = 0.7


def find_degeneracy(information: FloatArray, inliers: int, images: SweepImages) -> Degeneracy:
    """Directions that the inliers of an alignment leave open.

    Args:
        information: (6, 6) sum over the inliers of squared Jacobians, rotation first.
        inliers: how many.
        images: of the current sweep; its median range is the lever of rotations, its ranges the noise of normals.
    """
    if images.share_with_normal() < _MOST:
        return Degeneracy(np.empty((0, 6)), 1.0)
    lever_m = images.median_range_m()
    scale = lever_scale(lever_m)
    shares, axes = np.linalg.eigh(information / np.outer(scale, scale) / max(inliers, 1))
    least = max(_LEAST_SHARE, _NOISE_FACTOR * _TILT_AT_1_M**2 * images.mean_inverse_square_range())
    return Degeneracy(np.ascontiguousarray(axes[:, shares < least].T), lever_m)


def replaced_along(T_prev_curr: FloatArray, expected: FloatArray, degeneracy: Degeneracy) -> FloatArray:
    """A motion (4, 4) with its part along the degenerate directions replaced by that of the expected one."""
    along = degeneracy.part_along() @ log(expected @ inverse(T_prev_curr))
    return np.asarray(exp(along) @ T_prev_curr, dtype=np.float64)


def joined_information(seen: FloatArray, expected: FloatArray, degeneracy: Degeneracy) -> FloatArray:
    """Information (6, 6): along the degenerate directions that of an expectation of this covariance, else as seen."""
    D = degeneracy.rows
    across = np.eye(6) - degeneracy.part_along()
    return np.asarray(across.T @ seen @ across + D.T @ np.linalg.solve(D @ expected @ D.T, D), dtype=np.float64)
