"""Pairs of scans for training, drawn and changed at random; the same seed and step give the same pairs."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor

from odometry.images.bird_eye import bird_eye
from odometry.network.correlation import PairImages
from odometry.training.preparation import PreparedRecording
from odometry.training.torch_geometry import inverse, log, turn_about_z
from odometry.training.torch_images import RecordedImages, compensated, mirror, rotate_columns
from odometry.training.training_config import AugmentationConfig

# A prime that keeps the random streams of steps and processes apart.
_STREAM = 1_000_003
# Surfaces whose normals have a vertical component of more than this count as ground.
_LEVEL = 0.9
# Panes of glass in a scan that has any.
_PANES = 6
# What a generator takes for a seed.
_SEEDS = 2**63


@dataclass(frozen=True, eq=False)
class PairBatch:
    """B pairs of scans.

    Attributes:
        previous, current: (B, 6, H, W) what the network sees: points and normals of the raw sweeps.
        previous_surfaces, current_surfaces: (B, 6, H, W) the same, compensated to the middle of each sweep; None
            where nobody asked for them.
        T_prev_curr: (B, 4, 4) the motion that the teacher found.
        believed: (B,) whether it is to be learnt.
        bird_previous, bird_current: (B, CHANNELS, CELLS, CELLS) both scans from above, the current one turned by about
            the turn between the two; None where nobody asked for them.
    """

    previous: Tensor
    current: Tensor
    previous_surfaces: Tensor | None
    current_surfaces: Tensor | None
    T_prev_curr: Tensor
    believed: Tensor
    bird_previous: Tensor | None = None
    bird_current: Tensor | None = None

    @property
    def shown(self) -> PairImages:
        """What the network sees."""
        return PairImages(self.previous, self.current, self.bird_previous, self.bird_current)

    def to(self, device: torch.device) -> "PairBatch":
        """The same on another device."""
        moved: dict[str, Any] = {
            name: None if value is None else value.to(device, non_blocking=True) for name, value in vars(self).items()
        }
        return PairBatch(**moved)

    def with_images(self, change: Callable[[Tensor], Tensor], T_prev_curr: Tensor) -> "PairBatch":
        """The batch with all its images changed alike, and the motions that follow from it."""
        surfaces = (self.previous_surfaces, self.current_surfaces)
        previous, current = (None if images is None else change(images) for images in surfaces)
        return PairBatch(change(self.previous), change(self.current), previous, current, T_prev_curr, self.believed)


class Pairs:
    """Draws batches of pairs from recordings.

    Args:
        recordings: to draw from.
        config: how pairs are changed.
        seed: of all draws.
        surfaces: whether the losses ask for compensated scans.
        birds: whether the network looks from above.
        weights: how often each recording is drawn, relative to the others; None: equally often.
    """

    def __init__(
        self,
        recordings: Sequence[PreparedRecording],
        config: AugmentationConfig,
        seed: int,
        surfaces: bool = True,
        birds: bool = True,
        weights: Sequence[float] | None = None,
    ) -> None:
        if not recordings:
            raise ValueError("training needs a recording or more, got none")
        self._recordings = recordings
        self._config = config
        self._seed = seed
        self._surfaces = surfaces
        self._birds = birds
        self._weights = torch.tensor([1.0] * len(recordings) if weights is None else weights, dtype=torch.float64)

    def batch(self, step: int, size: int, process: int = 0) -> PairBatch:
        """The pairs of one step."""
        generator = torch.Generator().manual_seed((self._seed * _STREAM**2 + step * _STREAM + process) % _SEEDS)
        pairs = augmented(_stack([self._draw(generator) for _ in range(size)]), self._config, generator)
        return _seen_from_above(pairs, self._config, generator) if self._birds else pairs

    def _draw(self, generator: Generator) -> PairBatch:
        recording = self._recordings[int(torch.multinomial(self._weights, 1, generator=generator))]
        gap = _gap(generator, min(self._config.max_gap, len(recording) - 1))
        first = _integer(generator, len(recording) - gap)
        pair = pair_of(recording, first, first + gap, self._surfaces)
        return _reversed(pair) if _chance(generator, self._config.reverse) else pair


def _gap(generator: Generator, most: int) -> int:
    """Steps from 1 to the most, each as likely as all up to twice as many together: small ones are common."""
    exponent = float(torch.rand((), generator=generator, dtype=torch.float64))
    return min(int((most + 1.0) ** exponent), most)


def _seen_from_above(batch: PairBatch, config: AugmentationConfig, generator: Generator) -> PairBatch:
    """The pairs with bird's-eye grids; the turn between the scans is known to within an error, as it will be in use."""
    size = len(batch.previous)
    turns = torch.atan2(batch.T_prev_curr[:, 1, 0], batch.T_prev_curr[:, 0, 0])
    errors = torch.randn(size, generator=generator) * math.radians(config.bird_turn_deg)
    return replace(
        batch,
        bird_previous=birds(batch.previous, torch.zeros(size)),
        bird_current=birds(batch.current, turns + errors),
    )


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
    images = recording.images
    raw = [
        torch.cat([images.points[i], images.normals[i].float()])[None]  # (1, 6, H, W)
        for i in (previous, current)
    ]
    still = [_compensated(recording, i) if surfaces else None for i in (previous, current)]
    believed = recording.believed[previous:current].all()
    return PairBatch(raw[0], raw[1], still[0], still[1], T[None], believed[None])


def _compensated(recording: PreparedRecording, scan: int) -> Tensor:
    """(1, 6, H, W) a scan as seen from the middle of its sweep."""
    images = recording.images.select(slice(scan, scan + 1))
    images = RecordedImages(images.points, images.normals.float(), images.offsets.float(), images.low, images.high)
    still = compensated(images, _velocity(recording, scan)[None])
    return torch.cat([still.points, still.normals], dim=1)


def _velocity(recording: PreparedRecording, scan: int) -> Tensor:
    """(6,) during a sweep: the mean of the believed motions that end and begin in its middle; zero without any."""
    around = slice(max(scan - 1, 0), scan + 1)
    believed = recording.believed[around].float()
    velocity = log(recording.T_prev_curr[around]) / recording.interval_s[around, None]
    return (believed @ velocity) / believed.sum().clamp(min=1.0)


def _reversed(pair: PairBatch) -> PairBatch:
    return PairBatch(
        pair.current, pair.previous, pair.current_surfaces, pair.previous_surfaces, inverse(pair.T_prev_curr),
        pair.believed,
    )  # fmt: skip


def _stack(pairs: Sequence[PairBatch]) -> PairBatch:
    parts = {name: [getattr(pair, name) for pair in pairs] for name in vars(pairs[0])}
    stacked: dict[str, Any] = {name: None if part[0] is None else torch.cat(part) for name, part in parts.items()}
    return PairBatch(**stacked)


def augmented(batch: PairBatch, config: AugmentationConfig, generator: Generator) -> PairBatch:
    """Pairs turned, mirrored, scaled, thinned and made noisy, each anew; the motions follow."""
    batch = _scaled(_mirrored(_turned(batch, config, generator), config, generator), config, generator)
    previous, current = (_worn(images, config, generator) for images in (batch.previous, batch.current))
    surfaces = batch.previous_surfaces, batch.current_surfaces
    return PairBatch(previous, current, *surfaces, batch.T_prev_curr, batch.believed)


def _turned(batch: PairBatch, config: AugmentationConfig, generator: Generator) -> PairBatch:
    """Both scans turned about z by whole columns, the current one by some more."""
    size, width = len(batch.previous), batch.previous.shape[-1]
    both = torch.randint(width, (size,), generator=generator)
    both = torch.where(torch.rand(size, generator=generator) < config.heading, both, 0)
    more = torch.randn(size, generator=generator) * (config.roll_deg * width / 360.0)
    anywhere = torch.rand(size, generator=generator) < config.any_roll
    more = torch.where(anywhere, torch.randint(width, (size,), generator=generator).float(), more.round())
    more = torch.where(torch.rand(size, generator=generator) < config.roll, more, 0.0).long()
    R_prev, R_curr = _turns(both, width), _turns(both + more, width)
    surfaces = batch.previous_surfaces, batch.current_surfaces
    return PairBatch(
        _rotated(batch.previous, both),
        _rotated(batch.current, both + more),
        None if surfaces[0] is None else _rotated(surfaces[0], both),
        None if surfaces[1] is None else _rotated(surfaces[1], both + more),
        R_prev @ batch.T_prev_curr @ R_curr.mT,
        batch.believed,
    )


def _rotated(images: Tensor, columns: Tensor) -> Tensor:
    """Points and normals (B, 6, H, W) turned about z."""
    return torch.cat([rotate_columns(images[:, :3], columns), rotate_columns(images[:, 3:], columns)], dim=1)


def _turns(columns: Tensor, width: int) -> Tensor:
    return turn_about_z(columns.double() * (2.0 * math.pi / width)).float()


def _mirrored(batch: PairBatch, config: AugmentationConfig, generator: Generator) -> PairBatch:
    chosen = torch.rand(len(batch.previous), generator=generator) < config.mirror
    M = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0]))

    def one(images: Tensor) -> Tensor:
        flipped = torch.cat([mirror(images[:, :3]), mirror(images[:, 3:])], dim=1)
        return torch.where(chosen[:, None, None, None], flipped, images)

    return batch.with_images(one, torch.where(chosen[:, None, None], M @ batch.T_prev_curr @ M, batch.T_prev_curr))


def _scaled(batch: PairBatch, config: AugmentationConfig, generator: Generator) -> PairBatch:
    exponent = 2.0 * torch.rand(len(batch.previous), generator=generator) - 1.0
    scale = (1.0 + config.scale) ** exponent
    factors = torch.ones(len(scale), 6, 1, 1)
    factors[:, :3, 0, 0] = scale[:, None]
    T = batch.T_prev_curr.clone()
    T[:, :3, 3] *= scale[:, None]
    return batch.with_images(lambda images: images * factors, T)


def _worn(images: Tensor, config: AugmentationConfig, generator: Generator) -> Tensor:
    """What the network sees of a scan when the sensor is worse: noise, missing points, beams and directions."""
    size, _, height, width = images.shape

    def uniform(*shape: int) -> Tensor:
        return torch.rand(size, *shape, generator=generator)

    kept = uniform(height, width) >= config.drop_points * uniform(1, 1)
    beams = uniform(height, 1) >= 0.5 * uniform(1, 1) * (uniform(1, 1) < config.drop_beams)
    hidden = 0.25 * uniform(1, 1) * (uniform(1, 1) < config.hide_sector)
    sector = (torch.arange(width) / width + uniform(1, 1)).remainder(1.0) >= hidden
    sparse = _missing_returns(images, config, generator)
    points = images[:, :3]
    noise = config.range_noise_m * uniform(1, 1, 1) * torch.randn(size, 1, height, width, generator=generator)
    ranges = points.square().sum(1, keepdim=True).sqrt()
    noisy = points * (1.0 + noise / ranges.clamp(min=1.0))
    return torch.cat([noisy, images[:, 3:]], dim=1) * (kept & beams & sector & sparse)[:, None]


def _missing_returns(images: Tensor, config: AugmentationConfig, generator: Generator) -> Tensor:
    """(B, H, W) what returns: wet ground reflects the beam away beyond some range, panes of glass let it through."""
    size, _, height, width = images.shape

    def uniform(*shape: int) -> Tensor:
        return torch.rand(size, *shape, generator=generator)

    ranges = images[:, :3].square().sum(1).sqrt()
    wet = (uniform(1, 1) < config.wet_ground) & (images[:, 5].abs() > _LEVEL) & (ranges > 5.0 + 25.0 * uniform(1, 1))
    row, column = torch.arange(height)[:, None] / height, torch.arange(width) / width
    pane = torch.zeros(size, height, width, dtype=torch.bool)
    for _ in range(_PANES):
        across = (column - uniform(1, 1)).remainder(1.0) < 0.05 * uniform(1, 1)
        pane |= across & ((row - uniform(1, 1)).remainder(1.0) < 0.6 * uniform(1, 1))
    return ~(wet | (pane & (uniform(1, 1) < config.glass)))


def _integer(generator: Generator, below: int) -> int:
    return int(torch.randint(below, (), generator=generator))


def _chance(generator: Generator, probability: float) -> bool:
    return float(torch.rand((), generator=generator)) < probability
