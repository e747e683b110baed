"""Surface normals of range images: planes fitted to each pixel's neighbourhood."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from odometry import normal_kernels as kernels
from odometry.normal_config import NormalConfig

Floats = NDArray[np.float32]

# A neighbourhood that is narrower than this share of its range is narrower than the rounding of its coordinates.
_NARROWEST = 1e-5
# Range noise spreads the points of a single ring over a plane that holds the rays themselves. Such a plane, 2.3
# degrees or less from the ray, says nothing of the surface, and which of its sides faces the sensor is chance.
_MOST_GRAZING = 0.04
_TINY = 1e-30


def has_normal(normals: Tensor, dim: int) -> Tensor:
    """Which pixels or points have a normal: those where there is none hold zeros along the dimension of x, y and z."""
    return normals.square().sum(dim=dim) > 0.5


@torch.no_grad()
def surface_normals(images: Tensor, config: NormalConfig) -> Tensor:
    """Unit normals (B, 3, H, W) float32 that face the sensor, zero where the neighbourhood is no plane.

    A principal component analysis of the points around each pixel whose ranges are close to its own, as in DeLORA
    (Nubert et al. 2021). Neighbourhoods go on across the seam of azimuth; above and below the image nothing is.
    No gradient flows through them.

    Args:
        images: (B, C, H, W), C at least 4: x, y, z and range in metres in the sensor's frame, zero where empty.
        config: which neighbours count, and which neighbourhoods are planes.

    Raises:
        ValueError: images have another shape, or are narrower than the neighbourhood.
    """
    if images.ndim != 4 or images.shape[1] < 4:
        raise ValueError(f"images must be (B, at least 4, H, W), got {tuple(images.shape)}")
    if images.shape[3] < 2 * max(config.columns, config.wide_columns) + 1:
        raise ValueError(f"images of {images.shape[3]} columns are narrower than the neighbourhood")
    images = images[:, :4].float()
    if images.device.type == "cpu":
        return torch.stack([_compiled(image, config) for image in images]) if len(images) else images[:, :3].clone()
    return _on_any_device(images, config)


def _compiled(image: Tensor, config: NormalConfig) -> Tensor:
    """Normals (3, H, W) of one image (4, H, W) in the processor's memory."""
    values = np.ascontiguousarray(image.numpy())
    normals = np.zeros((3, *values.shape[1:]), dtype=np.float32)
    taken = np.zeros(values.shape[1:], dtype=np.bool_)
    tries = [(config.gate_m, config.columns)]
    if config.wide_gate_m is not None:
        tries.append((config.wide_gate_m, config.wide_columns))
    for gate_m, columns in tries:
        around = kernels.Neighbourhood(
            rows=config.rows, columns=columns, gate_m=gate_m, most_apart_m=2.0 * config.gate_m,
            min_neighbours=config.min_neighbours, max_flatness=config.max_flatness, min_spread=config.min_spread,
        )  # fmt: skip
        kernels.planes(values, _padded(values, config.rows, columns), taken, around, normals)
        taken = np.asarray((normals != 0.0).any(axis=0), dtype=np.bool_)
    return torch.from_numpy(normals)


def _padded(image: Floats, rows: int, columns: int) -> Floats:
    """The image (4, H, W) with so many rows above and below, and columns that go on round; infinitely far if empty."""
    padded = np.pad(image, ((0, 0), (0, 0), (columns, columns)), mode="wrap")
    padded = np.pad(padded, ((0, 0), (rows, rows), (0, 0)))
    padded[3][padded[3] <= 0.0] = np.inf
    return padded


def _on_any_device(images: Tensor, config: NormalConfig) -> Tensor:
    """Normals (B, 3, H, W) of images (B, 4, H, W)."""
    normals = _planes(images, config, config.gate_m, config.columns)
    if config.wide_gate_m is not None:
        missing = ~has_normal(normals, 1)[:, None] & (images[:, 3:] > 0.0)
        normals = torch.where(missing, _planes(images, config, config.wide_gate_m, config.wide_columns), normals)
    return normals


def _planes(images: Tensor, config: NormalConfig, gate_m: float, columns: int) -> Tensor:
    """Normals (B, 3, H, W) from neighbourhoods of one size, zero where they are no planes."""
    count, nearest_m2, covariance = _scatter(images, config.rows, columns, gate_m)
    size = covariance[0] + covariance[1] + covariance[2]
    # Rounding may leave next to nothing, or less, of the scatter of points that are all but one.
    scaled = torch.where(size > _TINY, covariance / size.clamp(min=_TINY), 0.0)
    smallest, middle, largest = _eigenvalues(scaled)
    normals = _null_vector(scaled, smallest)
    planar = (smallest <= config.max_flatness * middle) & (middle >= config.min_spread * largest)
    planar &= middle * size > count * (_NARROWEST * images[:, 3]).square()
    planar &= (count >= config.min_neighbours) & (images[:, 3] > 0.0)
    # Far down a corridor both walls lie at one range with nothing between: no plane goes from one to the other.
    planar &= nearest_m2 <= (2.0 * config.gate_m) ** 2
    away = (normals * images[:, :3]).sum(dim=1)
    planar &= away.abs() >= _MOST_GRAZING * images[:, 3]
    return torch.where(planar[:, None], normals * -away.sign()[:, None], 0.0)


def _scatter(images: Tensor, rows: int, columns: int, gate_m: float) -> tuple[Tensor, Tensor, Tensor]:
    """Numbers of neighbours (B, H, W), squared distances to the nearest, and their scatter about the mean.

    The scatter matrices are (6, B, H, W): xx, yy, zz, xy, yz, xz. Sums are of differences to the pixel itself:
    coordinates of tens of metres would leave no digits to float32.
    """
    height, width = images.shape[2:]
    # (4, B, H, W), as all below treats channels alike
    centre = images.transpose(0, 1).contiguous()
    padded = functional.pad(images, (columns, columns, 0, 0), mode="circular")
    padded = functional.pad(padded, (0, 0, rows, rows)).transpose(0, 1).contiguous()
    # Nothing is near to infinity, so one comparison tests both the gate and whether there is a neighbour.
    padded[3].masked_fill_(padded[3] <= 0.0, math.inf)
    count, nearest_m2 = torch.zeros_like(centre[3]), torch.full_like(centre[3], math.inf)
    sums, products = torch.zeros_like(centre[:3]), centre.new_zeros(6, *centre.shape[1:])
    for down in range(2 * rows + 1):
        for right in range(2 * columns + 1):
            around = padded[:, :, down : down + height, right : right + width]
            is_near = (around[3] - centre[3]).abs_() <= gate_m
            near, offset = is_near.float(), around[:3] - centre[:3]
            if (down, right) != (rows, columns):
                torch.minimum(nearest_m2, offset.square().sum(0).masked_fill_(~is_near, math.inf), out=nearest_m2)
            offset.mul_(near)
            count += near
            sums += offset
            products[:3].addcmul_(offset, offset)
            products[3:5].addcmul_(offset[:2], offset[1:])
            products[5].addcmul_(offset[0], offset[2])
    mean = sums / count.clamp(min=1.0)
    products[:3].addcmul_(sums, mean, value=-1.0)
    products[3:5].addcmul_(sums[:2], mean[1:], value=-1.0)
    products[5].addcmul_(sums[0], mean[2], value=-1.0)
    return count, nearest_m2, products


def _eigenvalues(matrices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Eigenvalues (...), ascending, of symmetric matrices (6, ...) of trace 1 or 0: xx, yy, zz, xy, yz, xz.

    Smith, "Eigenvalues of a symmetric 3 x 3 matrix", 1961. Where the two larger ones are nearly equal their
    difference is inexact, but not the smallest.
    """
    third = (matrices[0] + matrices[1] + matrices[2]) / 3.0
    xx, yy, zz = (matrices[:3] - third).unbind()
    xy, yz, xz = matrices[3:].unbind()
    squares = xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + yz * yz + xz * xz)
    radius = (squares / 6.0).sqrt()
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    cosine = determinant / (2.0 * radius.clamp(min=1e-9) ** 3)
    angle = cosine.clamp(-1.0, 1.0).acos() / 3.0
    largest = third + 2.0 * radius * angle.cos()
    smallest = third + 2.0 * radius * (angle + 2.0 * math.pi / 3.0).cos()
    return smallest, 3.0 * third - largest - smallest, largest


def _null_vector(matrices: Tensor, eigenvalue: Tensor) -> Tensor:
    """Unit vectors (B, 3, H, W) to an eigenvalue (B, H, W) of symmetric matrices (6, B, H, W); zero if it is double.

    The rows of A - eigenvalue I are all at right angles to it, so it is the cross product of any two; the longest
    of the three products is the most exact.
    """
    xx, yy, zz = (matrices[:3] - eigenvalue).unbind()
    xy, yz, xz = matrices[3:].unbind()
    # The three products are the columns of the adjugate, which is symmetric and of rank one.
    off_xy, off_yz, off_xz = xz * yz - xy * zz, xy * xz - xx * yz, xy * yz - xz * yy
    first = torch.stack([yy * zz - yz * yz, off_xy, off_xz], dim=1)
    second = torch.stack([off_xy, xx * zz - xz * xz, off_yz], dim=1)
    third = torch.stack([off_xz, off_yz, xx * yy - xy * xy], dim=1)
    best = torch.where((first[:, 0] >= second[:, 1])[:, None], first, second)
    best_on_diagonal = torch.maximum(first[:, 0], second[:, 1])
    best = torch.where((best_on_diagonal >= third[:, 2])[:, None], best, third)
    return best / best.square().sum(dim=1, keepdim=True).sqrt().clamp(min=_TINY)
