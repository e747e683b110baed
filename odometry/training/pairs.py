"""Pairs of scans for training, drawn at random; the same seed and step give the same pairs.

Pairs are augmented: turned, mirrored, scaled, thinned and made noisy; the motions follow.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor
from torch.nn import functional

from lidarslam.odometry.images.bird_eye import CELL_M, CELLS, DENSITY_M, MOST_CELLS, REACH_M
from lidarslam.odometry.network.networks import PairImages, has_normal
from lidarslam.odometry.network.torch_geometry import inverse, log, make_transform, skew, turn_about_z
from lidarslam.odometry.training.preparation import PreparedRecording

# Surfaces whose normals have a vertical component of more than this count as ground.
_LEVEL = 0.9
# Panes of glass in a scan that has any.
_PANES = 6


class Augmentation(NamedTuple):
    """Random changes of pairs; probabilities unless said otherwise."""

    max_gap: int = 10  # steps from one scan of a pair to the other, 1 to this many
    reverse: float = 0.5  # the later scan comes first
    heading: float = 1.0  # both scans are turned about z by the same angle, any
    roll: float = 0.8  # the current scan is turned about z by whole columns
    roll_deg: float = 12.0  # standard deviation of most of these turns
    any_roll: float = 0.2  # the others, by any angle; a part of those that are turned
    mirror: float = 0.5  # y is negated
    scale: float = 0.3  # both scans grow or shrink by up to this part
    drop_beams: float = 0.3  # up to half of the rows are emptied
    drop_points: float = 0.2  # up to this part of the points, of each scan separately
    hide_sector: float = 0.2  # up to a quarter of the turn is emptied in one scan
    range_noise_m: float = 0.02  # greatest standard deviation of noise on the ranges
    normal_noise: float = 0.3  # and on the components of normals, of each scan separately
    drop_normals: float = 0.3  # up to this part of the normals, likewise
    wet_ground: float = 0.15  # level ground beyond 5 to 30 m does not return
    glass: float = 0.15  # several rectangles of one scan do not return
    bird_turn_deg: float = 0.7  # standard deviation of the error of the turn with which scans are seen from above
    fine: float = 0.75  # seen from above twice as large, unless the translation would leave the grid


AUGMENTATION = Augmentation()


@dataclass(frozen=True, eq=False, kw_only=True)
class PairBatch(PairImages):
    """B pairs of scans: the raw sweeps, which the network sees, and the surfaces that the losses compare."""

    # (B, 2, 6, H, W) points and normals as of the middle of each sweep; None where the losses do not need them
    surfaces: Tensor | None = None
    T_prev_curr: Tensor  # (B, 4, 4) pseudo-labels
    valid: Tensor  # (B,) whether these are reliable

    def to(self, device: torch.device) -> "PairBatch":
        """The same on another device."""
        values = {name: value for name, value in vars(self).items() if value is not None}
        return replace(self, **{name: value.to(device, non_blocking=True) for name, value in values.items()})

    def changed(self, change: Callable[[Tensor], Tensor], T_prev_curr: Tensor) -> "PairBatch":
        """The batch with its points and normals (B, 2, 6, H, W) changed, and the motions that follow from it."""
        surfaces = None if self.surfaces is None else change(self.surfaces)
        return replace(self, scans=change(self.scans), surfaces=surfaces, T_prev_curr=T_prev_curr)


def augmented(batch: PairBatch, config: Augmentation, generator: Generator) -> PairBatch:
    """Pairs changed at random, each separately."""
    batch = _scaled(_mirrored(_turned(batch, config, generator), config, generator), config, generator)
    return replace(batch, scans=torch.stack([_worn(images, config, generator) for images in batch.scans.unbind(1)], 1))


def _uniform(generator: Generator, *shape: int) -> Tensor:
    return torch.rand(shape, generator=generator, device=generator.device)


def _normal(generator: Generator, *shape: int) -> Tensor:
    return torch.randn(shape, generator=generator, device=generator.device)


def _columns(generator: Generator, width: int, size: int) -> Tensor:
    return torch.randint(width, (size,), generator=generator, device=generator.device)


def _turned(batch: PairBatch, config: Augmentation, generator: Generator) -> PairBatch:
    """Both scans turned about z by whole columns, the current one by some more."""
    size, width = len(batch.scans), batch.scans.shape[-1]
    both = _columns(generator, width, size)
    both = torch.where(_uniform(generator, size) < config.heading, both, 0)
    more = _normal(generator, size) * (config.roll_deg * width / 360.0)
    anywhere = _uniform(generator, size) < config.any_roll
    more = torch.where(anywhere, _columns(generator, width, size).float(), more.round())
    more = torch.where(_uniform(generator, size) < config.roll, more, 0.0).long()
    T = _turns(both, width) @ batch.T_prev_curr @ _turns(both + more, width).mT
    columns = torch.stack([both, both + more], dim=1)[..., None]
    return batch.changed(lambda images: rotate_columns(torch.unflatten(images, 2, (2, 3)), columns).flatten(2, 3), T)


def _turns(columns: Tensor, width: int) -> Tensor:
    R = turn_about_z(columns.double() * (2.0 * math.pi / width)).float()
    return make_transform(R, R.new_zeros(len(R), 3))


def _mirrored(batch: PairBatch, config: Augmentation, generator: Generator) -> PairBatch:
    chosen = _uniform(generator, len(batch.scans)) < config.mirror
    M = torch.diag(batch.T_prev_curr.new_tensor([1.0, -1.0, 1.0, 1.0]))

    def change(images: Tensor) -> Tensor:
        flipped = mirror(torch.unflatten(images, 2, (2, 3))).flatten(2, 3)
        return torch.where(chosen[:, None, None, None, None], flipped, images)

    return batch.changed(change, torch.where(chosen[:, None, None], M @ batch.T_prev_curr @ M, batch.T_prev_curr))


def _scaled(batch: PairBatch, config: Augmentation, generator: Generator) -> PairBatch:
    exponent = 2.0 * _uniform(generator, len(batch.scans)) - 1.0
    scale = (1.0 + config.scale) ** exponent
    factors = scale.new_ones(len(scale), 1, 6, 1, 1)
    factors[:, :, :3] = scale[:, None, None, None, None]
    T = batch.T_prev_curr.clone()
    T[:, :3, 3] *= scale[:, None]
    return batch.changed(lambda images: images * factors, T)


def _worn(images: Tensor, config: Augmentation, generator: Generator) -> Tensor:
    """Scans of a worse sensor: noise, missing points, beams and directions."""
    size, _, height, width = images.shape
    uniform = partial(_uniform, generator, size)
    kept = uniform(height, width) >= config.drop_points * uniform(1, 1)
    beams = uniform(height, 1) >= 0.5 * uniform(1, 1) * (uniform(1, 1) < config.drop_beams)
    hidden = 0.25 * uniform(1, 1) * (uniform(1, 1) < config.hide_sector)
    sector = (torch.arange(width, device=images.device) / width + uniform(1, 1)).remainder(1.0) >= hidden
    sparse = _missing_returns(images, config, uniform)
    points = images[:, :3]
    noise = config.range_noise_m * uniform(1, 1, 1) * _normal(generator, size, 1, height, width)
    ranges = points.square().sum(1, keepdim=True).sqrt()
    noisy = points * (1.0 + noise / ranges.clamp(min=1.0))
    normals = _worn_normals(images[:, 3:], config, generator)
    return torch.cat([noisy, normals], dim=1) * (kept & beams & sector & sparse)[:, None]


def _worn_normals(normals: Tensor, config: Augmentation, generator: Generator) -> Tensor:
    """Normals (B, 3, H, W) as of rougher surfaces: some tilted at random, some missing."""
    size, _, height, width = normals.shape
    uniform = partial(_uniform, generator, size)
    noise = config.normal_noise * uniform(1, 1, 1).square() * _normal(generator, *normals.shape)
    kept = uniform(height, width) >= config.drop_normals * uniform(1, 1).square()
    return functional.normalize(normals + noise, dim=1) * (has_normal(normals, 1) & kept)[:, None]


def _missing_returns(images: Tensor, config: Augmentation, uniform: Callable[..., Tensor]) -> Tensor:
    """(B, H, W) which points return: wet ground reflects the beam away beyond some range, glass lets it through."""
    height, width = images.shape[2:]
    ranges = images[:, :3].square().sum(1).sqrt()
    wet = (uniform(1, 1) < config.wet_ground) & (images[:, 5].abs() > _LEVEL) & (ranges > 5.0 + 25.0 * uniform(1, 1))
    row = torch.arange(height, device=images.device)[:, None] / height
    column = torch.arange(width, device=images.device) / width
    pane = torch.zeros_like(wet)
    for _ in range(_PANES):
        across = (column - uniform(1, 1)).remainder(1.0) < 0.05 * uniform(1, 1)
        pane |= across & ((row - uniform(1, 1)).remainder(1.0) < 0.6 * uniform(1, 1))
    return ~(wet | (pane & (uniform(1, 1) < config.glass)))


def rotate_columns(images: Tensor, shift: Tensor) -> Tensor:
    """Images of the clouds turned about z by whole columns, to the left (x towards y) where positive.

    Args:
        images: (..., C, H, W), C at least 2; channels 0 and 1 are components along x and y, of points or of normals.
        shift: columns, (...) integers.
    """
    width = images.shape[-1]
    columns = (torch.arange(width, device=images.device) - shift[..., None]).remainder(width)
    moved = images.gather(-1, columns[..., None, None, :].expand(images.shape))
    angles = shift.double()[..., None, None] * (2.0 * math.pi / width)
    cos, sin = angles.cos().to(images.dtype), angles.sin().to(images.dtype)
    x, y, *others = moved.unbind(-3)
    return torch.stack([cos * x - sin * y, sin * x + cos * y, *others], dim=-3)


def mirror(images: Tensor) -> Tensor:
    """Images (..., C, H, W) of the clouds with y negated; channel 1 is the component along y."""
    x, y, *others = images.flip(-1).unbind(-3)
    return torch.stack([x, -y, *others], dim=-3)


def compensated(points: Tensor, normals: Tensor, offsets: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
    """Points and normals (B, 3, H, W) as seen from the middles of the sweeps.

    Args:
        points, normals: as measured; zero where empty.
        offsets: (B, H, W) seconds from the middle.
        velocity: (B, 6) of bodies that move evenly, rotation first.
    """
    shape, t = points.shape, offsets.flatten(1)[..., None]
    p, n = points.flatten(2).mT, normals.flatten(2).mT
    seen = p.square().sum(-1, keepdim=True) > 0.0
    cross = skew(velocity[:, :3]).mT  # p @ cross is the cross product of the rotation vector with p
    moved = _second_order(p, torch.baddbmm(velocity[:, None, 3:], p, cross), t, cross) * seen
    turned = _second_order(n, n @ cross, t, cross)
    return moved.mT.reshape(shape), turned.mT.reshape(shape)


def _second_order(values: Tensor, first: Tensor, t: Tensor, cross: Tensor) -> Tensor:
    """The exponential map to second order, which is exact to 0.12 mrad for a turn of 10 degrees a sweep."""
    return torch.addcmul(values, t, torch.baddbmm(first, (0.5 * t) * first, cross))


# A prime that keeps the random streams of seeds and steps apart.
_STREAM = 1_000_003
# Seeds of a generator are below this.
_SEEDS = 2**63


@dataclass(frozen=True, eq=False)
class Pairs:
    """Draws batches of pairs from recordings, and changes them on a device."""

    recordings: Sequence[PreparedRecording]  # one or more
    seed: int  # of all draws
    surfaces: bool = True  # whether the losses need compensated scans
    birds: bool = True  # whether the network looks from above
    weights: Sequence[float] | None = None  # how often each recording is drawn, relative to the others; None: equally
    augmentation: Augmentation = AUGMENTATION
    device: torch.device | str = "cpu"

    def batch(self, step: int, size: int) -> PairBatch:
        """The pairs of one step, on the device."""
        seed = (self.seed * _STREAM**2 + step * _STREAM) % _SEEDS
        choice, generator = torch.Generator().manual_seed(seed), torch.Generator(self.device).manual_seed(seed)
        drawn = stack([self._draw(choice) for _ in range(size)]).to(torch.device(self.device))
        pairs = augmented(drawn, self.augmentation, generator)
        return self._seen_from_above(pairs, generator) if self.birds else pairs

    def _draw(self, generator: Generator) -> PairBatch:
        weights = torch.tensor(self.weights or [1.0] * len(self.recordings), dtype=torch.float64)
        recording = self.recordings[int(torch.multinomial(weights, 1, generator=generator))]
        most = min(self.augmentation.max_gap, len(recording) - 1)
        gap = int(torch.randint(1, most + 1, (), generator=generator))
        first = int(torch.randint(len(recording) - gap, (), generator=generator))
        pair = pair_of(recording, first, first + gap, self.surfaces)
        is_reversed = float(torch.rand((), generator=generator)) < self.augmentation.reverse
        return reversed_pair(pair) if is_reversed else pair

    def _seen_from_above(self, batch: PairBatch, generator: Generator) -> PairBatch:
        """The pairs with bird's-eye grids; the turn between the scans is known to within an error."""
        size = len(batch.scans)
        turns = torch.atan2(batch.T_prev_curr[:, 1, 0], batch.T_prev_curr[:, 0, 0])
        errors = _normal(generator, size) * math.radians(self.augmentation.bird_turn_deg)
        fits = 2.0 * batch.T_prev_curr[:, :2, 3].abs().amax(1) < (MOST_CELLS - 1) * CELL_M
        scale = 1.0 + (fits & (_uniform(generator, size) < self.augmentation.fine)).to(turns)
        headings = torch.stack([torch.zeros_like(turns), turns + errors], dim=1)
        return replace(batch, birds=birds(batch.scans, headings, scale[:, None].expand(-1, 2)), scale=scale)


def birds(images: Tensor, headings: Tensor, scale: Tensor) -> Tensor:
    """Bird's-eye grids (B, 2, CHANNELS, CELLS, CELLS) of points and normals (B, 2, 6, H, W), turned by headings (B, 2).

    As `images.bird_eye.bird_eye`, for a batch on any device; scale (B, 2) enlarges the scenes in the plane.
    """
    x, y, z, u, v, _ = images.flatten(3).flatten(0, 1).unbind(1)  # (2 B, N)
    c, s = headings.cos().flatten()[:, None], headings.sin().flatten()[:, None]
    size_m = CELL_M / scale.flatten()[:, None]
    squared = x * x + y * y
    column = ((c * x - s * y) / size_m).floor() + CELLS // 2
    row = ((s * x + c * y) / size_m).floor() + CELLS // 2
    is_shown = (squared > 0.0) & (squared <= (REACH_M * size_m / CELL_M).square())
    cells = CELLS * CELLS
    index = torch.where(is_shown, row * CELLS + column, cells).long()  # the last for all others
    one, other = c * u - s * v, s * u + c * v
    density = (squared + z * z) / DENSITY_M**2
    parts = [torch.ones_like(x), density, u * u + v * v, one * one - other * other, 2.0 * one * other, z]
    sums = x.new_zeros(len(x), len(parts), cells + 1)
    sums.scatter_add_(2, index[:, None].expand(-1, len(parts), -1), torch.stack(parts, dim=1))
    low, high = (
        x.new_zeros(len(x), cells + 1).scatter_reduce_(1, index, z, reduction, include_self=False)
        for reduction in ("amin", "amax")
    )
    count, density, upright, along, across, height = sums.unbind(1)
    amount = upright.log1p()
    facing = amount / upright.clamp(min=1e-6)
    mean = height / count.clamp(min=1.0)
    grids = [
        0.5 * count.log1p(), 0.5 * density.log1p(), amount, facing * along, facing * across,
        (0.4 * mean).tanh(), (0.4 * high).tanh(), (high - low).tanh(),
    ]  # fmt: skip
    return torch.stack(grids, dim=1)[..., :cells].reshape(*headings.shape, -1, CELLS, CELLS)


def pair_of(recording: PreparedRecording, previous: int, current: int, surfaces: bool = True) -> PairBatch:
    """One pair of a recording, as it is."""
    T = torch.eye(4)
    for motion in recording.T_prev_curr[previous:current]:
        T = T @ motion
    both = [previous, current]
    points, normals, offsets = recording.points[both], recording.normals[both].float(), recording.offsets[both].float()
    still = None
    if surfaces:
        velocities = torch.stack([_velocity(recording, scan) for scan in both])
        still = torch.cat(compensated(points, normals, offsets, velocities), dim=1)[None]
    return PairBatch(
        scans=torch.cat([points, normals], dim=1)[None],
        surfaces=still,
        T_prev_curr=T[None],
        valid=recording.valid[previous:current].all()[None],
    )


def _velocity(recording: PreparedRecording, scan: int) -> Tensor:
    """(6,) during a sweep: the mean of the valid motions that end and begin in its middle; zero without any."""
    around = slice(max(scan - 1, 0), scan + 1)
    valid = recording.valid[around].float()
    velocity = log(recording.T_prev_curr[around]) / recording.interval_s[around, None]
    return (valid @ velocity) / valid.sum().clamp(min=1.0)


def reversed_pair(pair: PairBatch) -> PairBatch:
    """The later scan first."""
    return pair.changed(lambda scans: scans.flip(1), inverse(pair.T_prev_curr))


def stack(pairs: Sequence[PairBatch]) -> PairBatch:
    """Pairs in one batch."""
    parts = {name: [getattr(pair, name) for pair in pairs] for name in vars(pairs[0])}
    stacked: dict[str, Any] = {name: None if part[0] is None else torch.cat(part) for name, part in parts.items()}
    return PairBatch(**stacked)
