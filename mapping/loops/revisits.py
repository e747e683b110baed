"""Loop closures of places that the local map still held: there the trajectory itself measures the closure.

A scan registered to surfaces seen from an earlier keyframe measures its pose relative to that keyframe, with all its
points and without drift. Registering the two submaps measures the same again from the same points, with more noise.
"""

from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import FloatArray, adjoint, inverse, log
from lidarslam.mapping.loops.closure import LoopClosure

# Part of the radius of the local map within which the way must have stayed: surfaces around the keyframe are held too.
_PART_OF_RADIUS = 0.6
# Chi-squared with six degrees of freedom, one time in a thousand: beyond, the two measurements contradict one another,
# and the surfaces of the first visit had drifted away.
_CHI_SQUARED_999 = 22.5


def as_registered(
    closure: LoopClosure,
    T_odom_first: FloatArray,
    way: FloatArray,
    first: FloatArray | None,
    second: FloatArray | None,
    radius_m: float,
) -> LoopClosure:
    """The closure with the motion along the trajectory, where the local map held its place all the way.

    Args:
        closure: of two keyframes.
        T_odom_first: (4, 4) pose of the first one in the local map.
        way: (N, 4, 4) registered poses of the scans from the one since which it is there to the second keyframe.
        first, second: (6, 6) covariances of the poses of the keyframes, rotation first, in their LiDAR frames; None of
            one that was not registered.
        radius_m: of the local map; 0 without one.

    Returns:
        The closure as it was, where the map did not hold the place, or the two contradict one another.
    """
    if first is None or second is None or not len(way):
        return closure
    if np.linalg.norm(way[:, :3, 3] - T_odom_first[:3, 3], axis=1).max() > _PART_OF_RADIUS * radius_m:
        return closure
    T_first_second = inverse(T_odom_first) @ way[-1]
    A = adjoint(inverse(T_first_second))
    covariance = second + A @ first @ A.T
    difference = log(inverse(T_first_second) @ closure.T_first_second)
    if difference @ np.linalg.solve(covariance + closure.covariance, difference) > _CHI_SQUARED_999:
        return closure
    return replace(closure, T_first_second=T_first_second, covariance=covariance)
