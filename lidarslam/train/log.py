"""The log of a training: tables of losses and validations, and curves and pictures for TensorBoard."""

import csv
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.tensorboard.writer import SummaryWriter

from lidarslam.train import directory as files
from odometry.network.correlation import CorrelationNetwork
from odometry.training.preparation import PreparedRecording
from odometry.training.training import Validation

# Pairs whose turn scores are shown beneath one another, and how often a row is repeated so that it can be seen.
_SHOWN_PAIRS = 32
_TALL = 4


class TrainingLog:
    """Appends to the tables; lines after the step that the training goes on from are dropped."""

    def __init__(self, out: Path, step: int) -> None:
        self._out = out
        for name in (files.LOSSES, files.VALIDATION):
            _cut(out / name, step)
        self._curves = SummaryWriter(str(out / files.CURVES), purge_step=step + 1 if step else None)

    def losses(self, step: int, row: Mapping[str, float]) -> None:
        """Means since the last line."""
        self._write(files.LOSSES, "training", step, row)

    def validation(self, step: int, result: Validation) -> None:
        """Errors on held-out recordings."""
        values = vars(result).copy()
        for k, percent in enumerate(values.pop("covered_percent"), start=1):
            values[f"covered_{k}_sigma_percent"] = percent
        self._write(files.VALIDATION, "validation", step, values)
        self._curves.flush()

    def inputs(self, step: int, recording: PreparedRecording) -> None:
        """Ranges and normals of the first two scans, above one another."""
        points, normals = recording.images.points[:2], recording.images.normals[:2].float()
        ranges = points.square().sum(1, keepdim=True).sqrt()  # (2, 1, H, W)
        near = (ranges > 0.0) / (1.0 + 0.1 * ranges)
        self._curves.add_image("pair/nearness", _stacked(near), step)
        self._curves.add_image("pair/normals", _stacked(0.5 + 0.5 * normals), step)

    @torch.no_grad()
    def turn_scores(self, step: int, network: nn.Module, recording: PreparedRecording, device: torch.device) -> None:
        """Probabilities of turns: a row for each pair, zero turn in the middle."""
        if not isinstance(network, CorrelationNetwork):
            return
        points, normals = (
            images[: _SHOWN_PAIRS + 1].float().to(device)
            for images in (recording.images.points, recording.images.normals)
        )
        features = network.columns(points, normals)
        likely = network.turn_scores(features[:-1], features[1:]).softmax(dim=1)
        likely = (likely / likely.amax(dim=1, keepdim=True)).roll(likely.shape[1] // 2, dims=1)
        self._curves.add_image("pairs/turn_probability", likely.repeat_interleave(_TALL, dim=0)[None].cpu(), step)

    def close(self) -> None:
        """Write what is left."""
        self._curves.close()

    def _write(self, table: str, curves: str, step: int, row: Mapping[str, float]) -> None:
        _append(self._out / table, {"step": step, **row})
        for name, value in row.items():
            self._curves.add_scalar(f"{curves}/{name}", value, step)


def _stacked(images: Tensor) -> Tensor:
    """Images (B, C, H, W) above one another, each row several times: (C, B H _TALL, W)."""
    return torch.cat(list(images.repeat_interleave(_TALL, dim=2)), dim=1)


def _append(path: Path, row: Mapping[str, object]) -> None:
    is_new = not path.exists()
    with path.open("a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def _cut(path: Path, step: int) -> None:
    """Keep the lines up to a step."""
    if not path.exists():
        return
    with path.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if int(row["step"]) <= step]
    path.unlink()
    for row in rows:
        _append(path, row)
