"""Laying one range image on another from a first guess: point-to-plane by projection, batched, in torch.

The guess is a network's answer with its covariance, or none. Wherever the two images say nothing of a direction, the
guess is kept: it enters as a measurement like any other. Sweeps take time; both are compensated with the motion that is
being estimated, which is taken as even from the middle of one sweep to the middle of the other.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from odometry.alignment_config import AlignmentConfig
from odometry.normals import has_normal
from odometry.projection import ImageGrid
from odometry.torch_geometry import exp, inverse, log, skew, transform_points

# A pair whose motion changes by less than this in a step has arrived: rotation in radians, translation in metres.
_ARRIVED = 1e-4
# Sine of the angle between beam and surface below which pixels are not taken as any wider.
_MOST_GRAZING = 0.2
# Part of the best known direction's information that counts as none.
_NEXT_TO_NOTHING = 0.02
# Part of a scan that another must have in view for the two to tell.
_MUCH_IN_VIEW = 0.5
# Information that keeps the normal equations solvable where neither the images nor a guess say anything.
_LEAST_INFORMATION = 1e-3


@dataclass(frozen=True, eq=False)
class SweepImages:
    """Sweeps as images, with what alignment needs of them.

    Attributes:
        points: (B, 3, H, W) metres in the LiDAR frame at the time of each point; zero where empty.
        normals: (B, 3, H, W) unit, zero where there is none.
        offsets: (B, H, W) seconds from the middle of the sweep; all zero where unknown or already compensated.
        low, high: (B,) elevation of the centres of the first and the last row, radians.
    """

    points: Tensor
    normals: Tensor
    offsets: Tensor
    low: Tensor
    high: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: Tensor | slice) -> "SweepImages":
        """Some of the sweeps."""
        parts = (self.points, self.normals, self.offsets, self.low, self.high)
        return SweepImages(*(part[chosen] for part in parts))


@dataclass(frozen=True, eq=False)
class Aligned:
    """Where images lie on others.

    Attributes:
        T_prev_curr: (B, 4, 4) from the middle of the current sweep to the middle of the previous one.
        information: (B, 6, 6) of the images alone, rotation first, for a change of `T_prev_curr` from the left, if
            points scattered independently by 1 m about their planes; divide by their variance.
        share: (B,) of the points with a normal that lie on the other image.
        explained: (B,) of what the current scan's points in view of the other image say about the direction of
            translation that fares worst, the part said by those that lie on it. Most of a street looks the same a
            metre on, and lies well on itself; what would tell does not. 1 where nothing would tell.
        weakest: (B, 3) that direction, unit, in the previous frame.
        residual_m: (B,) root mean square distance of those from the planes.
        matched: (B,) how many they are.
    """

    T_prev_curr: Tensor
    information: Tensor
    share: Tensor
    explained: Tensor
    weakest: Tensor
    residual_m: Tensor
    matched: Tensor


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Points (B, N, 3) with normals, time offsets (B, N) and whether they take part (B, N)."""

    points: Tensor
    normals: Tensor
    offsets: Tensor
    valid: Tensor


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Points moved to the previous frame, the planes they are held against, which are in view, and which count."""

    moved: Tensor
    normals: Tensor
    residuals: Tensor
    inside: Tensor
    kept: Tensor


@torch.no_grad()
def align(
    T_prev_curr: Tensor,
    current: SweepImages,
    previous: SweepImages,
    interval_s: Tensor,
    config: AlignmentConfig,
    guess_information: Tensor | None = None,
) -> Aligned:
    """Refine motions (B, 4, 4) so that the current images lie on the previous ones.

    Gauss-Newton on point-to-plane distances with Geman-McClure weights whose scale shrinks from step to step.

    Args:
        T_prev_curr: (B, 4, 4) first guesses, between the middles of the sweeps.
        current, previous: B sweeps each, with normals.
        interval_s: (B,) from the middle of one sweep to the middle of the other, for compensation.
        config: how.
        guess_information: (B, 6, 6) inverse covariance of the guesses, for a change from the left; None: they are
            only where to start from.
    """
    guess, T = T_prev_curr, T_prev_curr
    source = _sample(current, config.column_step)
    previous = _filled(previous, config.fill_columns)
    for done in torch.linspace(0.0, 1.0, config.iterations).tolist():
        scale_m = config.coarse_m * (config.fine_m / config.coarse_m) ** min(1.0, done / config.anneal_share)
        pairs = _pair(T, source, previous, interval_s, scale_m, config)
        T, moved = _step(T, pairs, scale_m, guess, guess_information, config)
        if done >= config.anneal_share and moved < _ARRIVED:
            break
    return _judge(T, source, previous, interval_s, config)


def _sample(images: SweepImages, column_step: int) -> _Cloud:
    """Every so-manieth column's pixels that have a normal."""
    points = images.points[..., ::column_step].flatten(2).mT  # (B, 3, H, W') -> (B, N, 3)
    normals = images.normals[..., ::column_step].flatten(2).mT
    offsets = images.offsets[..., ::column_step].flatten(1)
    valid = has_normal(normals, -1)
    if len(points) == 1:  # what does not take part need not be there
        chosen = valid[0].nonzero()[:, 0]
        points, normals, offsets, valid = (values[:, chosen] for values in (points, normals, offsets, valid))
    return _Cloud(points, normals, offsets, valid)


def _filled(images: SweepImages, columns: int) -> SweepImages:
    """Pixels without a normal stand for the nearest one in their row that has one, up to so many columns away.

    A point is held against a plane, which goes on beyond its pixel; the gate sees to it that it does not go too far.
    """
    size, _, height, width = images.points.shape
    pixel = torch.arange(height * width, device=images.points.device).view(1, height, width).expand(size, -1, -1)
    own = has_normal(images.normals, 1)
    filled, nearest = own, pixel
    for distance in range(1, columns + 1):
        for step in (distance, -distance):
            wanted = ~filled & own.roll(step, -1)
            nearest = torch.where(wanted, pixel.roll(step, -1), nearest)
            filled = filled | wanted
    nearest = nearest.flatten(1)

    def take(values: Tensor) -> Tensor:
        return values.flatten(2).gather(2, nearest[:, None].expand(-1, values.shape[1], -1)).view(values.shape)

    return SweepImages(
        take(images.points), take(images.normals), take(images.offsets[:, None])[:, 0], images.low, images.high
    )


def compensate(points: Tensor, offsets: Tensor, velocity: Tensor, is_direction: bool = False) -> Tensor:
    """Points (B, N, 3) as seen from the middle of the sweep, for a body that moves evenly at velocity (B, 6).

    The exponential map to second order, which is exact to 0.12 mrad for a turn of 10 degrees a sweep, half of it to
    either side of the middle, and to eight times that for 20 degrees.
    """
    cross = skew(velocity[:, :3]).mT  # points @ cross is the cross product of the rotation vector with them
    t = offsets[..., None]
    first = points @ cross if is_direction else torch.baddbmm(velocity[:, None, 3:], points, cross)
    moved: Tensor = torch.addcmul(points, t, torch.baddbmm(first, (0.5 * t) * first, cross))
    return moved


def _pair(
    T: Tensor, source: _Cloud, target: SweepImages, interval_s: Tensor, scale_m: float, config: AlignmentConfig
) -> _Pairs:
    """Hold every point against the plane of the pixel that it falls into.

    The target's pixels are as measured, each at its own time: points are taken to that time, placed, and compared
    there. The time is that of the pixel they would fall into otherwise, right but for the seam of the sweep.
    """
    velocity = log(T) / interval_s[:, None]
    moved = transform_points(T, compensate(source.points, source.offsets, velocity))
    pixel, _ = _place(moved, target)
    seen = compensate(moved, -target.offsets.flatten(1).gather(1, pixel), velocity)
    pixel, inside = _place(seen, target)
    reference, planes = _gather(target.points, pixel), _gather(target.normals, pixel)
    difference = seen - reference
    residuals = (difference * planes).sum(-1)
    # What lies farther along the surface than pixels are wide is another surface seen past an edge. On ground that the
    # beams graze, pixels are metres wide; were they not, rings, which go along with the sensor, would hold it back.
    squared = seen.square().sum(-1)
    across = (seen * planes).sum(-1).abs().maximum(_MOST_GRAZING * squared.sqrt())
    gate = config.gate_m + config.gate_share * squared / across.clamp(min=1e-6) + scale_m
    inside &= source.valid
    kept = inside & (difference.square().sum(-1) < gate * gate)
    kept &= ((source.normals @ T[:, :3, :3].mT) * planes).sum(-1) > config.least_cosine
    return _Pairs(seen, planes, residuals, inside, kept)


def _place(points: Tensor, target: SweepImages) -> tuple[Tensor, Tensor]:
    height, width = target.points.shape[-2:]
    row, column = ImageGrid(height, width, 0.0, 1.0).place(points)
    # The grid of elevations 0 to 1 turns radians into rows by a mere factor.
    row = (row / max(height - 1, 1) - target.low[:, None]) * ((height - 1) / (target.high - target.low)[:, None])
    inside = (row >= -0.5) & (row < height - 0.5)
    pixel = (row + 0.5).floor().clamp(0, height - 1).long() * width + column.long().clamp(0, width - 1)
    return pixel, inside


def _gather(images: Tensor, pixel: Tensor) -> Tensor:
    """Values (B, N, 3) of images (B, 3, H, W) at flat pixels (B, N)."""
    return images.flatten(2).gather(2, pixel[:, None].expand(-1, 3, -1)).mT


def _normal_equations(pairs: _Pairs, weights: Tensor) -> tuple[Tensor, Tensor]:
    """H (B, 6, 6) and g (B, 6) of the weighted squares, for a change of T_prev_curr from the left."""
    J = torch.cat([torch.linalg.cross(pairs.moved, pairs.normals), pairs.normals], dim=-1)  # (B, N, 6)
    weighted = J * weights[..., None]
    return weighted.mT @ J, (weighted.mT @ pairs.residuals[..., None])[..., 0]


def _step(
    T: Tensor,
    pairs: _Pairs,
    scale_m: float,
    guess: Tensor,
    guess_information: Tensor | None,
    config: AlignmentConfig,
) -> tuple[Tensor, float]:
    """One Gauss-Newton step, and by how much it moved the pair it moved most."""
    squared = pairs.residuals.square() / scale_m**2
    weights = pairs.kept / (1.0 + squared).square()
    H, g = _normal_equations(pairs, weights)
    H, g = H / config.residual_m**2, g / config.residual_m**2
    # Neighbouring pixels share their errors, so that a pair of images says less than its number of points.
    H, g = H * config.independent_share, g * config.independent_share
    if guess_information is not None:
        away = log(T @ inverse(guess))
        H, g = H + guess_information, g + (guess_information @ away[..., None])[..., 0]
    # In float32 so little would be lost beside what the images say of other directions.
    H = H.double() + _LEAST_INFORMATION * torch.eye(6, dtype=torch.float64, device=H.device)
    delta = -torch.linalg.solve(H, g.double()[..., None])[..., 0].to(T.dtype)
    delta = delta * (config.largest_step / delta.abs().amax(-1, keepdim=True).clamp(min=config.largest_step))
    return exp(delta) @ T, float(delta.abs().max())


def _judge(T: Tensor, source: _Cloud, target: SweepImages, interval_s: Tensor, config: AlignmentConfig) -> Aligned:
    """How well the images lie on one another in the end."""
    pairs = _pair(T, source, target, interval_s, config.fine_m, config)
    near = pairs.kept & (pairs.residuals.abs() < 2.0 * config.fine_m)
    matched = near.sum(-1)
    H, _ = _normal_equations(pairs, near.to(T.dtype))
    squares = (pairs.residuals.square() * near).sum(-1)
    share = matched / source.valid.sum(-1).clamp(min=1)
    # What leaves the other image's view on the way says nothing, unless it is most of the scan.
    explained, weakest = _explained(source.normals @ T[:, :3, :3].mT, pairs.inside, near)
    in_view = pairs.inside.sum(-1) / source.valid.sum(-1).clamp(min=1)
    explained = explained * (in_view / _MUCH_IN_VIEW).clamp(max=1.0)
    return Aligned(T, H, share, explained, weakest, (squares / matched.clamp(min=1)).sqrt(), matched)


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
