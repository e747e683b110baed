"""Augmentation of pairs of scans: turned, mirrored, scaled, thinned and made noisy at random; the motions follow."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor

from lidarslam.odometry.network.pair_network import PairImages
from lidarslam.odometry.network.torch_geometry import make_transform, turn_about_z
from lidarslam.odometry.training.torch_images import mirror, rotate_columns

# Surfaces whose normals have a vertical component of more than this count as ground.
_LEVEL = 0.9
# Panes of glass in a scan that has any.
_PANES = 6


class Augmentation(NamedTuple):
    """How pairs are changed; probabilities unless said otherwise."""

    max_gap: int = 10  # steps from one scan of a pair to the other, 1 to this many, small ones more often
    reverse: float = 0.5  # the later scan comes first
    heading: float = 1.0  # both scans are turned about z by the same angle, any
    roll: float = 0.8  # the current scan is turned about z by whole columns
    roll_deg: float = 12.0  # standard deviation of most of these turns
    any_roll: float = 0.2  # the others, by any angle; a part of those that are turned
    mirror: float = 0.5  # y is negated
    scale: float = 0.3  # both scans grow or shrink by up to this part
    drop_beams: float = 0.3  # up to half of the rows are emptied
    drop_points: float = 0.2  # up to this part of the points, of each scan anew
    hide_sector: float = 0.2  # up to a quarter of the turn is emptied in one scan
    range_noise_m: float = 0.02  # greatest standard deviation of noise on the ranges
    wet_ground: float = 0.15  # level ground beyond 5 to 30 m does not return
    glass: float = 0.15  # several rectangles of one scan do not return
    bird_turn_deg: float = 0.7  # standard deviation of the error of the turn with which scans are seen from above


AUGMENTATION = Augmentation()


@dataclass(frozen=True, eq=False)
class PairBatch:
    """B pairs of scans."""

    # previous, current: (B, 6, H, W) input of the network: points and normals of the raw sweeps
    previous: Tensor
    current: Tensor
    # previous_surfaces, current_surfaces: (B, 6, H, W) the same, compensated to the middle of each sweep; None where
    # the losses do not need them
    previous_surfaces: Tensor | None
    current_surfaces: Tensor | None
    T_prev_curr: Tensor  # (B, 4, 4) pseudo-labels
    valid: Tensor  # (B,) whether these are reliable
    # bird_previous, bird_current: (B, CHANNELS, CELLS, CELLS) both scans from above, the current one turned by about
    # the turn between the two; None where the network does not need them
    bird_previous: Tensor | None = None
    bird_current: Tensor | None = None

    @property
    def images(self) -> PairImages:
        """The input of the network."""
        return PairImages(self.previous, self.current, self.bird_previous, self.bird_current)

    def to(self, device: torch.device) -> "PairBatch":
        """The same on another device."""
        moved: dict[str, Any] = {
            name: None if value is None else value.to(device, non_blocking=True) for name, value in vars(self).items()
        }
        return PairBatch(**moved)

    def changed(
        self, previous: Callable[[Tensor], Tensor], current: Callable[[Tensor], Tensor], T_prev_curr: Tensor
    ) -> "PairBatch":
        """The batch with its images changed, and the motions that follow from it."""
        return replace(
            self,
            previous=previous(self.previous),
            current=current(self.current),
            previous_surfaces=None if self.previous_surfaces is None else previous(self.previous_surfaces),
            current_surfaces=None if self.current_surfaces is None else current(self.current_surfaces),
            T_prev_curr=T_prev_curr,
        )


def augmented(batch: PairBatch, config: Augmentation, generator: Generator) -> PairBatch:
    """Pairs changed at random, each anew."""
    batch = _scaled(_mirrored(_turned(batch, config, generator), config, generator), config, generator)
    previous, current = (_worn(images, config, generator) for images in (batch.previous, batch.current))
    return replace(batch, previous=previous, current=current)


def _turned(batch: PairBatch, config: Augmentation, generator: Generator) -> PairBatch:
    """Both scans turned about z by whole columns, the current one by some more."""
    size, width = len(batch.previous), batch.previous.shape[-1]
    both = torch.randint(width, (size,), generator=generator)
    both = torch.where(torch.rand(size, generator=generator) < config.heading, both, 0)
    more = torch.randn(size, generator=generator) * (config.roll_deg * width / 360.0)
    anywhere = torch.rand(size, generator=generator) < config.any_roll
    more = torch.where(anywhere, torch.randint(width, (size,), generator=generator).float(), more.round())
    more = torch.where(torch.rand(size, generator=generator) < config.roll, more, 0.0).long()
    T = _turns(both, width) @ batch.T_prev_curr @ _turns(both + more, width).mT
    return batch.changed(lambda images: _rotated(images, both), lambda images: _rotated(images, both + more), T)


def _rotated(images: Tensor, columns: Tensor) -> Tensor:
    """Points and normals (B, 6, H, W) turned about z."""
    return torch.cat([rotate_columns(images[:, :3], columns), rotate_columns(images[:, 3:], columns)], dim=1)


def _turns(columns: Tensor, width: int) -> Tensor:
    R = turn_about_z(columns.double() * (2.0 * math.pi / width)).float()
    return make_transform(R, R.new_zeros(len(R), 3))


def _mirrored(batch: PairBatch, config: Augmentation, generator: Generator) -> PairBatch:
    chosen = torch.rand(len(batch.previous), generator=generator) < config.mirror
    M = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0]))

    def one(images: Tensor) -> Tensor:
        flipped = torch.cat([mirror(images[:, :3]), mirror(images[:, 3:])], dim=1)
        return torch.where(chosen[:, None, None, None], flipped, images)

    return batch.changed(one, one, torch.where(chosen[:, None, None], M @ batch.T_prev_curr @ M, batch.T_prev_curr))


def _scaled(batch: PairBatch, config: Augmentation, generator: Generator) -> PairBatch:
    exponent = 2.0 * torch.rand(len(batch.previous), generator=generator) - 1.0
    scale = (1.0 + config.scale) ** exponent
    factors = torch.ones(len(scale), 6, 1, 1)
    factors[:, :3, 0, 0] = scale[:, None]
    T = batch.T_prev_curr.clone()
    T[:, :3, 3] *= scale[:, None]
    return batch.changed(lambda images: images * factors, lambda images: images * factors, T)


def _worn(images: Tensor, config: Augmentation, generator: Generator) -> Tensor:
    """Scans of a worse sensor: noise, missing points, beams and directions."""
    size, _, height, width = images.shape

    def uniform(*shape: int) -> Tensor:
        return torch.rand(size, *shape, generator=generator)

    kept = uniform(height, width) >= config.drop_points * uniform(1, 1)
    beams = uniform(height, 1) >= 0.5 * uniform(1, 1) * (uniform(1, 1) < config.drop_beams)
    hidden = 0.25 * uniform(1, 1) * (uniform(1, 1) < config.hide_sector)
    sector = (torch.arange(width) / width + uniform(1, 1)).remainder(1.0) >= hidden
    sparse = _missing_returns(images, config, uniform)
    points = images[:, :3]
    noise = config.range_noise_m * uniform(1, 1, 1) * torch.randn(size, 1, height, width, generator=generator)
    ranges = points.square().sum(1, keepdim=True).sqrt()
    noisy = points * (1.0 + noise / ranges.clamp(min=1.0))
    return torch.cat([noisy, images[:, 3:]], dim=1) * (kept & beams & sector & sparse)[:, None]


def _missing_returns(images: Tensor, config: Augmentation, uniform: Callable[..., Tensor]) -> Tensor:
    """(B, H, W) which points return: wet ground reflects the beam away beyond some range, glass lets it through."""
    size, _, height, width = images.shape
    ranges = images[:, :3].square().sum(1).sqrt()
    wet = (uniform(1, 1) < config.wet_ground) & (images[:, 5].abs() > _LEVEL) & (ranges > 5.0 + 25.0 * uniform(1, 1))
    row, column = torch.arange(height)[:, None] / height, torch.arange(width) / width
    pane = torch.zeros(size, height, width, dtype=torch.bool)
    for _ in range(_PANES):
        across = (column - uniform(1, 1)).remainder(1.0) < 0.05 * uniform(1, 1)
        pane |= across & ((row - uniform(1, 1)).remainder(1.0) < 0.6 * uniform(1, 1))
    return ~(wet | (pane & (uniform(1, 1) < config.glass)))
