"""Which primitives rays may meet: rays in tiles, each within a cone, primitives in spheres, compared in chunks."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lidarslam.simulation.batched_primitives import dot

# Cones are opened and spheres enlarged by these, more than rounding moves them.
_SLACK = 1e-3
_SLACK_M = 0.01
# A tile of rays further apart than this is not narrowed down at all.
_WIDEST = 0.1


@dataclass(frozen=True, eq=False)
class Cones:
    """What bounds the rays of each of T tiles in B images; positions relative to the image's reference.

    Attributes:
        apex, axis: (3, B, T).
        spread: (B, T) greatest distance of an origin from the apex.
        sine, cosine: (B, T) of the greatest angle between a ray and the axis; 1 and 0 for a tile that is too wide.
    """

    apex: Tensor
    axis: Tensor
    spread: Tensor
    sine: Tensor
    cosine: Tensor

    @classmethod
    def around(cls, origins: Tensor, directions: Tensor) -> "Cones":
        """The cones of tiles of rays (3, B, T, S), directions unit."""
        apex, axis = origins.mean(dim=-1), directions.mean(dim=-1)
        axis = axis / dot(axis, axis).sqrt().clamp(min=1e-9)
        along = dot(axis[..., None], directions)
        aside = directions - along * axis[..., None]
        sine = dot(aside, aside).sqrt().amax(dim=-1) + _SLACK
        wide = along.amin(dim=-1) < _WIDEST
        cosine = torch.where(wide, 0.0, (1.0 - sine.clamp(max=1.0) ** 2).sqrt())
        away = origins - apex[..., None]
        return cls(apex, axis, dot(away, away).sqrt().amax(dim=-1), torch.where(wide, 1.0, sine), cosine)


class Pairs(NamedTuple):
    """K pairs of a tile and a primitive that its rays may meet.

    Attributes:
        image, tile, primitive: (K,) indices.
    """

    image: Tensor
    tile: Tensor
    primitive: Tensor


def image_tiles(height: int, width: int, tile: tuple[int, int], device: torch.device) -> Tensor:
    """(T, S) ray numbers of an image's tiles; at its edges rays stand in twice for what is missing."""
    rows, columns = (
        torch.arange(-(-size // part) * part, device=device).clamp(max=size - 1).view(-1, part)
        for size, part in zip((height, width), tile, strict=True)
    )
    # (rows of tiles, columns of tiles, rows in a tile, columns in a tile) -> (T, S)
    return (rows[:, None, :, None] * width + columns[None, :, None, :]).flatten(2).flatten(0, 1)


def within_range(centres: Tensor, radii: Tensor, reach: Tensor) -> Tensor:
    """Indices (B, P') of the primitives near enough, those of images with fewer filled up with others.

    Args:
        centres: (B, P, 3) relative to the image's reference.
        radii: (B, P) of the spheres around them.
        reach: (B,) how far rays get from the reference.
    """
    near = torch.linalg.vector_norm(centres, dim=-1) - radii <= reach[:, None]
    most = int(near.sum(dim=1).max()) if near.numel() else 0
    order: Tensor = near.int().argsort(dim=1, descending=True, stable=True)
    return order[:, :most]


def pairs_that_may_meet(cones: Cones, centres: Tensor, radii: Tensor, comparisons: int) -> Iterator[Pairs]:
    """Pairs of tiles and spheres, centres (3, B, P) and radii (B, P), in chunks of so many comparisons at a time."""
    images, tiles = cones.spread.shape
    count = radii.shape[1]
    per_image = tiles * count
    images_at_once = max(1, min(images, comparisons // max(1, per_image)))
    tiles_at_once = max(1, min(tiles, comparisons // max(1, count)))
    for b in range(0, images if per_image else 0, images_at_once):
        for t in range(0, tiles, tiles_at_once):
            part = (slice(b, b + images_at_once), slice(t, t + tiles_at_once))
            found = torch.nonzero(_may_meet(cones, part, centres[:, part[0]], radii[part[0]]), as_tuple=True)
            yield Pairs(found[0] + b, found[1] + t, found[2])


def _may_meet(cones: Cones, part: tuple[slice, slice], centres: Tensor, radii: Tensor) -> Tensor:
    """(b, t, P) whether a sphere comes within a cone."""
    sine, cosine, spread = (a[part][..., None] for a in (cones.sine, cones.cosine, cones.spread))
    apex, axis = cones.apex[(slice(None), *part)][..., None], cones.axis[(slice(None), *part)][..., None]
    x, y, z = centres[:, :, None]
    # Written out with running sums: few passes over the largest arrays there are.
    along = (axis[0] * x).addcmul_(axis[1], y).addcmul_(axis[2], z).sub_(dot(axis, apex))
    distance2 = (-2.0 * apex[0] * x).addcmul_(-2.0 * apex[1], y).addcmul_(-2.0 * apex[2], z)
    distance2.add_(dot(centres, centres)[:, None]).add_(dot(apex, apex))
    radius = radii[:, None] + (spread + _SLACK_M)
    aside2 = (distance2 - along**2).mul_(cosine**2)
    # The cone's side passes the centre at a distance of aside * cosine - along * sine.
    allowed = torch.addcmul(radius, along, sine)
    meets: Tensor = (along >= -radius) & (allowed >= 0.0) & (aside2 <= allowed**2)
    return meets | ((cosine <= 0.0) & (radius > 0.0))
