"""What training minimises: the paper's geometric losses, and the distance to the motion that alignment finds."""

import math
from dataclasses import dataclass

import torch
from torch import Generator, Tensor
from torch.nn import functional

from odometry.correlation import Estimate
from odometry.losses import Surfaces, geometric_loss
from odometry.pairs import PairBatch
from odometry.torch_geometry import inverse, log
from odometry.torch_images import has_normal
from odometry.training_config import TrainingConfig

# Errors are squared up to this size, a degree and five centimetres, where they cost a half; beyond they cost linearly.
_ROTATION = math.radians(1.0)
_TRANSLATION_M = 0.05


@dataclass(frozen=True, eq=False)
class Objective:
    """A loss and its parts, means over the pairs that are believed; parts that are switched off are zero."""

    total: Tensor
    alignment: Tensor
    confidence: Tensor
    turn: Tensor
    point_to_plane: Tensor
    plane_to_plane: Tensor


def objective(estimate: Estimate, batch: PairBatch, config: TrainingConfig, generator: Generator) -> Objective:
    """The loss of a batch; the generator draws the points that the geometric losses look at."""
    zero = estimate.log_sigma.new_zeros(())
    total, alignment, confidence, turn, planes, normals = zero, zero, zero, zero, zero, zero
    if config.alignment_weight:
        error = motion_error(estimate.T_prev_curr, batch.T_prev_curr)
        alignment = _mean(_distance(error), batch.believed)
        confidence = _mean(_negative_log_likelihood(error, estimate.log_sigma), batch.believed)
        if estimate.turn_scores.shape[1]:
            turn = _mean(_turn_loss(estimate.turn_scores, batch.T_prev_curr), batch.believed)
        total = total + config.alignment_weight * (alignment + 0.1 * confidence + 0.5 * turn)
    surfaces = batch.previous_surfaces, batch.current_surfaces
    if config.geometric is not None and surfaces[0] is not None and surfaces[1] is not None:
        current = _surfaces(surfaces[1], config.geometric_points, generator)
        loss = geometric_loss(estimate.T_prev_curr, current, _surfaces(surfaces[0]), config.geometric)
        planes, normals = (_mean(part, batch.believed) for part in (loss.point_to_plane, loss.plane_to_plane))
        total = total + config.geometric_weight * _mean(loss.total, batch.believed)
    return Objective(total, alignment, confidence, turn, planes, normals)


def motion_error(T_prev_curr: Tensor, target: Tensor) -> Tensor:
    """(B, 6) change from the left that takes the target to the estimate, rotation first."""
    return log(T_prev_curr @ inverse(target))


def _distance(error: Tensor) -> Tensor:
    """(B,) rotation and translation, each in its unit, squared when small and linear when large."""
    rotation = error[:, :3].norm(dim=1) / _ROTATION
    translation = error[:, 3:].norm(dim=1) / _TRANSLATION_M
    return functional.smooth_l1_loss(
        torch.stack([rotation, translation], dim=1), error.new_zeros(len(error), 2), reduction="none"
    ).sum(dim=1)


def _negative_log_likelihood(error: Tensor, log_sigma: Tensor) -> Tensor:
    """(B,) of errors that are distributed as Laplace said, each direction with its own standard deviation.

    Its gradient reaches the confidence alone: were the motion drawn by it as well, pairs that are hard would be
    given up rather than learnt.
    """
    scale = math.sqrt(2.0)
    return (scale * error.detach().abs() * (-log_sigma).exp() + log_sigma).sum(dim=1)


def _turn_loss(scores: Tensor, target: Tensor) -> Tensor:
    """(B,) cross entropy of the scores of turns (B, W') with the turn about z, shared by the two columns around it."""
    width = scores.shape[1]
    column = torch.atan2(target[:, 1, 0], target[:, 0, 0]).remainder(2.0 * math.pi) * (width / (2.0 * math.pi))
    low = column.floor()
    share = column - low
    likelihood = scores.log_softmax(dim=1)
    both = torch.stack([low, low + 1.0], dim=1).long().remainder(width)
    weights = torch.stack([1.0 - share, share], dim=1)
    return -(likelihood.gather(1, both) * weights).sum(dim=1)


def _mean(values: Tensor, believed: Tensor) -> Tensor:
    return (values * believed).sum() / believed.sum().clamp(min=1)


def _surfaces(images: Tensor, most: int | None = None, generator: Generator | None = None) -> Surfaces:
    """The pixels of images (B, 6, H, W), or as many of them with a normal as are wanted, drawn at random."""
    values = images.flatten(2).mT  # (B, N, 6)
    if most is not None and most < values.shape[1]:
        order = torch.rand(values.shape[:2], generator=generator).to(values.device) + has_normal(values[..., 3:], -1)
        values = values.gather(1, order.topk(most, dim=1).indices[..., None].expand(-1, -1, 6))
    points, normals = values[..., :3], values[..., 3:]
    return Surfaces(points, normals, has_normal(normals, -1))
