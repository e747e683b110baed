"""Learning rate, optimizer, loss and validation of a training; devices, files and curves are the caller's."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from lidarslam.odometry.network.checkpoint import torch_search
from lidarslam.odometry.training.config import TrainingConfig
from lidarslam.odometry.training.losses import motion_error
from lidarslam.odometry.training.preparation import PreparedRecording

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
    return summarise(torch.cat(errors), torch.cat(sigmas))


def summarise(errors: Tensor, sigmas: Tensor) -> Validation:
    """Statistics of errors (N, 6) with standard deviations (N, 6)."""
    if not len(errors):
        return Validation(math.nan, math.nan, math.nan, math.nan, (math.nan, math.nan, math.nan), 0)
    rotation = torch.rad2deg(errors[:, :3].norm(dim=1))
    translation = errors[:, 3:].norm(dim=1)
    covered = [100.0 * float((errors.abs() <= k * sigmas).float().mean()) for k in (1, 2, 3)]
    return Validation(
        float(rotation.square().mean().sqrt()), float(translation.square().mean().sqrt()),
        float(rotation.median()), float(translation.median()),
        (covered[0], covered[1], covered[2]), len(errors),
    )  # fmt: skip
