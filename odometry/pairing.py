"""Which point of one sweep belongs to which plane of another: that of the pixel it falls into."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lidarslam.core.geometry import FloatArray
from odometry.alignment_config import AlignmentConfig
from odometry.normals import has_normal
from odometry.projection import ImageGrid
from odometry.sweeps import SweepImages, compensate
from odometry.torch_geometry import transform_points

# Sine of the angle between beam and surface below which pixels are not taken as any wider.
_MOST_GRAZING = 0.2


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (B, N, 3) with normals, time offsets (B, N) and whether they take part (B, N)."""

    points: Tensor
    normals: Tensor
    offsets: Tensor
    valid: Tensor


@dataclass(frozen=True, eq=False)
class Movement:
    """What alignment estimates of B pairs of sweeps.

    Attributes:
        T_prev_curr: (B, 4, 4) from the middle of the current sweep to the middle of the previous one.
        velocity: (B, 6) mean, between the two middles.
        bend: (B, 6) by how much the velocity in the middle of the current sweep is above the mean, and in that of the
            previous one below.
    """

    T_prev_curr: FloatArray
    velocity: FloatArray
    bend: FloatArray


@dataclass(frozen=True, eq=False)
class Pairs:
    """Points and the planes that they are held against, (B, N) each.

    Attributes:
        moved: (B, N, 3) points in the frame of the previous sweep at the time of their pixel.
        normals: (B, N, 3) of the planes.
        residuals: (B, N) distances from the planes, metres.
        offsets_s: (B, N) of both times from the middles of their sweeps together: what a bend shifts them by.
        inside: (B, N) in view of the previous sweep.
        kept: (B, N) near enough to their pixel, and turned like it.
    """

    moved: Tensor
    normals: Tensor
    residuals: Tensor
    offsets_s: Tensor
    inside: Tensor
    kept: Tensor


def sample(images: SweepImages, column_step: int) -> Cloud:
    """Every so-manieth column's pixels that have a normal."""
    points = images.points[..., ::column_step].flatten(2).mT  # (B, 3, H, W') -> (B, N, 3)
    normals = images.normals[..., ::column_step].flatten(2).mT
    offsets = images.offsets[..., ::column_step].flatten(1)
    valid = has_normal(normals, -1)
    if len(points) == 1:  # what does not take part need not be there
        chosen = valid[0].nonzero()[:, 0]
        points, normals, offsets, valid = (values[:, chosen] for values in (points, normals, offsets, valid))
    return Cloud(points, normals, offsets, valid)


def filled(images: SweepImages, columns: int) -> SweepImages:
    """Pixels without a normal stand for the nearest one in their row that has one, up to so many columns away.

    A point is held against a plane, which goes on beyond its pixel; the gate sees to it that it does not go too far.
    """
    size, _, height, width = images.points.shape
    pixel = torch.arange(height * width, device=images.points.device).view(1, height, width).expand(size, -1, -1)
    own = has_normal(images.normals, 1)
    done, nearest = own, pixel
    for distance in range(1, columns + 1):
        for step in (distance, -distance):
            wanted = ~done & own.roll(step, -1)
            nearest = torch.where(wanted, pixel.roll(step, -1), nearest)
            done = done | wanted
    nearest = nearest.flatten(1)

    def take(values: Tensor) -> Tensor:
        return values.flatten(2).gather(2, nearest[:, None].expand(-1, values.shape[1], -1)).view(values.shape)

    return SweepImages(
        take(images.points), take(images.normals), take(images.offsets[:, None])[:, 0], images.low, images.high
    )


def pair(movement: Movement, source: Cloud, target: SweepImages, scale_m: float, config: AlignmentConfig) -> Pairs:
    """Hold every point against the plane of the pixel that it falls into.

    The target's pixels are as measured, each at its own time: points are taken to that time, placed, and compared
    there. The time is that of the pixel they would fall into otherwise, right but for the seam of the sweep.
    """
    parts = (movement.T_prev_curr, movement.velocity + movement.bend, movement.velocity - movement.bend)
    T, late, early = (torch.from_numpy(part).to(source.points) for part in parts)
    moved = transform_points(T, compensate(source.points, source.offsets, late))
    pixel, _ = _place(moved, target)
    offsets = target.offsets.flatten(1).gather(1, pixel)
    seen = compensate(moved, -offsets, early)
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
    return Pairs(seen, planes, residuals, source.offsets + offsets, inside, kept)


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
