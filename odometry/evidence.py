"""What two scans show of the motion between them before anything is learned: distances from planes.

For a network that compares features of blocks of pixels. What it would have to work out from the features with many
digits, how far each point lies from the plane in the same pixel of the other scan and what motion that speaks for, is
given to it. All in the frame of each column: turning both scans by whole columns shifts it and changes nothing else.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

from odometry.torch_images import has_normal

BLOCK = 4
"""Rows and columns of pixels that make a cell of features."""
PACKED_CHANNELS = 6 * BLOCK * BLOCK
"""Channels of `pack`."""
EVIDENCE_CHANNELS = 20
"""Channels of `evidence`."""

# Distances from planes, metres, up to which points count as the same surface: after small motions, and large ones.
_SCALES_M = (0.3, 2.0)
# Normals that are turned by more than the angle of this cosine belong to different surfaces.
_LEAST_COSINE = 0.8
# Of the angle that a distance from a plane speaks for, radians, so that the channel is about one.
_ANGLE = 0.05


def pack(points: Tensor, normals: Tensor) -> Tensor:
    """Points and normals (B, 3, H, W) in the frames of their columns, the pixels of each block as channels.

    Returns:
        (B, PACKED_CHANNELS, H / BLOCK, W / BLOCK): outwards, sideways and up, of points and then of normals.
    """
    width = points.shape[-1]
    azimuth = (torch.arange(width, device=points.device, dtype=points.dtype) + 0.5) * (2.0 * math.pi / width)
    cos, sin = azimuth.cos(), azimuth.sin()
    turned = [
        part
        for vectors in (points, normals)
        for part in (
            cos * vectors[:, 0] + sin * vectors[:, 1], cos * vectors[:, 1] - sin * vectors[:, 0], vectors[:, 2]
        )
    ]  # fmt: skip
    return functional.pixel_unshuffle(torch.stack(turned, dim=1), BLOCK)


def evidence(previous: Tensor, current: Tensor) -> Tensor:
    """What points of the current scan say of the motion, block by block, if they belong where the same pixels show.

    Args:
        previous, current: (B, PACKED_CHANNELS, H', W') of `pack`.

    Returns:
        (B, EVIDENCE_CHANNELS, H', W'), each about one: for each of two scales the weighted means of distance times
        normal and of the angle about each axis, and the weight; the change of the normals; the squares of the normals.
    """
    size, _, height, width = previous.shape
    cells = [packed.view(size, 2, 3, BLOCK * BLOCK, height, width) for packed in (previous, current)]
    (points, planes), (moved, normals) = (cell.unbind(1) for cell in cells)  # (B, 3, BLOCK^2, H', W') each
    distance = ((moved - points) * planes).sum(1, keepdim=True)  # (B, 1, BLOCK^2, H', W')
    both = has_normal(planes, 1) & has_normal(normals, 1) & ((planes * normals).sum(1) > _LEAST_COSINE)
    alike = both.to(points.dtype)[:, None]
    squared = points.square().sum(1, keepdim=True)
    lever = torch.linalg.cross(points, planes, dim=1) / (1.0 + squared)
    channels = []
    for scale in _SCALES_M:
        weight = alike / (1.0 + (distance / scale).square()).square()
        total = weight.sum(2) + 1.0
        channels += [
            (weight * distance * planes).sum(2) / (total * scale),
            (weight * distance * lever).sum(2) / (total * _ANGLE),
            weight.sum(2) / BLOCK**2,
        ]
    count = alike.sum(2) + 1.0
    channels += [10.0 * (alike * (normals - planes)).sum(2) / count, (alike * planes.square()).sum(2) / count]
    return torch.cat(channels, dim=1)
