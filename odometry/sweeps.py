"""Sweeps as images, pairs of them, and what a moving sensor does to a sweep."""

from dataclasses import dataclass

import torch
from torch import Tensor

from odometry.torch_geometry import skew


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

    def median_range_m(self) -> float:
        """Of all points; 0 when there are none."""
        ranges = self.points.norm(dim=1)
        seen = ranges[ranges > 0.0]
        return float(seen.median()) if len(seen) else 0.0

    def share_with_normal(self) -> float:
        """Of the pixels that have a point; 0 when there are none."""
        points, normals = ((part != 0.0).any(dim=1).sum() for part in (self.points, self.normals))
        return float(normals / points.clamp(min=1))

    def select(self, chosen: Tensor | slice) -> "SweepImages":
        """Some of the sweeps."""
        parts = (self.points, self.normals, self.offsets, self.low, self.high)
        return SweepImages(*(part[chosen] for part in parts))


@dataclass(frozen=True, eq=False)
class LastMotion:
    """How B sensors moved before: mean velocity (B, 6), rotation first, in radians and metres a second; for how long.

    Attributes:
        velocity: (B, 6) between the middles of two sweeps, the later of which is the previous one now.
        interval_s: (B,) from one of these middles to the other.
    """

    velocity: Tensor
    interval_s: Tensor


@dataclass(frozen=True, eq=False)
class SweepPairs:
    """B sweeps, each with the one before it.

    Attributes:
        current, previous: B sweeps each.
        interval_s: (B,) from the middle of the previous one to that of the current one.
        last: the motions before; None where they are not known.
    """

    current: SweepImages
    previous: SweepImages
    interval_s: Tensor
    last: LastMotion | None = None

    def repeat(self, count: int) -> "SweepPairs":
        """The only pair so many times."""
        same = torch.zeros(count, dtype=torch.int64, device=self.interval_s.device)
        last = None if self.last is None else LastMotion(self.last.velocity[same], self.last.interval_s[same])
        return SweepPairs(self.current.select(same), self.previous.select(same), self.interval_s[same], last)


def consecutive(images: SweepImages, number: int, interval_s: Tensor, last: LastMotion | None = None) -> SweepPairs:
    """A sweep and the one after it; interval_s (1,) is from the middle of the one to that of the other."""
    current, previous = (images.select(slice(i, i + 1)) for i in (number + 1, number))
    return SweepPairs(current, previous, interval_s, last)


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
