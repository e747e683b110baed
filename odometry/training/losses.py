"""The geometric losses of DeLORA (Nubert et al., ICRA 2021).

Everything is averaged over the correspondences of each item of the batch. Gradients flow through the moved source
points and normals only: correspondences are taken as given.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from lidarslam.odometry.network.torch_geometry import rotate, transform_points
from lidarslam.odometry.training.config import LossConfig
from lidarslam.odometry.training.correspondence import nearest

# The robust losses gate the distance of a correspondence, and weigh residuals with Huber's kernel of this scale.
_GATE_M, _HUBER_M = 1.0, 0.1


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points of scans and the surfaces they lie on."""

    points: Tensor  # (B, N, 3), metres, in the frame of each scan; zero where there is none. Finite everywhere.
    normals: Tensor  # (B, N, 3), unit where valid. Finite everywhere.
    valid: Tensor  # (B, N) bool, which points have a normal


@dataclass(frozen=True, eq=False)
class GeometricLoss:
    """A loss and its parts, (B,) each; parts that are switched off are there, but not in the total."""

    total: Tensor  # the objective
    point_to_plane: Tensor  # m^2 (also with the robust kernel)
    plane_to_plane: Tensor  # no unit
    matched_share: Tensor  # correspondences, of the source points with a normal, 0 to 1


def geometric_loss(T_prev_curr: Tensor, source: Surfaces, target: Surfaces, config: LossConfig) -> GeometricLoss:
    """Losses of motions (B, 4, 4) that move the current scans (source) onto the previous ones (target).

    Each source point corresponds to the nearest target point: with a normal for the robust losses; for the paper's any
    point, and pairs without two normals are left out. Point-to-plane is the mean of r^2 (equation 1 of the paper), or
    of Huber's kernel, r^2 up to s and 2 s |r| - s^2 beyond; plane-to-plane the mean of |n - m|^2, which is 2 - 2 cos of
    the angle between the normals (equation 2).
    """
    points, normals = transform_points(T_prev_curr, source.points), rotate(T_prev_curr, source.normals)
    eligible = target.valid if config.robust else (target.points != 0.0).any(-1)
    index, distance = nearest(points.detach(), target.points, eligible)
    counts = source.valid & target.valid.gather(1, index) & distance.isfinite()
    if config.robust:
        counts &= distance <= _GATE_M
    weight = counts.to(points.dtype)
    target_normals = _pick(target.normals, index)
    residual = ((points - _pick(target.points, index)) * target_normals).sum(-1)
    squared = _huber(residual) if config.robust else residual.square()
    point_to_plane = _mean(squared, weight)
    plane_to_plane = _mean((normals - target_normals).square().sum(-1), weight)
    total = torch.zeros_like(point_to_plane)
    if config.point_to_plane:
        total = total + point_to_plane
    if config.plane_to_plane:
        total = total + plane_to_plane
    return GeometricLoss(total, point_to_plane, plane_to_plane, weight.sum(1) / source.valid.sum(1).clamp(min=1))


def _huber(residual: Tensor) -> Tensor:
    return 2.0 * functional.huber_loss(residual, torch.zeros_like(residual), reduction="none", delta=_HUBER_M)


def _pick(values: Tensor, index: Tensor) -> Tensor:
    """Values (B, M, 3) at index (B, N), giving (B, N, 3)."""
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """The weighted mean (B,) of values (B, N); zero, with a gradient of zero, without any weight."""
    return (values * weight).sum(1) / weight.sum(1).clamp(min=1.0)
