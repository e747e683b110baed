"""The objective of training: the paper's geometric losses, and the distance from the pseudo-labels."""

import math
from dataclasses import dataclass

import torch
from torch import Generator, Tensor
from torch.nn import functional

from lidarslam.odometry.images import bird_eye
from lidarslam.odometry.network.pair_network import Estimate, has_normal
from lidarslam.odometry.network.torch_geometry import inverse, log
from lidarslam.odometry.training.augmentation import PairBatch
from lidarslam.odometry.training.config import TrainingConfig
from lidarslam.odometry.training.losses import Surfaces, geometric_loss

# Points of the current scan that the geometric losses use.
_GEOMETRIC_POINTS = 1024
# Errors are squared up to this size, a degree and five centimetres, where they cost a half; beyond they cost linearly.
_ROTATION = math.radians(1.0)
_TRANSLATION_M = 0.05
# Two columns and two cells: within these an error is that of the right peak.
_NEAR_ROTATION, _NEAR_TRANSLATION_M = math.radians(4.0), 1.0


@dataclass(frozen=True, eq=False)
class Objective:
    """A loss and its parts, means over the valid pairs; parts that are switched off are zero."""

    total: Tensor
    alignment: Tensor
    confidence: Tensor
    turn: Tensor
    shift: Tensor
    point_to_plane: Tensor
    plane_to_plane: Tensor


def objective(estimate: Estimate, batch: PairBatch, config: TrainingConfig, generator: Generator) -> Objective:
    """The loss of a batch; the generator draws the points of the geometric losses."""
    zero = estimate.log_sigma.new_zeros(())
    total, alignment, confidence, turn, shift, planes, normals = (zero,) * 7
    if config.alignment_weight:
        error = motion_error(estimate.T_prev_curr, batch.T_prev_curr)
        is_near = _is_near(error) if estimate.turn_scores.shape[1] else torch.ones_like(batch.valid)
        alignment = _mean(_distance(error), batch.valid & is_near)
        confidence = _mean(_negative_log_likelihood(error, estimate.log_sigma), batch.valid)
        if estimate.turn_scores.shape[1]:
            turn = _mean(_turn_loss(estimate.turn_scores, batch.T_prev_curr), batch.valid)
        if estimate.shift_scores.shape[1]:
            cells = batch.T_prev_curr[:, :2, 3] / bird_eye.CELL_M  # (B, 2) along x, along y
            in_reach = cells.abs().amax(1) < bird_eye.MOST_CELLS - 1
            shift = _mean(_shift_loss(estimate.shift_scores, cells), batch.valid & in_reach)
        total = total + config.alignment_weight * (0.3 * alignment + 0.1 * confidence + turn + shift)
    if config.geometric is not None and batch.previous_surfaces is not None and batch.current_surfaces is not None:
        current = _surfaces(batch.current_surfaces, _GEOMETRIC_POINTS, generator)
        loss = geometric_loss(estimate.T_prev_curr, current, _surfaces(batch.previous_surfaces), config.geometric)
        planes, normals = (_mean(part, batch.valid) for part in (loss.point_to_plane, loss.plane_to_plane))
        total = total + _mean(loss.total, batch.valid)
    return Objective(total, alignment, confidence, turn, shift, planes, normals)


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


def _is_near(error: Tensor) -> Tensor:
    """(B,) whether the right peak was found; the position of a wrong one has no useful gradient."""
    rotation, translation = error[:, :3].norm(dim=1), error[:, 3:].norm(dim=1)
    near: Tensor = (rotation < _NEAR_ROTATION) & (translation < _NEAR_TRANSLATION_M)
    return near


def _negative_log_likelihood(error: Tensor, log_sigma: Tensor) -> Tensor:
    """(B,) of errors with a Laplace distribution, each direction with its own standard deviation.

    Its gradient reaches the standard deviations alone: through the motion, hard pairs would be given up.
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


def _shift_loss(scores: Tensor, cells: Tensor) -> Tensor:
    """(B,) cross entropy of the scores of shifts (B, S, S) with a shift (B, 2), shared by the four cells around it."""
    count = scores.shape[-1]
    most = count // 2
    cell = cells.clamp(-most, most - 1e-3) + most
    low = cell.floor()
    share = cell - low  # (B, 2) along x, along y
    column, row = low.long().unbind(1)
    likelihood = scores.flatten(1).log_softmax(dim=1)
    loss = torch.zeros_like(share[:, 0])
    for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
        along_x = share[:, 0] if across else 1.0 - share[:, 0]
        along_y = share[:, 1] if down else 1.0 - share[:, 1]
        index = ((row + down) * count + column + across)[:, None]
        loss = loss - along_x * along_y * likelihood.gather(1, index)[:, 0]
    return loss


def _mean(values: Tensor, valid: Tensor) -> Tensor:
    return (values * valid).sum() / valid.sum().clamp(min=1)


def _surfaces(images: Tensor, most: int | None = None, generator: Generator | None = None) -> Surfaces:
    """The pixels of images (B, 6, H, W), or at most so many of them with a normal, drawn at random."""
    values = images.flatten(2).mT  # (B, N, 6)
    if most is not None and most < values.shape[1]:
        order = torch.rand(values.shape[:2], generator=generator).to(values.device) + has_normal(values[..., 3:], -1)
        values = values.gather(1, order.topk(most, dim=1).indices[..., None].expand(-1, -1, 6))
    points, normals = values[..., :3], values[..., 3:]
    return Surfaces(points, normals, has_normal(normals, -1))
