"""Projective point-to-plane alignment of two sweeps, with an initial estimate as a prior.

Gauss-Newton with robust weights. The initial estimate is a network's answer with its covariance, or none. Along
directions that the images do not constrain it is kept: it enters as a measurement like any other.

Sweeps take time, and a gait or the beginning of a turn bends them. Acceleration is taken as constant from the middle of
one sweep to the middle of the other, and the change of velocity is estimated with the motion: twelve unknowns, of which
the change is expected to continue as between the motions before.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.core.tracking import Degeneracy, lever_scale
from lidarslam.odometry.alignment.point_to_plane import FINE_M, PairMotion, PointToPlane
from lidarslam.odometry.alignment.steps import take_step, write_velocities
from lidarslam.odometry.alignment.sweep_motion import SweepPair
from lidarslam.odometry.images.sweep_images import SweepImages

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
# Share of the largest information that counts as none.
_NEGLIGIBLE = 0.02
# Share of a prior's information that stands for none, along directions that it leaves open.
_NEGLIGIBLE_PRIOR = 1e-9
# Share of a scan that another must have in view for points out of view to be left out.
_MOSTLY_IN_VIEW = 0.5
# Initial estimates that differ by less than this converge to the same motion.
_ALIKE_RAD, _ALIKE_M = 0.05, 0.5
# An alignment that explains less is unreliable, and steps along its weakest direction are tried, to either side.
DOUBTFUL = 0.45
STEPS_M: tuple[float, ...] = (0.8, 1.6, 2.4, 3.2)
# Least gain in `explained` of another alignment, and for each standard deviation that it is less likely.
_CLEARLY_BETTER = 0.05
# Mean squared Jacobian of the points along a direction, from 0 to about 1. Where the end of a tunnel is in view it is
# 0.002 and more, in an even one 0.0006 and less.
_LEAST_SHARE = 0.001
# Standard deviation of a normal at one metre, radians, by a centimetre of range noise over a patch; it falls with the
# range. Along a direction with no more than this share of it, the constraint is that noise.
_TILT_AT_1_M, _NOISE_FACTOR = 0.09, 1.25
# Among leaves and wires most points have no normal, and a network, which uses these as well, is better constrained than
# alignment: unless this many have one, no direction is taken for degenerate.
_MOST = 0.7


class Effort(NamedTuple):
    """Largest number of Gauss-Newton steps, and stride of the columns whose points are used."""

    iterations: int = 8
    column_step: int = 3


NORMAL = Effort()
# Several initial estimates are aligned roughly first; the best is aligned again.
_ROUGH = Effort(iterations=6, column_step=6)


@dataclass(frozen=True, eq=False)
class InitialEstimate:
    """Initial estimate of an alignment."""

    T_prev_curr: FloatArray  # (4, 4) between the middles of the sweeps
    # (6, 6) inverse covariance, for a change from the left; None: it is only a start. It counts along the
    # directions of which the images have less.
    information: FloatArray | None = None
    # (6, 6) that holds the change of velocity at the expected one; None: the usual one
    change_information: FloatArray | None = None
    sigmas: float = 0.0  # standard deviations by which it is less likely than the likeliest one could be


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
    # ratio of the information of inliers to that of all points in view, along the direction of translation where it is
    # least. Most of a street looks the same a metre on, and a wrong motion has many inliers; the points that constrain
    # the motion are not among them. 1 where no point constrains it.
    explained: float
    weakest: FloatArray  # (3,) that direction, unit, in the previous frame
    inliers: int  # number of points


def align(start: InitialEstimate, sweeps: SweepPair, effort: Effort = NORMAL) -> Alignment:
    """Gauss-Newton on point-to-plane distances, with Geman-McClure weights whose scale shrinks from step to step."""
    return _align(start, sweeps, PointToPlane(sweeps, effort.column_step), effort.iterations)


def _align_roughly(starts: Iterable[FloatArray], sweeps: SweepPair) -> list[Alignment]:
    cost = PointToPlane(sweeps, _ROUGH.column_step)
    return [_align(InitialEstimate(T), sweeps, cost, _ROUGH.iterations) for T in starts]


def _align(start: InitialEstimate, sweeps: SweepPair, cost: PointToPlane, iterations: int) -> Alignment:
    T_prev_curr, innovation = np.array(start.T_prev_curr, dtype=np.float64), np.zeros(6)
    T_curr_prev, prior, is_seen = inverse(start.T_prev_curr), start.information, start.information is None
    information, expected = np.zeros((6, 6)) if prior is None else prior, _innovation_information()
    if start.change_information is not None:
        expected = expected + start.change_information
    # Arrays of another layout would be compiled for again.
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
    fit = cost.fit(motion)
    explained, weakest = _explained(fit.in_view, fit.inlier)
    return Alignment(
        T_prev_curr=T_prev_curr,
        velocity_change=0.5 * (motion.late - motion.early),
        information=_marginal(fit.H, 1.0),
        prior_information=information,
        # Points that leave the other image's view do not count, unless they are most of the scan.
        explained=explained * min(fit.share_in_view / _MOSTLY_IN_VIEW, 1.0),
        weakest=weakest,
        inliers=fit.inliers,
    )


def _motion(T_prev_curr: FloatArray, innovation: FloatArray, sweeps: SweepPair) -> PairMotion:
    """The motion, whose change of velocity continues as before but for the innovation."""
    early, late, last, share = np.empty(6), np.empty(6), innovation, 0.0
    if sweeps.last is not None:
        last, share = sweeps.last.velocity, sweeps.interval_s / (sweeps.interval_s + sweeps.last.interval_s)
    write_velocities(T_prev_curr, innovation, sweeps.interval_s, share, last, early, late)
    return PairMotion(T_prev_curr, early, late)


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


def _marginal(H: FloatArray, per_m2: float) -> FloatArray:
    """(6, 6) information of the motion, with the change of velocity marginalised by Schur's complement.

    H (12, 12) is in units of `per_m2`.
    """
    expected = (per_m2 / INFORMATION_PER_M2) * _innovation_information()
    across, changes = H[:6, 6:], H[6:, 6:] + expected
    return np.asarray(H[:6, :6] - across @ np.linalg.solve(changes, across.T), dtype=np.float64)


def _explained(in_view: FloatArray, inlier: FloatArray) -> tuple[float, FloatArray]:
    """The least ratio, over directions (3,), of the information of inliers to that of all in view.

    The smallest generalised eigenvalue of the two sums (3, 3) of squared normals. A little is added to both, so that
    directions that hardly any point constrains do not count as missed.
    """
    little = _NEGLIGIBLE * max(float(in_view.diagonal().max()), 1.0) * np.eye(3)
    root, ratios, axes = _compared(inlier + little, in_view + little)
    weakest = np.linalg.solve(root.T, axes[:, 0])
    return float(ratios[0]), np.asarray(weakest / np.linalg.norm(weakest), dtype=np.float64)


def align_best(starts: Sequence[InitialEstimate], sweeps: SweepPair, effort: Effort = NORMAL) -> Alignment:
    """The alignment that explains most, from initial estimates, the most likely first.

    Estimates that differ are aligned roughly, and the best of them well; the less likely one is, the more it must
    explain. If that is unreliable, steps along the weakest direction are aligned, too.
    """
    best = align(_choose(starts, sweeps), sweeps, effort)
    if best.explained >= DOUBTFUL or not STEPS_M:
        return best
    moved = np.repeat(best.T_prev_curr[None], 2 * len(STEPS_M), axis=0)
    moved[:, :3, 3] += np.outer(np.outer(STEPS_M, [1.0, -1.0]), best.weakest)  # to either side
    other = try_instead(best, moved, sweeps, effort)
    if other is None or other.explained - best.explained <= _CLEARLY_BETTER * _sigmas_away(other, starts):
        return best
    return other


def try_instead(best: Alignment, starts: Iterable[FloatArray], sweeps: SweepPair, effort: Effort) -> Alignment | None:
    """The alignment from the most promising of many motions (4, 4), if it explains clearly more than the best."""
    rough = max(_align_roughly(starts, sweeps), key=lambda one: one.explained)
    other = align(InitialEstimate(rough.T_prev_curr), sweeps, effort)
    return other if other.explained - best.explained > _CLEARLY_BETTER else None


def _sigmas_away(alignment: Alignment, starts: Sequence[InitialEstimate]) -> float:
    """Mahalanobis distance from the nearest initial estimate; 0 where none has a covariance."""
    certain = [(log(alignment.T_prev_curr @ inverse(one.T_prev_curr)), one.information) for one in starts]
    return min((float(np.sqrt(away @ known @ away)) for away, known in certain if known is not None), default=0.0)


def _choose(starts: Sequence[InitialEstimate], sweeps: SweepPair) -> InitialEstimate:
    """The first, unless another differs from it and explains more than its likelihood requires."""
    first = inverse(starts[0].T_prev_curr)
    away = np.array([log(start.T_prev_curr @ first) for start in starts])
    if (np.linalg.norm(away.reshape(-1, 2, 3), axis=2) < (_ALIKE_RAD, _ALIKE_M)).all():
        return starts[0]
    rough = _align_roughly([start.T_prev_curr for start in starts], sweeps)
    scores = [one.explained - _CLEARLY_BETTER * start.sigmas for one, start in zip(rough, starts, strict=True)]
    return starts[int(np.argmax(scores))]


def find_degeneracy(information: FloatArray, inliers: int, images: SweepImages) -> Degeneracy:
    """Directions that the inliers of an alignment leave open.

    Along an even tunnel the residuals are small for any translation. The remaining gradient is due to the noise of the
    normals, and is biased towards no motion; so is a network's estimate from the same scans.

    Args:
        information: (6, 6) sum over the inliers of squared Jacobians, rotation first.
        inliers: their number.
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
