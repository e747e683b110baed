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
from odometry.pairing import Cloud, Movement, Pairs, filled, pair, sample
from odometry.sweeps import SweepImages, SweepPairs
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
    source = sample(sweeps.current, config.column_step)
    target = filled(sweeps.previous, config.fill_columns)
    for done in torch.linspace(0.0, 1.0, config.iterations).tolist():
        scale_m = config.coarse_m * (config.fine_m / config.coarse_m) ** min(1.0, done / config.anneal_share)
        pairs = pair(_movement(state, sweeps), source, target, scale_m, config)
        state, moved = _step(state, pairs, scale_m, T_prev_curr, guess_information, config)
        if done >= config.anneal_share and moved < _ARRIVED:
            break
    return _judge(_movement(state, sweeps), source, target, config)


def _movement(state: _State, sweeps: SweepPairs) -> Movement:
    """The change of velocity goes on as before, but for the surprise."""
    velocity = _log(state.T_prev_curr) / sweeps.interval_s[:, None]
    bend = state.surprise
    if sweeps.last is not None:
        share = sweeps.interval_s / (sweeps.interval_s + sweeps.last.interval_s)
        bend = bend + share[:, None] * (velocity - sweeps.last.velocity)
    return Movement(state.T_prev_curr, velocity, bend)


def _normal_equations(pairs: Pairs, weights: Tensor) -> tuple[Tensor, Tensor]:
    """H (B, 12, 12) and g (B, 12) of the weighted squares, for changes of T_prev_curr from the left and of the bend.

    A point that is seen t seconds after the middle of its sweep, on a pixel seen t' after that of its own, moves with
    the bend (t + t') times as it does with the motion.
    """
    J = torch.cat([torch.linalg.cross(pairs.moved, pairs.normals), pairs.normals], dim=-1)  # (B, N, 6)
    J = torch.cat([J, J * pairs.offsets_s[..., None]], dim=-1)
    weighted = J * weights[..., None]
    return weighted.mT @ J, (weighted.mT @ pairs.residuals[..., None])[..., 0]


def _step(
    state: _State,
    pairs: Pairs,
    scale_m: float,
    guess: Tensor,
    guess_information: Tensor | None,
    config: AlignmentConfig,
) -> tuple[_State, float]:
    """One Gauss-Newton step, and by how much it moved the pair it moved most."""
    squared = pairs.residuals.square() / scale_m**2
    H, g = _normal_equations(pairs, config.information_per_m2 * pairs.kept / (1.0 + squared).square())
    # In float32 what a guess says would be lost beside what the images say of other directions.
    H, g = H.double(), g.double()
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


def _judge(movement: Movement, source: Cloud, target: SweepImages, config: AlignmentConfig) -> Aligned:
    """How well the images lie on one another in the end."""
    T = movement.T_prev_curr
    pairs = pair(movement, source, target, config.fine_m, config)
    near = pairs.kept & (pairs.residuals.abs() < 2.0 * config.fine_m)
    matched = near.sum(-1)
    squares = (pairs.residuals.square() * near).sum(-1)
    share = matched / source.valid.sum(-1).clamp(min=1)
    # What leaves the other image's view on the way says nothing, unless it is most of the scan.
    explained, weakest = _explained(source.normals @ T[:, :3, :3].mT, pairs.inside, near)
    in_view = pairs.inside.sum(-1) / source.valid.sum(-1).clamp(min=1)
    explained = explained * (in_view / _MUCH_IN_VIEW).clamp(max=1.0)
    residual_m = (squares / matched.clamp(min=1)).sqrt()
    return Aligned(T, movement.bend, _information(pairs, near, config), share, explained, weakest, residual_m, matched)


def _information(pairs: Pairs, near: Tensor, config: AlignmentConfig) -> Tensor:
    """(B, 6, 6) about the motion: what is left of it when the bend is not known, by Schur's complement."""
    H, _ = _normal_equations(pairs, near.to(pairs.residuals.dtype))
    H = H.double()
    across, bends = H[:, :6, 6:], H[:, 6:, 6:] + _expected(config, H) / config.information_per_m2
    left: Tensor = H[:, :6, :6] - across @ torch.linalg.solve(bends, across.mT)
    return left.to(pairs.residuals.dtype)


def _explained(normals: Tensor, inside: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """The least ratio (B,), over directions (B, 3), of the information of points that lie well to that of all in view.

    The smallest generalised eigenvalue of the two sums of squared normals (B, N, 3). To both a little is added, so that
    directions of which hardly any point says anything do not count as missed.
    """
    everything = (normals * inside[..., None]).mT @ normals
    matched = (normals * near[..., None]).mT @ normals
    largest = everything.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=1.0)
    little = (_NEXT_TO_NOTHING * largest)[:, None, None] * torch.eye(3, dtype=normals.dtype, device=normals.device)
    root = torch.linalg.cholesky((everything + little).double())
    half = torch.linalg.solve_triangular(root, (matched + little).double(), upper=False)
    ratio, vectors = torch.linalg.eigh(torch.linalg.solve_triangular(root, half.mT, upper=False))
    weakest = torch.linalg.solve_triangular(root.mT, vectors[..., :1], upper=True)[..., 0]
    return ratio[:, 0].to(normals.dtype), torch.nn.functional.normalize(weakest, dim=-1).to(normals.dtype)
