"""Pairs of scans for training, drawn at random; the same seed and step give the same pairs."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor

from lidarslam.odometry.images.bird_eye import bird_eye
from lidarslam.odometry.network.torch_geometry import inverse, log
from lidarslam.odometry.training.augmentation import AUGMENTATION, Augmentation, PairBatch, augmented
from lidarslam.odometry.training.preparation import PreparedRecording
from lidarslam.odometry.training.torch_images import compensated

# A prime that keeps the random streams of steps and processes apart.
_STREAM = 1_000_003
# Seeds of a generator are below this.
_SEEDS = 2**63


class Pairs:
    """Draws batches of pairs from recordings.

    Args:
        recordings: to draw from.
        seed: of all draws.
        surfaces: whether the losses need compensated scans.
        birds: whether the network looks from above.
        weights: how often each recording is drawn, relative to the others; None: equally often.
        augmentation: how pairs are changed.
    """

    def __init__(
        self,
        recordings: Sequence[PreparedRecording],
        seed: int,
        surfaces: bool = True,
        birds: bool = True,
        weights: Sequence[float] | None = None,
        augmentation: Augmentation = AUGMENTATION,
    ) -> None:
        if not recordings:
            raise ValueError("training needs a recording or more, got none")
        self._recordings = recordings
        self._seed = seed
        self._surfaces = surfaces
        self._birds = birds
        self._weights = torch.tensor([1.0] * len(recordings) if weights is None else weights, dtype=torch.float64)
        self._augmentation = augmentation

    def batch(self, step: int, size: int, process: int = 0) -> PairBatch:
        """The pairs of one step."""
        generator = torch.Generator().manual_seed((self._seed * _STREAM**2 + step * _STREAM + process) % _SEEDS)
        pairs = augmented(_stack([self._draw(generator) for _ in range(size)]), self._augmentation, generator)
        return self._seen_from_above(pairs, generator) if self._birds else pairs

    def _draw(self, generator: Generator) -> PairBatch:
        recording = self._recordings[int(torch.multinomial(self._weights, 1, generator=generator))]
        gap = _gap(generator, min(self._augmentation.max_gap, len(recording) - 1))
        first = int(torch.randint(len(recording) - gap, (), generator=generator))
        pair = pair_of(recording, first, first + gap, self._surfaces)
        is_reversed = float(torch.rand((), generator=generator)) < self._augmentation.reverse
        return _reversed(pair) if is_reversed else pair

    def _seen_from_above(self, batch: PairBatch, generator: Generator) -> PairBatch:
        """The pairs with bird's-eye grids; the turn between the scans is known to within an error."""
        size = len(batch.previous)
        turns = torch.atan2(batch.T_prev_curr[:, 1, 0], batch.T_prev_curr[:, 0, 0])
        errors = torch.randn(size, generator=generator) * math.radians(self._augmentation.bird_turn_deg)
        return replace(
            batch,
            bird_previous=birds(batch.previous, torch.zeros(size)),
            bird_current=birds(batch.current, turns + errors),
        )


def _gap(generator: Generator, most: int) -> int:
    """Steps from 1 to the most, each as likely as all up to twice as many together: small ones are common."""
    exponent = float(torch.rand((), generator=generator, dtype=torch.float64))
    return min(int((most + 1.0) ** exponent), most)


def birds(images: Tensor, headings: Tensor) -> Tensor:
    """Bird's-eye grids (B, CHANNELS, CELLS, CELLS) of points and normals (B, 6, H, W), turned by headings (B,)."""
    grids = [
        bird_eye(image[:3].numpy(), image[3:].numpy(), float(heading))
        for image, heading in zip(images, headings, strict=True)
    ]
    return torch.from_numpy(np.stack(grids))


def pair_of(recording: PreparedRecording, previous: int, current: int, surfaces: bool = True) -> PairBatch:
    """One pair of a recording, as it is."""
    T = torch.eye(4)
    for motion in recording.T_prev_curr[previous:current]:
        T = T @ motion
    raw = [
        torch.cat([recording.points[i], recording.normals[i].float()])[None]  # (1, 6, H, W)
        for i in (previous, current)
    ]
    still = [_compensated(recording, i) if surfaces else None for i in (previous, current)]
    valid = recording.valid[previous:current].all()
    return PairBatch(raw[0], raw[1], still[0], still[1], T[None], valid[None])


def _compensated(recording: PreparedRecording, scan: int) -> Tensor:
    """(1, 6, H, W) a scan as seen from the middle of its sweep."""
    normals, offsets = recording.normals[scan, None].float(), recording.offsets[scan, None].float()
    velocity = _velocity(recording, scan)[None]
    return torch.cat(compensated(recording.points[scan, None], normals, offsets, velocity), dim=1)


def _velocity(recording: PreparedRecording, scan: int) -> Tensor:
    """(6,) during a sweep: the mean of the valid motions that end and begin in its middle; zero without any."""
    around = slice(max(scan - 1, 0), scan + 1)
    valid = recording.valid[around].float()
    velocity = log(recording.T_prev_curr[around]) / recording.interval_s[around, None]
    return (valid @ velocity) / valid.sum().clamp(min=1.0)


def _reversed(pair: PairBatch) -> PairBatch:
    return PairBatch(
        pair.current, pair.previous, pair.current_surfaces, pair.previous_surfaces, inverse(pair.T_prev_curr),
        pair.valid,
    )  # fmt: skip


def _stack(pairs: Sequence[PairBatch]) -> PairBatch:
    parts = {name: [getattr(pair, name) for pair in pairs] for name in vars(pairs[0])}
    stacked: dict[str, Any] = {name: None if part[0] is None else torch.cat(part) for name, part in parts.items()}
    return PairBatch(**stacked)
