"""Laying one range image on another from a first guess: point-to-plane by projection.

The guess is a network's answer with its covariance, or none. Wherever the two images say nothing of a direction, the
guess is kept: it enters as a measurement like any other.

Sweeps take time, and a gait or a turn that begins bends them. The velocity is taken as changing evenly from the middle
of one sweep to the middle of the other, and the change is estimated together with the motion: twelve unknowns, of which
the change is expected to go on as between the motions before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from odometry.alignment.alignment_config import AlignmentConfig
from odometry.alignment.pair_sums import Movement, PairSums, Tally
from odometry.images.sweeps import SweepPair

# A pair whose motion changes by less than this in a step has arrived: rotation in radians, translation in metres.
_ARRIVED = 1e-4
# Part of the best known direction's information that counts as none.
_NEXT_TO_NOTHING = 0.02
# Part of a prior's information that stands for none, along directions that it leaves open.
_NEXT_TO_NO_PRIOR = 1e-9
# Part of a scan that another must have in view for the two to tell.
_MUCH_IN_VIEW = 0.5
# Information that keeps the normal equations solvable where neither the images nor a guess say anything.
_LEAST_INFORMATION = 1e-3


@dataclass(frozen=True, eq=False)
class Guess:
    """A first guess about a motion.

    Attributes:
        T_prev_curr: (4, 4) between the middles of the sweeps.
        information: (6, 6) its inverse covariance, for a change from the left; None: it is only where to start from.
            It counts along the directions of which the images have less.
        bend_information: (6, 6) what is known of the bend beyond that it mostly goes on as before; None: nothing.
        odds: how much less likely it is than the first guess, as a number of standard deviations.
    """

    T_prev_curr: FloatArray
    information: FloatArray | None = None
    bend_information: FloatArray | None = None
    odds: float = 0.0


@dataclass(frozen=True, eq=False)
class Aligned:
    """Where an image lies on another.

    Attributes:
        T_prev_curr: (4, 4) from the middle of the current sweep to the middle of the previous one.
        bend: (6,) velocity in the middle of the current sweep less the mean between the two middles, rotation first,
            in radians and metres a second; in the middle of the previous sweep it is as much below the mean.
        information: (6, 6) of the images alone, rotation first, for a change of `T_prev_curr` from the left, if
            points scattered independently by 1 m about their planes; divide by their variance. What not knowing the
            bend takes away is taken away.
        guess_information: (6, 6) of the guess, along the directions in which it counts.
        share: of the points with a normal that lie on the other image.
        explained: of what the current scan's points in view of the other image say about the direction of
            translation that fares worst, the part said by those that lie on it. Most of a street looks the same a
            metre on, and lies well on itself; what would tell does not. 1 where nothing would tell.
        weakest: (3,) that direction, unit, in the previous frame.
        residual_m: root mean square distance of those from the planes.
        matched: how many they are.
    """

    T_prev_curr: FloatArray
    bend: FloatArray
    information: FloatArray
    guess_information: FloatArray
    share: float
    explained: float
    weakest: FloatArray
    residual_m: float
    matched: int


@dataclass(frozen=True, eq=False)
class _State:
    """The unknowns: the motion (4, 4), and the bend (6,) beyond the expected one."""

    T_prev_curr: FloatArray
    surprise: FloatArray


def align(guess: Guess, sweeps: SweepPair, config: AlignmentConfig) -> Aligned:
    """Refine a motion so that the current image lies on the previous one.

    Gauss-Newton on point-to-plane distances with Geman-McClure weights whose scale shrinks from step to step.
    """
    return align_each([guess], sweeps, config)[0]


def align_each(guesses: Sequence[Guess], sweeps: SweepPair, config: AlignmentConfig) -> list[Aligned]:
    """As `align`, from each of several guesses."""
    sums = PairSums(sweeps, config)
    return [_align(guess, sweeps, sums, config) for guess in guesses]


def _align(guess: Guess, sweeps: SweepPair, sums: PairSums, config: AlignmentConfig) -> Aligned:
    state, kept = _State(guess.T_prev_curr, np.zeros(6)), guess
    for done in np.linspace(0.0, 1.0, config.iterations).tolist():
        scale_m = config.coarse_m * (config.fine_m / config.coarse_m) ** min(1.0, done / config.anneal_share)
        H, g = sums.normal_equations(_movement(state, sweeps), scale_m)
        if done >= config.anneal_share and kept is guess and guess.information is not None:
            seen = config.information_per_m2 * _information(H, config)
            kept = replace(guess, information=_where_unseen(guess.information, seen))
        state, moved = _step(state, H, g, kept, config)
        if done >= config.anneal_share and moved < _ARRIVED:
            break
    movement = _movement(state, sweeps)
    counted = np.zeros((6, 6)) if kept.information is None else kept.information
    return _judge(movement, sums.tally(movement), counted, config)


def _where_unseen(prior: FloatArray, seen: FloatArray) -> FloatArray:
    """(6, 6) the part of a guess's information (6, 6) along directions in which the images' (6, 6) is less.

    The network's errors are not independent from scan to scan: it takes small translations for smaller ones. Where the
    images decide, even a small share of it would add up to a drift.
    """
    root, ratios, axes = _ratios(seen, prior + _NEXT_TO_NO_PRIOR * np.trace(prior) * np.eye(6))
    kept = root @ axes[:, ratios < 1.0]
    return np.asarray(kept @ kept.T)


def _movement(state: _State, sweeps: SweepPair) -> Movement:
    """The change of velocity goes on as before, but for the surprise."""
    velocity, bend, last = log(state.T_prev_curr) / sweeps.interval_s, state.surprise, sweeps.last
    if last is not None:
        share = sweeps.interval_s / (sweeps.interval_s + last.interval_s)
        bend = bend + share * (velocity - last.velocity)
    return Movement(state.T_prev_curr, velocity, bend)


def _step(state: _State, H: FloatArray, g: FloatArray, guess: Guess, config: AlignmentConfig) -> tuple[_State, float]:
    """One Gauss-Newton step, and by how much it moved."""
    H, g = config.information_per_m2 * H, config.information_per_m2 * g
    expected = _expected(config)
    if guess.bend_information is not None:
        expected = expected + guess.bend_information
    H[6:, 6:] += expected
    g[6:] += expected @ state.surprise
    if guess.information is not None:
        away = log(state.T_prev_curr @ inverse(guess.T_prev_curr))
        H[:6, :6] += guess.information
        g[:6] += guess.information @ away
    H.flat[::13] += _LEAST_INFORMATION
    delta = -np.linalg.solve(H, g)
    step, change = delta[:6], delta[6:]
    step = step * (config.largest_step / max(float(np.abs(step).max()), config.largest_step))
    return _State(exp(step) @ state.T_prev_curr, state.surprise + change), float(np.abs(step).max())


def _expected(config: AlignmentConfig) -> FloatArray:
    """(6, 6) inverse covariance of the surprise."""
    return np.diag([config.surprise_rad_s**-2.0] * 3 + [config.surprise_m_s**-2.0] * 3)


def _judge(movement: Movement, tally: Tally, guess_information: FloatArray, config: AlignmentConfig) -> Aligned:
    """How well the images lie on one another in the end."""
    explained, weakest = _explained(tally.in_view, tally.matched)
    return Aligned(
        T_prev_curr=movement.T_prev_curr,
        bend=movement.bend,
        information=_information(tally.H, config),
        guess_information=guess_information,
        share=tally.share,
        # What leaves the other image's view on the way says nothing, unless it is most of the scan.
        explained=explained * min(tally.share_in_view / _MUCH_IN_VIEW, 1.0),
        weakest=weakest,
        residual_m=float(np.sqrt(tally.squares / max(tally.count, 1))),
        matched=tally.count,
    )


def _information(H: FloatArray, config: AlignmentConfig) -> FloatArray:
    """(6, 6) about the motion: what is left of it when the bend is not known, by Schur's complement."""
    across, bends = H[:6, 6:], H[6:, 6:] + _expected(config) / config.information_per_m2
    return np.asarray(H[:6, :6] - across @ np.linalg.solve(bends, across.T), dtype=np.float64)


def _explained(everything: FloatArray, matched: FloatArray) -> tuple[float, FloatArray]:
    """The least ratio, over directions (3,), of the information of points that lie well to that of all in view.

    The smallest generalised eigenvalue of the two sums (3, 3) of squared normals. To both a little is added, so that
    directions of which hardly any point says anything do not count as missed.
    """
    little = _NEXT_TO_NOTHING * max(float(everything.diagonal().max()), 1.0) * np.eye(3)
    root, ratio, vectors = _ratios(matched + little, everything + little)
    weakest = np.linalg.solve(root.T, vectors[:, 0])
    return float(ratio[0]), np.asarray(weakest / np.linalg.norm(weakest), dtype=np.float64)


def _ratios(part: FloatArray, whole: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Generalised eigenvalues (N,), ascending, of two information matrices (N, N), the second positive definite.

    Returns:
        The Cholesky factor (N, N) of the second, the eigenvalues, and their axes (N, N) as columns, whitened by it.
    """
    root = np.linalg.cholesky(whole)
    half = np.linalg.solve(root, part)
    ratios, axes = np.linalg.eigh(np.linalg.solve(root, half.T))
    return np.asarray(root, dtype=np.float64), np.asarray(ratios, dtype=np.float64), np.asarray(axes, dtype=np.float64)
