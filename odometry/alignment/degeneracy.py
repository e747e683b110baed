"""Which ways of moving two scans leave open, and going on along these as before.

Along an even tunnel the points lie on the other scan's planes wherever one lays them. What is still felt along it comes
from the noise of the normals, and holds that nothing moved. A network that looks at the same scans knows no better.
"""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.degeneracy import Degeneracy, lever_scale
from lidarslam.core.geometry import FloatArray, exp, inverse, log
from odometry.images.sweeps import SweepImages

# Mean over the points of how much each is felt along a direction, from 0 to about 1. Where the end of a tunnel is in
# view it is 0.002 and more, in an even one 0.0006 and less.
_LEAST_SHARE = 0.001
# Part of the points that must have a normal for these to tell of which direction nothing is seen.
_MOST = 0.8
# Information, of radians or metres, that keeps a motion where it is.
_HELD = 1e8


@dataclass(frozen=True, eq=False)
class Expected:
    """The motion if it goes on as before.

    Attributes:
        T_prev_curr: (4, 4).
        covariance: (6, 6) of a change from the left, rotation first.
    """

    T_prev_curr: FloatArray
    covariance: FloatArray


def find_degeneracy(information: FloatArray, count: int, lever_m: float) -> Degeneracy:
    """Find the directions along which pairs of points and planes do not hold the sensor.

    Args:
        information: (6, 6) sum over the pairs, rotation first, a pair that is felt fully counting for 1 per m^2.
        count: of the pairs.
        lever_m: typical distance of the points.
    """
    scale = lever_scale(lever_m)
    shares, axes = np.linalg.eigh(information / np.outer(scale, scale) / max(count, 1))
    return Degeneracy(np.ascontiguousarray(axes[:, shares < _LEAST_SHARE].T), lever_m)


def left_open(information: FloatArray, count: int, images: SweepImages) -> Degeneracy:
    """What the points with a normal leave open, if they are most of what is seen; else nothing, as far as is known.

    Among leaves and wires most points have no normal, and a network that sees these as well knows more.

    Args:
        information, count: as in `find_degeneracy`.
        images: of the sweep.
    """
    if images.share_with_normal() < _MOST:
        return Degeneracy(np.empty((0, 6)), 1.0)
    return find_degeneracy(information, count, images.median_range_m())


def gone_on(T_prev_curr: FloatArray, expected: FloatArray, degeneracy: Degeneracy) -> FloatArray:
    """A motion (4, 4) with its part along the open directions replaced by that of the expected one."""
    along = degeneracy.part_along() @ log(expected @ inverse(T_prev_curr))
    return np.asarray(exp(along) @ T_prev_curr, dtype=np.float64)


def holding(degeneracy: Degeneracy) -> FloatArray:
    """(6, 6) information that leaves nothing to be changed along the open directions, and all across them."""
    return _HELD * degeneracy.projector()


def joined_information(seen: FloatArray, expected: FloatArray, degeneracy: Degeneracy) -> FloatArray:
    """Information (6, 6): along the open directions that of an expectation with this covariance, else what is seen."""
    D = degeneracy.rows
    across = np.eye(6) - degeneracy.part_along()
    return np.asarray(across.T @ seen @ across + D.T @ np.linalg.solve(D @ expected @ D.T, D), dtype=np.float64)
