"""Laying one range image on another from a first guess: point-to-plane by projection, batched, in torch.

The guess is a network's answer with its covariance, or none. Wherever the two images say nothing of a direction, the
guess is kept: it enters as a measurement like any other.

Sweeps take time, and a gait or a turn that begins bends them. The velocity is taken as changing evenly from the middle
of one sweep to the middle of the other, and the change is estimated together with the motion: twelve unknowns, of which
the change is expected to go on as between the motions before.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from lidarslam.core import geometry
from odometry.alignment_config import AlignmentConfig
from odometry.compiled_sums import CompiledSums
from odometry.pair_sums import PairSums, Tally, TorchSums
from odometry.pairing import Movement
from odometry.sweeps import SweepPairs
from odometry.torch_geometry import inverse

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
    """The unknowns: the motion (B, 4, 4), and the bend (B, 6) beyond the expected one."""

    T_prev_curr: Tensor
    surprise: Tensor


@torch.no_grad()
def align(
    T_prev_curr: Tensor, sweeps: SweepPairs, config: AlignmentConfig, guess_information: Tensor | None = None
) -> Aligned:
    """Refine motions (B, 4, 4) so that the current images lie on the previous ones.

    Gauss-Newton on point-to-plane distances with Geman-McClure weights whose scale shrinks from step to step.

    Args:
        T_prev_curr: (B, 4, 4) first guesses, between the middles of the sweeps.
        sweeps: B pairs, with normals.
        config: how.
        guess_information: (B, 6, 6) inverse covariance of the guesses, for a change from the left; None: they are
            only where to start from.
    """
    state = _State(T_prev_curr, T_prev_curr.new_zeros(len(T_prev_curr), 6))
    sums = _sums_over(sweeps, config)
    for done in torch.linspace(0.0, 1.0, config.iterations).tolist():
        scale_m = config.coarse_m * (config.fine_m / config.coarse_m) ** min(1.0, done / config.anneal_share)
        H, g = sums.normal_equations(_movement(state, sweeps), scale_m)
        state, moved = _step(state, H, g, T_prev_curr, guess_information, config)
        if done >= config.anneal_share and moved < _ARRIVED:
            break
    movement = _movement(state, sweeps)
    return _judge(movement, sums.tally(movement), config)


def _sums_over(sweeps: SweepPairs, config: AlignmentConfig) -> PairSums:
    on_processor = sweeps.current.points.device.type == "cpu" and sweeps.current.points.dtype == torch.float32
    return CompiledSums(sweeps, config) if on_processor else TorchSums(sweeps, config)


def _movement(state: _State, sweeps: SweepPairs) -> Movement:
    """The change of velocity goes on as before, but for the surprise."""
    velocity = _log(state.T_prev_curr) / sweeps.interval_s[:, None]
    bend = state.surprise
    if sweeps.last is not None:
        share = sweeps.interval_s / (sweeps.interval_s + sweeps.last.interval_s)
        bend = bend + share[:, None] * (velocity - sweeps.last.velocity)
    return Movement(state.T_prev_curr, velocity, bend)


def _step(
    state: _State,
    H: Tensor,
    g: Tensor,
    guess: Tensor,
    guess_information: Tensor | None,
    config: AlignmentConfig,
) -> tuple[_State, float]:
    """One Gauss-Newton step, and by how much it moved the pair it moved most."""
    H, g = config.information_per_m2 * H, config.information_per_m2 * g
    expected = _expected(config, H)
    H[:, 6:, 6:] += expected
    g[:, 6:] += state.surprise.double() @ expected
    if guess_information is not None:
        away = _log(state.T_prev_curr @ inverse(guess))
        H[:, :6, :6] += guess_information
        g[:, :6] += (guess_information @ away[..., None])[..., 0]
    H += _LEAST_INFORMATION * torch.eye(12, dtype=H.dtype, device=H.device)
    delta = -torch.linalg.solve(H, g[..., None])[..., 0].to(guess.dtype)
    step, change = delta[:, :6], delta[:, 6:]
    step = step * (config.largest_step / step.abs().amax(-1, keepdim=True).clamp(min=config.largest_step))
    return _State(_exp(step) @ state.T_prev_curr, state.surprise + change), float(step.abs().max())


def _log(T: Tensor) -> Tensor:
    """Twists (B, 6) of motions (B, 4, 4); of so few, NumPy is several times as fast as torch."""
    return torch.from_numpy(geometry.log(T.double().numpy(force=True))).to(T)


def _exp(twist: Tensor) -> Tensor:
    """Motions (B, 4, 4) of twists (B, 6)."""
    return torch.from_numpy(geometry.exp(twist.double().numpy(force=True))).to(twist)


def _expected(config: AlignmentConfig, like: Tensor) -> Tensor:
    """(6, 6) inverse covariance of the surprise."""
    sigmas = like.new_tensor([config.surprise_rad_s] * 3 + [config.surprise_m_s] * 3)
    return torch.diag(sigmas**-2)


def _judge(movement: Movement, tally: Tally, config: AlignmentConfig) -> Aligned:
    """How well the images lie on one another in the end."""
    # What leaves the other image's view on the way says nothing, unless it is most of the scan.
    explained, weakest = _explained(tally.in_view, tally.matched)
    explained = explained * (tally.share_in_view / _MUCH_IN_VIEW).clamp(max=1.0)
    residual_m = (tally.squares / tally.count.clamp(min=1)).sqrt()
    T, information = movement.T_prev_curr, _information(tally.H, config).to(movement.T_prev_curr.dtype)
    return Aligned(T, movement.bend, information, tally.share, explained, weakest, residual_m, tally.count)


def _information(H: Tensor, config: AlignmentConfig) -> Tensor:
    """(B, 6, 6) about the motion: what is left of it when the bend is not known, by Schur's complement."""
    across, bends = H[:, :6, 6:], H[:, 6:, 6:] + _expected(config, H) / config.information_per_m2
    left: Tensor = H[:, :6, :6] - across @ torch.linalg.solve(bends, across.mT)
    return left


def _explained(everything: Tensor, matched: Tensor) -> tuple[Tensor, Tensor]:
    """The least ratio (B,), over directions (B, 3), of the information of points that lie well to that of all in view.

    The smallest generalised eigenvalue of the two sums (B, 3, 3) of squared normals. To both a little is added, so that
    directions of which hardly any point says anything do not count as missed.
    """
    largest = everything.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=1.0)
    little = (_NEXT_TO_NOTHING * largest)[:, None, None] * torch.eye(
        3, dtype=everything.dtype, device=everything.device
    )
    root = torch.linalg.cholesky((everything + little).double())
    half = torch.linalg.solve_triangular(root, (matched + little).double(), upper=False)
    ratio, vectors = torch.linalg.eigh(torch.linalg.solve_triangular(root, half.mT, upper=False))
    weakest = torch.linalg.solve_triangular(root.mT, vectors[..., :1], upper=True)[..., 0]
    return ratio[:, 0].to(everything.dtype), torch.nn.functional.normalize(weakest, dim=-1).to(everything.dtype)
