"""Laying one range image on another from a first guess: point-to-plane by projection, batched, in torch.

The guess is a network's answer with its covariance, or none. Wherever the two images say nothing of a direction, the
guess is kept: it enters as a measurement like any other.

Sweeps take time, and a gait or a turn that begins bends them. The velocity is taken as changing evenly from the middle
of one sweep to the middle of the other, and the change is estimated together with the motion: twelve unknowns, of which
the change is expected to go on as between the motions before.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from odometry.alignment_config import AlignmentConfig
from odometry.compiled_sums import CompiledSums
from odometry.pair_sums import PairSums, Tally, TorchSums
from odometry.pairing import Movement
from odometry.sweeps import SweepPairs

# A pair whose motion changes by less than this in a step has arrived: rotation in radians, translation in metres.
_ARRIVED = 1e-4
# Part of the best known direction's information that counts as none.
_NEXT_TO_NOTHING = 0.02
# Part of a scan that another must have in view for the two to tell.
_MUCH_IN_VIEW = 0.5
# Information that keeps the normal equations solvable where neither the images nor a guess say anything.
_LEAST_INFORMATION = 1e-3


@dataclass(frozen=True, eq=False)
class Aligned:
    """Where images lie on others.

    Attributes:
        T_prev_curr: (B, 4, 4) from the middle of the current sweep to the middle of the previous one.
        bend: (B, 6) velocity in the middle of the current sweep less the mean between the two middles, rotation first,
            in radians and metres a second; in the middle of the previous sweep it is as much below the mean.
        information: (B, 6, 6) of the images alone, rotation first, for a change of `T_prev_curr` from the left, if
            points scattered independently by 1 m about their planes; divide by their variance. What not knowing the
            bend takes away is taken away.
        share: (B,) of the points with a normal that lie on the other image.
        explained: (B,) of what the current scan's points in view of the other image say about the direction of
            translation that fares worst, the part said by those that lie on it. Most of a street looks the same a
            metre on, and lies well on itself; what would tell does not. 1 where nothing would tell.
        weakest: (B, 3) that direction, unit, in the previous frame.
        residual_m: (B,) root mean square distance of those from the planes.
        matched: (B,) how many they are.
    """

    T_prev_curr: Tensor
    bend: Tensor
    information: Tensor
    share: Tensor
    explained: Tensor
    weakest: Tensor
    residual_m: Tensor
    matched: Tensor


@dataclass(frozen=True, eq=False)
class _State:
    """The unknowns: the motions (B, 4, 4), and the bends (B, 6) beyond the expected ones."""

    T_prev_curr: FloatArray
    surprise: FloatArray


@dataclass(frozen=True, eq=False)
class _Guess:
    """Motions (B, 4, 4) and the information (B, 6, 6) about them and their bends, for a change from the left; None: not
    to be kept.
    """

    T_prev_curr: FloatArray
    information: FloatArray | None
    bend_information: FloatArray | None


@dataclass(frozen=True, eq=False)
class _Before:
    """What sets the pace: intervals (B,), and the velocities (B, 6) and intervals (B,) of the motions before, or None.

    So few numbers that NumPy is several times as fast with them as torch.
    """

    interval_s: FloatArray
    last_velocity: FloatArray | None
    last_interval_s: FloatArray | None

    @classmethod
    def of(cls, sweeps: SweepPairs) -> "_Before":
        last = sweeps.last
        known = (None, None) if last is None else (_array(last.velocity), _array(last.interval_s))
        return cls(_array(sweeps.interval_s), *known)

    def movement(self, state: _State) -> Movement:
        """The change of velocity goes on as before, but for the surprise."""
        velocity = log(state.T_prev_curr) / self.interval_s[:, None]
        bend = state.surprise
        if self.last_velocity is not None and self.last_interval_s is not None:
            share = self.interval_s / (self.interval_s + self.last_interval_s)
            bend = bend + share[:, None] * (velocity - self.last_velocity)
        return Movement(state.T_prev_curr, velocity, bend)


@torch.no_grad()
def align(
    T_prev_curr: Tensor,
    sweeps: SweepPairs,
    config: AlignmentConfig,
    guess_information: Tensor | None = None,
    bend_information: Tensor | None = None,
) -> Aligned:
    """Refine motions (B, 4, 4) so that the current images lie on the previous ones.

    Gauss-Newton on point-to-plane distances with Geman-McClure weights whose scale shrinks from step to step.

    Args:
        T_prev_curr: (B, 4, 4) first guesses, between the middles of the sweeps.
        sweeps: B pairs, with normals.
        config: how.
        guess_information: (B, 6, 6) inverse covariance of the guesses, for a change from the left; None: they are
            only where to start from.
        bend_information: (B, 6, 6) what is known of the bend beyond that it mostly goes on as before; None: nothing.
    """
    guess = _Guess(_array(T_prev_curr), _array_or_none(guess_information), _array_or_none(bend_information))
    before, sums = _Before.of(sweeps), _sums_over(sweeps, config)
    state = _State(guess.T_prev_curr, np.zeros((len(guess.T_prev_curr), 6)))
    for done in np.linspace(0.0, 1.0, config.iterations).tolist():
        scale_m = config.coarse_m * (config.fine_m / config.coarse_m) ** min(1.0, done / config.anneal_share)
        H, g = sums.normal_equations(before.movement(state), scale_m)
        state, moved = _step(state, H, g, guess, config)
        if done >= config.anneal_share and moved < _ARRIVED:
            break
    movement = before.movement(state)
    return _judge(movement, sums.tally(movement), config, T_prev_curr)


def _array(values: Tensor) -> FloatArray:
    return np.ascontiguousarray(values.double().numpy(force=True))


def _array_or_none(values: Tensor | None) -> FloatArray | None:
    return None if values is None else _array(values)


def _sums_over(sweeps: SweepPairs, config: AlignmentConfig) -> PairSums:
    on_processor = sweeps.current.points.device.type == "cpu" and sweeps.current.points.dtype == torch.float32
    return CompiledSums(sweeps, config) if on_processor else TorchSums(sweeps, config)


def _step(state: _State, H: FloatArray, g: FloatArray, guess: _Guess, config: AlignmentConfig) -> tuple[_State, float]:
    """One Gauss-Newton step, and by how much it moved the pair it moved most."""
    H, g = config.information_per_m2 * H, config.information_per_m2 * g
    expected = _expected(config) + (0.0 if guess.bend_information is None else guess.bend_information)
    H[:, 6:, 6:] += expected
    g[:, 6:] += (expected @ state.surprise[..., None])[..., 0]
    if guess.information is not None:
        away = log(state.T_prev_curr @ inverse(guess.T_prev_curr))
        H[:, :6, :6] += guess.information
        g[:, :6] += (guess.information @ away[..., None])[..., 0]
    H += _LEAST_INFORMATION * np.eye(12)
    delta = -np.linalg.solve(H, g[..., None])[..., 0]
    step, change = delta[:, :6], delta[:, 6:]
    largest = np.abs(step).max(axis=1, keepdims=True)
    step = step * (config.largest_step / np.maximum(largest, config.largest_step))
    return _State(exp(step) @ state.T_prev_curr, state.surprise + change), float(np.abs(step).max())


def _expected(config: AlignmentConfig) -> FloatArray:
    """(6, 6) inverse covariance of the surprise."""
    return np.diag([config.surprise_rad_s**-2.0] * 3 + [config.surprise_m_s**-2.0] * 3)


def _judge(movement: Movement, tally: Tally, config: AlignmentConfig, like: Tensor) -> Aligned:
    """How well the images lie on one another in the end; in tensors of another's kind."""
    # What leaves the other image's view on the way says nothing, unless it is most of the scan.
    explained, weakest = _explained(tally.in_view, tally.matched)
    explained = explained * np.minimum(tally.share_in_view / _MUCH_IN_VIEW, 1.0)
    residual_m = np.sqrt(tally.squares / np.maximum(tally.count, 1))
    return Aligned(
        T_prev_curr=torch.from_numpy(movement.T_prev_curr).to(like),
        bend=torch.from_numpy(movement.bend).to(like),
        information=torch.from_numpy(_information(tally.H, config)).to(like),
        share=torch.from_numpy(tally.share).to(like),
        explained=torch.from_numpy(explained).to(like),
        weakest=torch.from_numpy(weakest).to(like),
        residual_m=torch.from_numpy(residual_m).to(like),
        matched=torch.from_numpy(tally.count).to(like.device),
    )


def _information(H: FloatArray, config: AlignmentConfig) -> FloatArray:
    """(B, 6, 6) about the motion: what is left of it when the bend is not known, by Schur's complement."""
    across, bends = H[:, :6, 6:], H[:, 6:, 6:] + _expected(config) / config.information_per_m2
    return np.asarray(H[:, :6, :6] - across @ np.linalg.solve(bends, np.swapaxes(across, 1, 2)))


def _explained(everything: FloatArray, matched: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least ratio (B,), over directions (B, 3), of the information of points that lie well to that of all in view.

    The smallest generalised eigenvalue of the two sums (B, 3, 3) of squared normals. To both a little is added, so that
    directions of which hardly any point says anything do not count as missed.
    """
    largest = np.maximum(np.diagonal(everything, axis1=1, axis2=2).max(axis=1), 1.0)
    little = (_NEXT_TO_NOTHING * largest)[:, None, None] * np.eye(3)
    root = np.linalg.cholesky(everything + little)
    half = np.linalg.solve(root, matched + little)
    ratio, vectors = np.linalg.eigh(np.linalg.solve(root, np.swapaxes(half, 1, 2)))
    weakest = np.linalg.solve(np.swapaxes(root, 1, 2), vectors[:, :, :1])[:, :, 0]
    return ratio[:, 0], np.asarray(weakest / np.linalg.norm(weakest, axis=1, keepdims=True))
