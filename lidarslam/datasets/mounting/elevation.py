"""The correction of a sensor whose elevations are wrong by an angle, applied before every method alike."""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray

# The calibration of the laser that KITTI was recorded with places every point too low; without the correction the
# average error of KISS-ICP on KITTI doubles. Upwards; the value of KISS-ICP and CT-ICP.
KITTI_DEG = 0.205

# Keeps the division finite for the origin, a driver's mark for "no return", which has to stay the origin.
_SMALLEST_RHO_M = 1e-30


def correct_elevation(points: NDArray[np.floating], angle_deg: float) -> FloatArray:
    """Raise the elevation of every point, seen from the sensor, by the same angle.

    Each point p turns about the axis p x z_hat, which leaves its range and azimuth as they were. With rho the
    horizontal range the turn happens in the (rho, z) plane: rho' = rho cos a - z sin a, z' = rho sin a + z cos a,
    and x and y scale by rho' / rho. The rule, with 0.205 degrees for KITTI, is that of KISS-ICP (Vizzo et al.,
    RA-L 2023) and of CT-ICP and IMLS-SLAM before it.

    Args:
        points: (N, 3), LiDAR frame; may hold invalid points, which stay invalid.
        angle_deg: upwards positive.

    Returns:
        (N, 3) float64, a new array.
    """
    corrected, angle = np.empty((len(points), 3)), math.radians(angle_deg)
    _raise(points, math.sin(angle), math.cos(angle), corrected)
    return corrected


@compiled
def _raise(points: NDArray[np.floating], sine: float, cosine: float, corrected: FloatArray) -> None:
    """Write points (N, 3), raised by an angle."""
    for n in range(len(points)):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        rho = np.sqrt(x * x + y * y)
        scale = cosine - sine * (z / (rho if rho > _SMALLEST_RHO_M else _SMALLEST_RHO_M))
        corrected[n, 0], corrected[n, 1], corrected[n, 2] = x * scale, y * scale, rho * sine + z * cosine
