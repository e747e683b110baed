"""Images of sweeps in torch: rotated, mirrored and motion compensated."""

import math

import torch
from torch import Tensor

from lidarslam.odometry.network.torch_geometry import skew


def rotate_columns(images: Tensor, shift: Tensor) -> Tensor:
    """Images of the clouds turned about z by whole columns, to the left (x towards y) where positive.

    Args:
        images: (B, C, H, W), C at least 2; channels 0 and 1 are components along x and y, of points or of normals.
        shift: columns, (B,) integers.
    """
    width = images.shape[-1]
    columns = (torch.arange(width, device=images.device) - shift[:, None]).remainder(width)
    moved = images.gather(3, columns[:, None, None, :].expand(images.shape))
    angles = shift.double()[:, None, None] * (2.0 * math.pi / width)
    cos, sin = angles.cos().to(images.dtype), angles.sin().to(images.dtype)
    x, y = moved[:, 0], moved[:, 1]
    turned = torch.stack([cos * x - sin * y, sin * x + cos * y], dim=1)
    return torch.cat([turned, moved[:, 2:]], dim=1)


def mirror(images: Tensor) -> Tensor:
    """Images (B, C, H, W) of the clouds with y negated; channel 1 is the component along y."""
    flipped = images.flip(-1)
    return torch.cat([flipped[:, :1], -flipped[:, 1:2], flipped[:, 2:]], dim=1)


def compensated(points: Tensor, normals: Tensor, offsets: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
    """Points and normals (B, 3, H, W) as seen from the middles of the sweeps.

    Args:
        points, normals: as measured; zero where empty.
        offsets: (B, H, W) seconds from the middle.
        velocity: (B, 6) of bodies that move evenly, rotation first.
    """
    shape, t = points.shape, offsets.flatten(1)[..., None]
    p, n = points.flatten(2).mT, normals.flatten(2).mT
    seen = p.square().sum(-1, keepdim=True) > 0.0
    cross = skew(velocity[:, :3]).mT  # p @ cross is the cross product of the rotation vector with p
    moved = _second_order(p, torch.baddbmm(velocity[:, None, 3:], p, cross), t, cross) * seen
    turned = _second_order(n, n @ cross, t, cross)
    return moved.mT.reshape(shape), turned.mT.reshape(shape)


def _second_order(values: Tensor, first: Tensor, t: Tensor, cross: Tensor) -> Tensor:
    """The exponential map to second order, which is exact to 0.12 mrad for a turn of 10 degrees a sweep."""
    return torch.addcmul(values, t, torch.baddbmm(first, (0.5 * t) * first, cross))
