"""What training does with images of sweeps, in torch: choosing, turning, mirroring and compensating them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from odometry.images.projection import ImageGrid
from odometry.images.sweeps import SweepImages
from odometry.training.torch_geometry import skew


@dataclass(frozen=True, eq=False)
class RecordedImages:
    """The sweeps of a recording as images of one size.

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

    @classmethod
    def stacked(cls, sweeps: Sequence[SweepImages]) -> "RecordedImages":
        """Sweeps one after the other, which have images of one size."""
        parts = (np.stack([getattr(sweep, name) for sweep in sweeps]) for name in ("points", "normals", "offsets"))
        limits = (torch.tensor([getattr(sweep, name) for sweep in sweeps]) for name in ("low", "high"))
        return cls(*(torch.from_numpy(part) for part in parts), *limits)

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: Tensor | slice) -> "RecordedImages":
        """Some of the sweeps."""
        parts = (self.points, self.normals, self.offsets, self.low, self.high)
        return RecordedImages(*(part[chosen] for part in parts))


def has_normal(normals: Tensor, dim: int) -> Tensor:
    """Which pixels or points have a normal: those where there is none hold zeros along the dimension of x, y and z."""
    return normals.square().sum(dim=dim) > 0.5


def rotate_columns(images: Tensor, shift: Tensor | int) -> Tensor:
    """Images of the clouds turned about z by whole columns, to the left (x towards y) where positive.

    Args:
        images: (B, C, H, W), C at least 2; channels 0 and 1 are components along x and y, of points or of normals.
        shift: columns, one for all or (B,) integers.
    """
    width = images.shape[-1]
    shifts = torch.as_tensor(shift, device=images.device).expand(len(images))
    columns = (torch.arange(width, device=images.device) - shifts[:, None]).remainder(width)
    moved = images.gather(3, columns[:, None, None, :].expand(images.shape))
    angles = shifts.double()[:, None, None] * (2.0 * math.pi / width)
    cos, sin = angles.cos().to(images.dtype), angles.sin().to(images.dtype)
    x, y = moved[:, 0], moved[:, 1]
    turned = torch.stack([cos * x - sin * y, sin * x + cos * y], dim=1)
    return torch.cat([turned, moved[:, 2:]], dim=1)


def mirror(images: Tensor) -> Tensor:
    """Images (B, C, H, W) of the clouds with y negated; channel 1 is the component along y."""
    flipped = images.flip(-1)
    return torch.cat([flipped[:, :1], -flipped[:, 1:2], flipped[:, 2:]], dim=1)


def place(points: Tensor, grid: ImageGrid) -> tuple[Tensor, Tensor]:
    """Where points (..., 3) lie in an image: row and column coordinates (...), as `ImageGrid.place` gives them."""
    x, y, z = points.unbind(-1)
    row = (torch.atan2(z, torch.hypot(x, y)) - grid.centre_of_row_0) * grid.rows_per_radian
    column = torch.atan2(y, x).remainder(2.0 * math.pi) * (grid.columns / (2.0 * math.pi))
    # An azimuth just below 0 may be rounded to 2 pi, which is 0 again.
    return row, torch.where(column < grid.columns, column, 0.0)


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


def compensated(images: RecordedImages, velocity: Tensor) -> RecordedImages:
    """Sweeps as seen from their middles, for bodies that move evenly at velocities (B, 6)."""
    shape, offsets = images.points.shape, images.offsets.flatten(1)
    points, normals = images.points.flatten(2).mT, images.normals.flatten(2).mT
    seen = points.square().sum(-1, keepdim=True) > 0.0
    points = compensate(points, offsets, velocity) * seen
    normals = compensate(normals, offsets, velocity, is_direction=True)
    return RecordedImages(
        points.mT.reshape(shape), normals.mT.reshape(shape), torch.zeros_like(images.offsets), images.low, images.high
    )
