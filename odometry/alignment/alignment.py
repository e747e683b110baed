"""Projective point-to-plane alignment of two sweeps, with an initial estimate as a prior.

Gauss-Newton with robust weights. The initial estimate is a network's answer with its covariance, or none. Along
directions that the images do not constrain it is kept: it enters as a measurement like any other.

Sweeps take time, and a gait or the beginning of a turn bends them. Acceleration is taken as constant from the middle of
one sweep to the middle of the other, and the change of velocity is estimated with the motion: twelve unknowns, of which
the change is expected to go on as between the motions before.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.odometry.alignment.correspondences import Motion
from lidarslam.odometry.alignment.point_to_plane import FINE_M, Fit, PointToPlane
from lidarslam.odometry.alignment.steps import take_step, write_velocities
from lidarslam.odometry.alignment.sweep_motion import SweepPair

# Scale of the robust weights in the first step; it shrinks to the finest over this part of the steps.
_COARSE_M = 0.5
_ANNEALED = 0.5
# A motion that changes by less than this in a step has converged: radians and metres.
_CONVERGED = 1e-4
# Standard deviation of points about their planes, and the share of points with independent errors: neighbours share
# theirs. Together the information of one point, 1/m^2.
_RESIDUAL_M, _INDEPENDENT = 0.03, 0.05
INFORMATION_PER_M2 = _INDEPENDENT / _RESIDUAL_M**2
# Standard deviations of the change of velocity within a pair of sweeps about the expected one, rad/s and m/s.
INNOVATION_RAD_S, INNOVATION_M_S = 0.3, 0.5
# Part of the largest information that counts as none.
_NEGLIGIBLE = 0.02
# Part of a prior's information that stands for none, along directions that it leaves open.
_NEGLIGIBLE_PRIOR = 1e-9
# Part of a scan that another must have in view for what is not in view to be left out.
_MOSTLY_IN_VIEW = 0.5


class Effort(NamedTuple):
    """How many Gauss-Newton steps at most, and every how-manieth column's points."""

    iterations: int = 8
    column_step: int = 3


NORMAL = Effort()


@dataclass(frozen=True, eq=False)
class InitialEstimate:
    """Where alignment begins."""

    T_prev_curr: FloatArray  # (4, 4) between the middles of the sweeps
    # (6, 6) inverse covariance, for a change from the left; None: it is only where to start from. It counts along the
    # directions of which the images have less.
    information: FloatArray | None = None
    # (6, 6) that holds the change of velocity at the expected one; None: no more than usual
    change_information: FloatArray | None = None
    sigmas: float = 0.0  # how much less likely it is than the first initial estimate, in standard deviations


@dataclass(frozen=True, eq=False)
class Alignment:
    """An image aligned with another."""

    T_prev_curr: FloatArray  # (4, 4) from the middle of the current sweep to the middle of the previous one
    # (6,) velocity in the middle of the current sweep above the mean between the two middles, rotation first, in
    # radians and metres a second; in the middle of the previous sweep it is as much below
    velocity_change: FloatArray
    # (6, 6) of the images alone, for a change of `T_prev_curr` from the left, rotation first, if points scattered
    # independently by 1 m about their planes; the change of velocity is marginalised
    information: FloatArray
    prior_information: FloatArray  # (6, 6) of the initial estimate, along the directions in which it counts
    inlier_share: float  # of the points with a normal
    # ratio of the information of inliers to that of all points in view, along the direction of translation where it is
    # least. Most of a street looks the same a metre on, and a wrong motion has many inliers; the points that constrain
    # the motion are not among them. 1 where no point constrains it.
    explained: float
    weakest: FloatArray  # (3,) that direction, unit, in the previous frame
    residual_m: float  # root mean square of the inliers
    inliers: int  # how many


def align(start: InitialEstimate, sweeps: SweepPair, effort: Effort = NORMAL) -> Alignment:
    """Gauss-Newton on point-to-plane distances, with Geman-McClure weights whose scale shrinks from step to step."""
    return align_each([start], sweeps, effort)[0]


def align_each(starts: Sequence[InitialEstimate], sweeps: SweepPair, effort: Effort = NORMAL) -> list[Alignment]:
    """As `align`, from each of several initial estimates."""
    cost = PointToPlane(sweeps, effort.column_step)
    return [_align(start, sweeps, cost, effort.iterations) for start in starts]


def _align(start: InitialEstimate, sweeps: SweepPair, cost: PointToPlane, iterations: int) -> Alignment:
    T_prev_curr, innovation = np.array(start.T_prev_curr, dtype=np.float64), np.zeros(6)
    T_curr_prev, prior, is_seen = inverse(start.T_prev_curr), start.information, start.information is None
    information, expected = np.zeros((6, 6)) if prior is None else prior, _innovation_information()
    if start.change_information is not None:
        expected = expected + start.change_information
    # Arrays of another layout would be compiled for anew.
    information, expected = np.ascontiguousarray(information), np.ascontiguousarray(expected)
    for done in np.linspace(0.0, 1.0, iterations).tolist():
        scale_m = _COARSE_M * (FINE_M / _COARSE_M) ** min(1.0, done / _ANNEALED)
        H, g = cost.normal_equations(_motion(T_prev_curr, innovation, sweeps), scale_m)
        H, g = INFORMATION_PER_M2 * H, INFORMATION_PER_M2 * g
        if done >= _ANNEALED and not is_seen:
            information, is_seen = _where_unseen(information, _marginal(H, INFORMATION_PER_M2)), True
        largest = take_step(T_prev_curr, innovation, H, g, T_curr_prev, information, expected)
        if done >= _ANNEALED and largest < _CONVERGED:
            break
    motion = _motion(T_prev_curr, innovation, sweeps)
    return _alignment(T_prev_curr, 0.5 * (motion.late - motion.early), cost.fit(motion), information)


def _motion(T_prev_curr: FloatArray, innovation: FloatArray, sweeps: SweepPair) -> Motion:
    """The motion, whose change of velocity goes on as before but for the innovation."""
    early, late, last, share = np.empty(6), np.empty(6), innovation, 0.0
    if sweeps.last is not None:
        last, share = sweeps.last.velocity, sweeps.interval_s / (sweeps.interval_s + sweeps.last.interval_s)
    write_velocities(T_prev_curr, innovation, sweeps.interval_s, share, last, early, late)
    return Motion(T_prev_curr, early, late)


def _innovation_information() -> FloatArray:
    return np.diag([INNOVATION_RAD_S**-2.0] * 3 + [INNOVATION_M_S**-2.0] * 3)


def _where_unseen(prior: FloatArray, seen: FloatArray) -> FloatArray:
    """(6, 6) the part of a prior's information (6, 6) along directions in which the images' (6, 6) is less.

    The network's errors are not independent from scan to scan: it takes small translations for smaller ones. Where the
    images decide, even a small share of it would add up to a drift.
    """
    root, ratios, axes = _compared(seen, prior + _NEGLIGIBLE_PRIOR * prior.trace() * np.eye(6))
    kept = root @ axes[:, ratios < 1.0]
    return np.asarray(kept @ kept.T)


def _compared(one: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The generalised eigenvalues of two symmetric matrices, ascending, by the Cholesky factor L of the other.

    Returns:
        L, the ratios x one x / x other x, and as columns the unit vectors L' x along which they are taken.
    """
    root = np.linalg.cholesky(other)
    half = np.linalg.inv(root)
    ratios, axes = np.linalg.eigh(half @ one @ half.T)
    return np.asarray(root, dtype=np.float64), ratios, axes


def _alignment(T_prev_curr: FloatArray, change: FloatArray, fit: Fit, prior: FloatArray) -> Alignment:
    explained, weakest = _explained(fit.in_view, fit.inlier)
    return Alignment(
        T_prev_curr=T_prev_curr,
        velocity_change=change,
        information=_marginal(fit.H, 1.0),
        prior_information=prior,
        inlier_share=fit.inlier_share,
        # Points that leave the other image's view do not count, unless they are most of the scan.
        explained=explained * min(fit.share_in_view / _MOSTLY_IN_VIEW, 1.0),
        weakest=weakest,
        residual_m=float(np.sqrt(fit.squared_residuals / max(fit.inliers, 1))),
        inliers=fit.inliers,
    )


def _marginal(H: FloatArray, per_m2: float) -> FloatArray:
    """(6, 6) information of the motion, with the change of velocity marginalised by Schur's complement.

    H (12, 12) is in units of `per_m2`.
    """
    expected = (per_m2 / INFORMATION_PER_M2) * _innovation_information()
    across, changes = H[:6, 6:], H[6:, 6:] + expected
    return np.asarray(H[:6, :6] - across @ np.linalg.solve(changes, across.T), dtype=np.float64)


def _explained(in_view: FloatArray, inlier: FloatArray) -> tuple[float, FloatArray]:
    """The least ratio, over directions (3,), of the information of inliers to that of all in view.

    The smallest generalised eigenvalue of the two sums (3, 3) of squared normals. To both a little is added, so that
    directions that hardly any point constrains do not count as missed.
    """
    little = _NEGLIGIBLE * max(float(in_view.diagonal().max()), 1.0) * np.eye(3)
    root, ratios, axes = _compared(inlier + little, in_view + little)
    weakest = np.linalg.solve(root.T, axes[:, 0])
    return float(ratios[0]), np.asarray(weakest / np.linalg.norm(weakest), dtype=np.float64)
