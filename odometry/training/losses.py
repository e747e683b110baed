"""The objective of training, the geometric losses of DeLORA (Nubert et al., ICRA 2021), and validation.

Everything is averaged over the correspondences of each item of the batch. Gradients flow through the moved source
points and normals only: correspondences are taken as given.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Generator, Tensor, nn
from torch.nn import functional

from lidarslam.odometry.config import LossConfig, TrainingConfig
from lidarslam.odometry.images import bird_eye
from lidarslam.odometry.network.checkpoint import torch_search
from lidarslam.odometry.network.networks import PairEstimate, has_normal
from lidarslam.odometry.network.torch_geometry import inverse, log, rotate, transform_points
from lidarslam.odometry.training.pairs import PairBatch
from lidarslam.odometry.training.preparation import PreparedRecording

# The robust losses gate the distance of a correspondence, and weigh residuals with Huber's kernel of this scale.
_GATE_M, _HUBER_M = 1.0, 0.1


class Surfaces(NamedTuple):
    """Points of scans and the surfaces they lie on."""

    points: Tensor  # (B, N, 3), metres, in the frame of each scan; zero where there is none. Finite everywhere.
    normals: Tensor  # (B, N, 3), unit where valid. Finite everywhere.
    valid: Tensor  # (B, N) bool, which points have a normal


class GeometricLoss(NamedTuple):
    """A loss and its parts, (B,) each; parts that are switched off are there, but not in the total."""

    total: Tensor  # the objective
    point_to_plane: Tensor  # m^2 (also with the robust kernel)
    plane_to_plane: Tensor  # no unit


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
    huber = 2.0 * functional.huber_loss(residual, torch.zeros_like(residual), reduction="none", delta=_HUBER_M)
    point_to_plane = _mean(huber if config.robust else residual.square(), weight)
    plane_to_plane = _mean((normals - target_normals).square().sum(-1), weight)
    total = config.point_to_plane * point_to_plane + config.plane_to_plane * plane_to_plane
    return GeometricLoss(total, point_to_plane, plane_to_plane)


def _pick(values: Tensor, index: Tensor) -> Tensor:
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """The weighted mean (B,) of values (B, N); zero, with a gradient of zero, without any weight."""
    return (values * weight).sum(1) / weight.sum(1).clamp(min=1.0)


# Distances held at once by the brute-force search: 256 MiB in float32.
_MAX_DISTANCES = 1 << 26


@torch.no_grad()
def nearest(query: Tensor, reference: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest valid (B, M) of finite reference points (B, M, 3) to each query (B, N, 3): index and distance (B, N).

    By a k-d tree on the CPU, by all distances on other devices. Without a valid reference, or where the query is not
    finite, the index is 0 and the distance infinite.
    """
    index = torch.zeros(query.shape[:2], dtype=torch.int64, device=query.device)
    distance = query.new_full(query.shape[:2], torch.inf)
    search = _by_kd_tree if query.device.type == "cpu" else _by_all_distances
    for item in range(len(query)):
        (candidates,), (asked,) = (x.nonzero(as_tuple=True) for x in (valid[item], query[item].isfinite().all(-1)))
        if len(candidates) and len(asked):
            found, lengths = search(query[item, asked], reference[item, candidates])
            index[item, asked], distance[item, asked] = candidates[found], lengths.to(distance)
    return index, distance


def _by_kd_tree(query: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    # Splitting at the middle instead of the median builds faster, which counts as every tree is used once.
    lengths, found = cKDTree(reference.numpy(), balanced_tree=False, compact_nodes=False).query(query.numpy())
    return torch.from_numpy(found), torch.from_numpy(lengths)


def _by_all_distances(query: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    """Likewise, of which no more than `_MAX_DISTANCES` are held at a time."""
    # Not by |q|^2 + |r|^2 - 2 q.r, which in float32 is centimetres off at 100 m.
    chunks = [
        torch.cdist(part, reference, compute_mode="donot_use_mm_for_euclid_dist").min(dim=1)
        for part in torch.split(query, max(1, _MAX_DISTANCES // len(reference)))
    ]
    return torch.cat([chunk.indices for chunk in chunks]), torch.cat([chunk.values for chunk in chunks])


# Points of the current scan that the geometric losses use.
_GEOMETRIC_POINTS = 1024
# Errors are squared up to this size, a degree and five centimetres, where they cost a half; beyond they cost linearly.
_ROTATION = math.radians(1.0)
_TRANSLATION_M = 0.05
# Two columns and two cells: within these an error is that of the right peak.
_NEAR_ROTATION, _NEAR_TRANSLATION_M = math.radians(4.0), 2.0


class Objective(NamedTuple):
    """A loss and its parts, means over the valid pairs; parts that are switched off are zero."""

    total: Tensor
    alignment: Tensor
    confidence: Tensor
    turn: Tensor
    shift: Tensor
    point_to_plane: Tensor
    plane_to_plane: Tensor


def objective(estimate: PairEstimate, batch: PairBatch, config: TrainingConfig, generator: Generator) -> Objective:
    """The loss of a batch; the generator draws the points of the geometric losses."""
    zero = estimate.log_sigma.new_zeros(())
    total, alignment, confidence, turn, shift, planes, normals = (zero,) * 7
    if config.alignment_weight:
        error = motion_error(estimate.T_prev_curr, batch.T_prev_curr)
        scale = torch.ones_like(batch.T_prev_curr[:, 0, 0]) if batch.scale is None else batch.scale
        is_near = torch.ones_like(batch.valid)
        if estimate.turn_scores.shape[1]:  # the position of a wrong peak has no useful gradient
            rotation, translation = error[:, :3].norm(dim=1), error[:, 3:].norm(dim=1)
            is_near = (rotation < _NEAR_ROTATION) & (translation * scale < _NEAR_TRANSLATION_M)
        alignment = _mean_of_valid(_distance(error), batch.valid & is_near)
        confidence = _mean_of_valid(_negative_log_likelihood(error, estimate.log_sigma), batch.valid)
        if estimate.turn_scores.shape[1]:
            turn = _mean_of_valid(_turn_loss(estimate.turn_scores, batch.T_prev_curr), batch.valid)
        if estimate.shift_scores.shape[1]:
            cells = batch.T_prev_curr[:, :2, 3] * scale[:, None] / bird_eye.CELL_M  # (B, 2) along x, along y
            in_reach = cells.abs().amax(1) < bird_eye.MOST_CELLS - 1
            shift = _mean_of_valid(_shift_loss(estimate.shift_scores, cells), batch.valid & in_reach)
        total = total + config.alignment_weight * (0.3 * alignment + 0.1 * confidence + turn + shift)
    if config.geometric is not None and batch.surfaces is not None:
        current = _surfaces(batch.surfaces[:, 1], _GEOMETRIC_POINTS, generator)
        loss = geometric_loss(estimate.T_prev_curr, current, _surfaces(batch.surfaces[:, 0]), config.geometric)
        planes, normals = (_mean_of_valid(part, batch.valid) for part in (loss.point_to_plane, loss.plane_to_plane))
        total = total + _mean_of_valid(loss.total, batch.valid)
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
    for down, along_y in enumerate((1.0 - share[:, 1], share[:, 1])):
        for across, along_x in enumerate((1.0 - share[:, 0], share[:, 0])):
            index = ((row + down) * count + column + across)[:, None]
            loss = loss - along_x * along_y * likelihood.gather(1, index)[:, 0]
    return loss


def _mean_of_valid(values: Tensor, valid: Tensor) -> Tensor:
    return (values * valid).sum() / valid.sum().clamp(min=1)


def _surfaces(images: Tensor, most: int | None = None, generator: Generator | None = None) -> Surfaces:
    """The pixels of images (B, 6, H, W), or at most `most` of them with a normal, drawn at random."""
    values = images.flatten(2).mT  # (B, N, 6)
    if most is not None and most < values.shape[1]:
        order = torch.rand(values.shape[:2], generator=generator).to(values.device) + has_normal(values[..., 3:], -1)
        values = values.gather(1, order.topk(most, dim=1).indices[..., None].expand(-1, -1, 6))
    points, normals = values[..., :3], values[..., 3:]
    return Surfaces(points, normals, has_normal(normals, -1))


_LEAST_RATE = 0.01  # of the learning rate, at the end
_WEIGHT_DECAY = 1e-3


@dataclass(frozen=True)
class Validation:
    """Errors of a network against the pseudo-labels of recordings that it is not trained on."""

    # rotation_rms_deg, translation_rms_m: over all valid pairs
    rotation_rms_deg: float
    translation_rms_m: float
    # rotation_median_deg, translation_median_m: likewise
    rotation_median_deg: float
    translation_median_m: float
    covered_percent: tuple[float, float, float]  # of the errors that lie within one, two and three standard deviations
    pairs: int  # their number; without any, all else is NaN


def learning_rate(step: int, config: TrainingConfig) -> float:
    """Rises linearly, then falls along half a cosine."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    done = (step - config.warmup_steps) / max(1, config.steps - config.warmup_steps)
    return config.learning_rate * (_LEAST_RATE + (1.0 - _LEAST_RATE) * 0.5 * (1.0 + math.cos(math.pi * done)))


def make_optimizer(network: nn.Module, config: TrainingConfig) -> torch.optim.Optimizer:
    """AdamW; biases, scales and the like are not decayed."""
    decayed = [p for p in network.parameters() if p.ndim > 1]
    others = [p for p in network.parameters() if p.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": _WEIGHT_DECAY}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, 0.98))


def validate(
    network: nn.Module, recordings: Sequence[PreparedRecording], device: torch.device | str = "cpu"
) -> Validation:
    """Every pair of consecutive scans whose label is valid, as it is.

    The network, in evaluation mode, answers as in use: by its most probable candidate.
    """
    errors, sigmas = [torch.zeros(0, 6)], [torch.zeros(0, 6)]
    search = torch_search(network, device)
    for recording in recordings:
        points, normals = recording.points.numpy(), recording.normals.float().numpy()
        before = search.describe(points[0], normals[0])
        for number, (label, is_valid) in enumerate(zip(recording.T_prev_curr, recording.valid, strict=True), start=1):
            candidates, before = search.compare(before, points[number], normals[number])
            if is_valid:
                T_prev_curr = torch.from_numpy(candidates[0].T_prev_curr).float()
                errors.append(motion_error(T_prev_curr[None], label[None]))
                sigmas.append(torch.from_numpy(np.sqrt(np.diag(candidates[0].covariance))).float()[None])
    error, sigma = torch.cat(errors), torch.cat(sigmas)  # (N, 6)
    rotation, translation = torch.rad2deg(error[:, :3].norm(dim=1)), error[:, 3:].norm(dim=1)
    covered = [100.0 * float((error.abs() <= k * sigma).float().mean()) for k in (1, 2, 3)]
    return Validation(
        float(rotation.square().mean().sqrt()), float(translation.square().mean().sqrt()),
        float(rotation.median()), float(translation.median()),
        (covered[0], covered[1], covered[2]), len(error),
    )  # fmt: skip
