"""The geometric loss of DeLORA (Nubert et al., ICRA 2021): what a motion leaves between two scans.

Everything is averaged over the matched points of each item of the batch. Gradients flow through the moved source points
and normals only: which points belong together is taken as given.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from odometry.images.projection import ImageGrid
from odometry.training.correspondence import by_projection, nearest
from odometry.training.loss_config import LossConfig
from odometry.training.torch_geometry import inverse, rotate, transform_points

# Rounds off the kink of |n - m| at zero, about 0.06 degrees wide.
_NORMAL_ROUNDING = 1e-3


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points of scans and the surfaces they lie on.

    Attributes:
        points: (B, N, 3), metres, in the frame of each scan; zero where there is none. Finite everywhere.
        normals: (B, N, 3), unit where valid. Finite everywhere.
        valid: (B, N) bool, which points have a normal.
    """

    points: Tensor
    normals: Tensor
    valid: Tensor


@dataclass(frozen=True, eq=False)
class Matched:
    """Source points moved onto the target, and what they met there.

    Attributes:
        source_points, source_normals: (B, N, 3), in the target's frame.
        target_points, target_normals: (B, N, 3), of the correspondences; arbitrary where the weight is 0.
        weight: (B, N), 1 for pairs that count, 0 for the others.
        share: (B,) pairs that count, of the source points with a normal; 0 if there are none.
    """

    source_points: Tensor
    source_normals: Tensor
    target_points: Tensor
    target_normals: Tensor
    weight: Tensor
    share: Tensor


@dataclass(frozen=True, eq=False)
class GeometricLoss:
    """A loss and its parts, (B,) each; parts that are switched off are there, but not in the total.

    Attributes:
        total: what is minimised.
        point_to_plane: m^2 (also with the robust kernel), without its weight.
        plane_to_plane: no unit.
        matched_share: 0 to 1, of the source points with a normal; 0 means that the losses say nothing.
    """

    total: Tensor
    point_to_plane: Tensor
    plane_to_plane: Tensor
    matched_share: Tensor


def geometric_loss(
    T_prev_curr: Tensor, source: Surfaces, target: Surfaces, config: LossConfig, grid: ImageGrid | None = None
) -> GeometricLoss:
    """How badly motions (B, 4, 4) lay the current scans (source) on the previous ones (target); errors as `match`."""
    forward = _one_way(T_prev_curr, source, target, config, grid)
    if not config.symmetric:
        return forward
    backward = _one_way(inverse(T_prev_curr), target, source, config, grid)
    return GeometricLoss(
        0.5 * (forward.total + backward.total),
        0.5 * (forward.point_to_plane + backward.point_to_plane),
        0.5 * (forward.plane_to_plane + backward.plane_to_plane),
        0.5 * (forward.matched_share + backward.matched_share),
    )


def match(
    T_prev_curr: Tensor, source: Surfaces, target: Surfaces, config: LossConfig, grid: ImageGrid | None = None
) -> Matched:
    """Move the source by T_prev_curr (B, 4, 4) and find what each of its points belongs to.

    Pairs count if both points have a normal and are no farther apart than the gate. For correspondences by projection
    the target's points are the pixels of `grid`, row by row.

    Raises:
        ValueError: the correspondences are by projection, and there is no grid or it is not of the target's size.
    """
    points = transform_points(T_prev_curr, source.points)
    index, distance = _correspondences(points.detach(), target, config, grid)
    counts = source.valid & target.valid.gather(1, index) & distance.isfinite()
    if config.gate_m is not None:
        counts &= distance <= config.gate_m
    weight = counts.to(points.dtype)
    return Matched(
        source_points=points,
        source_normals=rotate(T_prev_curr, source.normals),
        target_points=_pick(target.points, index),
        target_normals=_pick(target.normals, index),
        weight=weight,
        share=weight.sum(1) / source.valid.sum(1).clamp(min=1),
    )


def point_to_plane(matched: Matched, config: LossConfig) -> Tensor:
    """Mean square distance (B,), m^2, of the moved points from the planes they met (equation 1 of the paper).

    With a robust scale, Huber's kernel: the square up to that distance s, and 2 s |r| - s^2 beyond.
    """
    distance = ((matched.source_points - matched.target_points) * matched.target_normals).sum(-1)
    if config.robust_m is None:
        return _mean(distance.square(), matched.weight)
    huber = functional.huber_loss(distance, torch.zeros_like(distance), reduction="none", delta=config.robust_m)
    return _mean(2.0 * huber, matched.weight)


def plane_to_plane(matched: Matched, config: LossConfig) -> Tensor:
    """Mean difference (B,) between the turned normals and those they met (equation 2 of the paper).

    "squared" is |n - m|^2, which is 2 - 2 cos of the angle between them. "linear" is |n - m|, rounded off at zero;
    wrong pairs weigh less in it.
    """
    squared = (matched.source_normals - matched.target_normals).square().sum(-1)
    if config.plane_norm == "squared":
        return _mean(squared, matched.weight)
    return _mean((squared + _NORMAL_ROUNDING**2).sqrt() - _NORMAL_ROUNDING, matched.weight)


def _one_way(
    T_target_source: Tensor, source: Surfaces, target: Surfaces, config: LossConfig, grid: ImageGrid | None
) -> GeometricLoss:
    matched = match(T_target_source, source, target, config, grid)
    points, planes = point_to_plane(matched, config), plane_to_plane(matched, config)
    total = torch.zeros_like(points)
    if config.point_to_plane:
        total = total + config.point_to_plane_weight * points
    if config.plane_to_plane:
        total = total + planes
    return GeometricLoss(total, points, planes, matched.share)


def _correspondences(
    points: Tensor, target: Surfaces, config: LossConfig, grid: ImageGrid | None
) -> tuple[Tensor, Tensor]:
    """Index (B, N) into the target's points and distance (B, N) of moved points (B, N, 3)."""
    if config.correspondence == "nearest":
        has_point = (target.points != 0.0).any(-1)
        return nearest(points, target.points, has_point if config.candidates == "all" else target.valid)
    if grid is None or target.points.shape[1] != grid.rows * grid.columns:
        raise ValueError("correspondences by projection need the grid of which the target's points are the pixels")
    ranges = torch.linalg.vector_norm(target.points, dim=-1, keepdim=True)
    image = torch.cat([target.points, ranges], dim=-1).transpose(1, 2)  # (B, H * W, 4) -> (B, 4, H * W)
    return by_projection(points, image.reshape(len(image), 4, grid.rows, grid.columns), grid)


def _pick(values: Tensor, index: Tensor) -> Tensor:
    """Values (B, M, 3) at index (B, N), giving (B, N, 3)."""
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """The weighted mean (B,) of values (B, N); zero, with a gradient of zero, where nothing has weight."""
    return (values * weight).sum(1) / weight.sum(1).clamp(min=1.0)
