"""Gauss-Newton descent of an alignment in one compiled loop: called step by step, it would wait for the interpreter."""

from typing import NamedTuple

import numpy as np

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from lidarslam.odometry.alignment.correspondences import Motion, Planes
from lidarslam.odometry.alignment.residuals import accumulate
from lidarslam.odometry.alignment.steps import UNKNOWNS, take_step, write_velocities
from lidarslam.odometry.images.projection import Floats

# Standard deviation of points about their planes, and the share of points with independent errors: neighbours share
# theirs. Together the information of one point, 1/m^2.
_RESIDUAL_M, _INDEPENDENT = 0.03, 0.05
INFORMATION_PER_M2 = _INDEPENDENT / _RESIDUAL_M**2
# A motion that changes by less than this in a step has converged: radians and metres.
_CONVERGED = 1e-4


class Expectation(NamedTuple):
    """What is known of the motion beside the images."""

    T_curr_prev: FloatArray  # (4, 4) inverse of the prior's motion
    information: FloatArray  # (6, 6) of a change from it
    innovation: FloatArray  # (6, 6) information of the change of velocity being as expected
    interval_s: float  # between the middles of the sweeps
    # share, velocity: the change of velocity goes on as that from this last velocity (6,), by this share
    share: float
    velocity: FloatArray


@compiled
def descend(
    points: Floats, count: int, planes: Planes, expectation: Expectation, scales: FloatArray, patience: int,
    T: FloatArray, innovation: FloatArray,
) -> None:  # fmt: skip
    """Move T_prev_curr (4, 4) and the innovation (6,) of the change of velocity by Gauss-Newton steps, in place.

    Args:
        points, count, planes: as for `accumulate`.
        expectation: the prior.
        scales: (S,) of the robust weights, metres, one for each step.
        patience: how many steps are taken even if the motion has converged.
        T, innovation: see above.
    """
    early, late, total = np.empty(6), np.empty(6), np.empty((UNKNOWNS + 1, UNKNOWNS + 1))
    H, g, unused = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), np.empty((3, 3))
    known = expectation
    for step in range(len(scales)):
        write_velocities(T, innovation, known.interval_s, known.share, known.velocity, early, late)
        total[:, :] = 0.0
        accumulate(points, count, planes, Motion(T, early, late), scales[step], True, total, unused, unused)
        for i in range(UNKNOWNS):
            g[i] = INFORMATION_PER_M2 * total[i, UNKNOWNS]
            for j in range(UNKNOWNS):
                H[i, j] = INFORMATION_PER_M2 * total[i, j]
        largest = take_step(T, innovation, H, g, known.T_curr_prev, known.information, known.innovation)
        if step >= patience and largest < _CONVERGED:
            break
