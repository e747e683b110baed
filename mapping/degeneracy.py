"""Which ways of moving the matched surfaces leave open: along a corridor, around the axis of a tank."""

import numpy as np

from lidarslam.core.degeneracy import Degeneracy, lever_scale
from lidarslam.core.geometry import FloatArray

# Share of all pulls that must be felt along a direction. A corridor's noisy walls are felt along it as well: what the
# uncertainty of the normals alone would make is not counted.
_LEAST_SHARE = 0.0005
_NOISE_FACTOR = 1.25


def find_degeneracy(jacobian: FloatArray, weights: FloatArray, tilt: FloatArray, lever_m: float) -> Degeneracy:
    """Find the directions along which a set of matches does not hold the sensor.

    Each match contributes the square of how much it is felt along a direction, rotations made comparable by
    `lever_m`; the mean over the matches lies between 0 and about 1, whatever their number, unit or noise. Zhang, Kaess
    and Singh, "On Degeneracy of Optimization-based State Estimation Problems" (ICRA 2016), look at the eigenvalues of
    the sum, whose threshold depends on all three.

    Args:
        jacobian: (M, 6) change of each residual with the motion, rotation first, in the LiDAR frame.
        weights: (M,).
        tilt: (M,) standard deviation of each match's normal, radians.
        lever_m: typical distance of the points.
    """
    total = float(weights.sum())
    if total <= 0.0:
        return Degeneracy(np.eye(6), lever_m)
    scaled = jacobian / lever_scale(lever_m)
    shares, axes = np.linalg.eigh((scaled * weights[:, None]).T @ scaled / total)
    noise = float(weights @ tilt**2) / total
    return Degeneracy(axes[:, shares < max(_LEAST_SHARE, _NOISE_FACTOR * noise)].T, lever_m)
