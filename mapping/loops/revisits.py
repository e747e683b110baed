"""Places revisited while the local map still holds them: there the trajectory itself measures the closure.

A scan that is registered to surfaces drawn at an earlier keyframe measures its pose relative to that keyframe, with all
its points and without the drift of the way between. A loop closure of the two submaps measures the same again from the
same points, with more noise; to count both would count the information twice.
"""

from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import FloatArray, adjoint, inverse, log
from mapping.loops.detection import LoopClosure

# Part of the radius of the local map within which the way must have stayed: surfaces around the keyframe are held too.
_PART_OF_RADIUS = 0.6
# Squared difference of the two measurements beyond which they contradict one another: chi square with six degrees of
# freedom, one time in a thousand. The surfaces of the first visit were drifted away from then, not registered to.
_GATE = 22.5


def as_registered(
    closure: LoopClosure, way: FloatArray, first: FloatArray | None, second: FloatArray | None, radius_m: float
) -> LoopClosure:
    """The closure with the motion that the trajectory measured, where the local map held its place all the way.

    Args:
        closure: of two keyframes.
        way: (N, 4, 4) poses of the scans from the one keyframe to the other, as refined.
        first, second: (6, 6) covariances of the poses of the keyframes, rotation first, in their LiDAR frames; None of
            one that was not registered.
        radius_m: of the local map; 0 without one.

    Returns:
        The closure as it was, where the map did not hold the place, or the two contradict one another.
    """
    if first is None or second is None or not len(way):
        return closure
    away_m = np.linalg.norm(way[:, :3, 3] - way[0, :3, 3], axis=1)
    if away_m.max() > _PART_OF_RADIUS * radius_m:
        return closure
    T_first_second = inverse(way[0]) @ way[-1]
    A = adjoint(inverse(T_first_second))
    covariance = second + A @ first @ A.T
    difference = log(inverse(T_first_second) @ closure.T_first_second)
    if difference @ np.linalg.solve(covariance + closure.covariance, difference) > _GATE:
        return closure
    return replace(closure, T_first_second=T_first_second, covariance=covariance)
