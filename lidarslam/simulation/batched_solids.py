"""Rays against what stands still and is solid, and against what moves, in torch: culled in tiles, then met exactly."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lidarslam.simulation.batched_culling import Cones, Pairs, pairs_that_may_meet, within_range
from lidarslam.simulation.batched_primitives import dot, first_surface, meet_box, rotate
from lidarslam.simulation.batched_world import Movers, Solids

MeetSolid = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]

# So many ray-solid tests at a time for every comparison of a tile with a sphere: they take that much more memory.
_TESTS_SHARE = 4


class Poses(NamedTuple):
    """Rotations (3, 3, K, 1) and positions (3, K, 1) of K solids, relative to the image's reference."""

    R: Tensor
    centres: Tensor


@dataclass(frozen=True, eq=False)
class TiledRays:
    """The rays of B images in T tiles of S.

    Attributes:
        world: (B,) which world each image sees.
        reference: (B, 3) float64 world position that origins are relative to.
        reach: (B,) how far from the reference rays get.
        times: (B, T, S) float64.
        origins, directions: (3, B, T, S) float32, axes of the world, directions unit.
        number: (T, S) which ray of the image it is.
        cones: around the tiles.
    """

    world: Tensor
    reference: Tensor
    reach: Tensor
    times: Tensor
    origins: Tensor
    directions: Tensor
    number: Tensor
    cones: Cones


def meet_solids(rays: TiledRays, solids: Solids, meet: MeetSolid, ranges: Tensor, comparisons: int) -> None:
    """Shorten ranges (B, N) in place to the nearest solid; rays that begin inside one meet it from within."""
    centres = (solids.centres[rays.world] - rays.reference[:, None]).float()
    nearby = within_range(centres, solids.radii[rays.world], rays.reach)
    centres = centres.gather(1, nearby[..., None].expand(-1, -1, 3)).movedim(-1, 0).contiguous()  # (3, B, P')
    radii = solids.radii[rays.world[:, None], nearby]
    for pairs in pairs_that_may_meet(rays.cones, centres, radii, comparisons):
        for image, tile, near in _narrowed(rays, solids, pairs, centres, nearby, comparisons):
            world, number = rays.world[image], nearby[image, near]
            R = solids.R_world_solid[world, number].movedim(0, -1)[..., None]  # (3, 3, K, 1)
            half_sizes = solids.half_sizes[world, number].T[..., None]
            o, d = _in_frame(Poses(R, centres[:, image, near, None]), *_rays_of(rays, image, tile))
            met = first_surface(*meet(o, d, half_sizes))
            _shorten(ranges, rays.number, image, tile, met)


def _narrowed(
    rays: TiledRays, solids: Solids, pairs: Pairs, centres: Tensor, nearby: Tensor, comparisons: int
) -> Iterator[Pairs]:
    """The pairs whose cone also meets the box around the solid, so many at a time that memory stays bounded."""
    image, tile, near = pairs
    world, number = rays.world[image], nearby[image, near]
    cones = rays.cones
    R = solids.R_world_solid[world, number].movedim(0, -1)  # (3, 3, K)
    away = centres[:, image, near] - cones.apex[:, image, tile]
    o, d = rotate(R.transpose(0, 1), -away), rotate(R.transpose(0, 1), cones.axis[:, image, tile])
    # A ray of the cone leaves its axis by no more than this before it has passed the sphere around the solid.
    farthest = dot(away, away).sqrt() + solids.radii[world, number]
    aside = cones.spread[image, tile] + farthest * cones.sine[image, tile] / cones.cosine[image, tile]
    enter, leave = meet_box(o, d, solids.half_sizes[world, number].T + aside + 1e-3)
    kept = torch.nonzero((enter <= leave) & (leave >= 0.0)).squeeze(1)
    at_once = max(1, _TESTS_SHARE * comparisons // (8 * rays.number.shape[1]))
    for start in range(0, len(kept), at_once):
        part = kept[start : start + at_once]
        yield Pairs(image[part], tile[part], near[part])


def meet_movers(rays: TiledRays, movers: Movers, ranges: Tensor, comparisons: int) -> None:
    """Shorten ranges (B, N) in place to the nearest mover where it is at each ray's time, seen from outside."""
    if not movers.radii.shape[1] or not movers.half_sizes.shape[2]:
        return
    first, last = rays.times.flatten(1).amin(dim=1), rays.times.flatten(1).amax(dim=1)
    count = movers.radii.shape[1]
    each = torch.arange(count, device=ranges.device)
    position, _ = mover_poses(movers, rays.world[:, None], each[None], 0.5 * (first + last)[:, None, None])
    centres = (position.squeeze(2) - rays.reference[:, None]).float()
    travel = movers.speeds_mps[rays.world].abs() * 0.5 * (last - first)[:, None]
    radii = movers.radii[rays.world] + travel.float()
    for pairs in pairs_that_may_meet(rays.cones, centres.movedim(-1, 0), radii, comparisons):
        at_once = max(1, comparisons // (8 * rays.number.shape[1] * movers.half_sizes.shape[2]))
        for start in range(0, len(pairs.image), at_once):
            image, tile, number = (index[start : start + at_once] for index in pairs)
            _shorten(ranges, rays.number, image, tile, _meet_mover(rays, movers, image, tile, number))


def _meet_mover(rays: TiledRays, movers: Movers, image: Tensor, tile: Tensor, number: Tensor) -> Tensor:
    """Ranges (K, S) of tiles' rays to the nearest box of one mover each."""
    world = rays.world[image]
    position, yaw = mover_poses(movers, world, number, rays.times[image, tile])
    centres = (position - rays.reference[image, None]).float().movedim(-1, 0)  # (3, K, S)
    c, s = yaw.cos().float(), yaw.sin().float()
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    R = torch.stack([torch.stack(row) for row in ([c, -s, zero], [s, c, zero], [zero, zero, one])])
    o, d = _in_frame(Poses(R, centres), *_rays_of(rays, image, tile))
    # Boxes of the mover between the pairs and the rays: (3, K, S) -> (3, K, 1, S) beside (3, K, Q, 1)
    boxes = Poses(
        movers.R_mover_box[world, number].movedim((2, 3), (0, 1))[..., None],
        movers.centres[world, number].movedim(-1, 0)[..., None],
    )
    o, d = _in_frame(boxes, o[:, :, None], d[:, :, None])
    enter, leave = meet_box(o, d, movers.half_sizes[world, number].movedim(-1, 0)[..., None])
    return torch.where((enter <= leave) & (enter > 0.0), enter, torch.inf).amin(dim=1)


def mover_poses(movers: Movers, world: Tensor, number: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (..., S, 3) and yaws (..., S) of movers (...) at times (..., S), all float64, as `Mover.pose_at`."""
    ends = movers.ends[world, number].contiguous()  # (..., L)
    # Beyond a mover's own legs stand infinite ends.
    total = torch.where(ends.isfinite(), ends, 0.0).amax(dim=-1, keepdim=True)
    start, speed = movers.starts_m[world, number][..., None], movers.speeds_mps[world, number][..., None]
    along = torch.remainder(start + speed * times, total.clamp(min=1e-9))
    legs = (ends.isfinite().sum(dim=-1, keepdim=True) - 1).clamp(min=0)
    leg = torch.minimum(torch.searchsorted(ends, along.contiguous(), right=True), legs)
    of_leg = leg[..., None].expand(*leg.shape, 3)
    corner = movers.corners[world, number].gather(-2, of_leg)
    step = movers.steps[world, number].gather(-2, of_leg)
    length = torch.linalg.vector_norm(step, dim=-1)
    since = along - (ends.gather(-1, leg) - length)
    share = torch.where(length > 0.0, since / length, 0.0)
    return corner + share[..., None] * step, torch.atan2(step[..., 1], step[..., 0])


def _rays_of(rays: TiledRays, image: Tensor, tile: Tensor) -> tuple[Tensor, Tensor]:
    """Origins and directions (3, K, S) of tiles (K,)."""
    return rays.origins[:, image, tile], rays.directions[:, image, tile]


def _in_frame(poses: Poses, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Origins and directions in the solids' frames."""
    R_solid_world = poses.R.transpose(0, 1)
    return rotate(R_solid_world, origins - poses.centres), rotate(R_solid_world, directions)


def _shorten(ranges: Tensor, number: Tensor, image: Tensor, tile: Tensor, met: Tensor) -> None:
    index = image[:, None] * ranges.shape[1] + number[tile]  # (K, S)
    ranges.view(-1).scatter_reduce_(0, index.view(-1), met.reshape(-1), "amin")
