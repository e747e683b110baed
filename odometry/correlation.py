"""The default network: both scans through one encoder, then their correlation over azimuth shifts.

A turn about z moves an image sideways, whatever the scene; so the turn is read off a correlation volume, the features
of the current scan are moved back by it, and what is left is small and regressed. Everything before the last layers is
seamless in azimuth and sees points in the frame of their own column: turning a scan by one column turns the answer.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from odometry.evidence import EVIDENCE_CHANNELS, PACKED_CHANNELS, evidence, pack
from odometry.network_config import CorrelationConfig
from odometry.torch_geometry import exp, full_precision, turn_about_z
from odometry.torch_images import has_normal

INPUT_CHANNELS = 9
# Standard deviations are kept within these: e^-7 is 0.05 degrees or 1 mm.
_LOG_SIGMA = (-7.0, 3.0)
# The peak of the turn's scores is taken as the mean over so many columns to either side.
_PEAK = 2


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a network says of B pairs.

    Attributes:
        T_prev_curr: (B, 4, 4).
        log_sigma: (B, 6) logarithm of the standard deviation along each direction of a change of `T_prev_curr` from the
            left: rotation in radians, then translation in metres.
        turn_scores: (B, S) scores of the turns about z that are a whole number of feature columns, before a softmax.
    """

    T_prev_curr: Tensor
    log_sigma: Tensor
    turn_scores: Tensor


class CircularConv(nn.Module):
    """A 2D convolution that goes round in azimuth and sees zeros above and below; with normalisation."""

    def __init__(self, channels_in: int, channels_out: int, kernel: tuple[int, int], stride: tuple[int, int]) -> None:
        super().__init__()
        self.around = kernel[1] // 2
        self.conv = nn.Conv2d(channels_in, channels_out, kernel, stride, (kernel[0] // 2, 0), bias=False)
        self.norm = nn.GroupNorm(8, channels_out)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C', H / stride, W / stride)."""
        x = functional.pad(x, (self.around, self.around, 0, 0), mode="circular")
        normalised: Tensor = self.norm(self.conv(x))
        return normalised


class Block(nn.Module):
    """Two convolutions around which the input goes by."""

    def __init__(self, channels: int, kernel: tuple[int, int] = (3, 3)) -> None:
        super().__init__()
        self.first = CircularConv(channels, channels, kernel, (1, 1))
        self.second = CircularConv(channels, channels, kernel, (1, 1))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H, W)."""
        return functional.silu(x + self.second(functional.silu(self.first(x))))


class Encoder(nn.Module):
    """Features of one scan, on its own."""

    def __init__(self, widths: tuple[int, int, int]) -> None:
        super().__init__()
        a, b, c = widths
        self.layers = nn.Sequential(
            CircularConv(INPUT_CHANNELS, a, (3, 5), (1, 2)), nn.SiLU(),  # H x W/2
            CircularConv(a, b, (3, 5), (2, 2)), nn.SiLU(), Block(b),  # H/2 x W/4
            CircularConv(b, c, (3, 3), (2, 1)), nn.SiLU(), Block(c), Block(c),  # H/4 x W/4
        )  # fmt: skip

    def forward(self, points: Tensor, normals: Tensor) -> Tensor:
        """(B, 3, H, W) twice -> (B, C, H/4, W/4)."""
        features: Tensor = self.layers(column_channels(points, normals))
        return features


def column_channels(points: Tensor, normals: Tensor) -> Tensor:
    """(B, 9, H, W) network inputs: what a column sees in its own frame, all about the size of one.

    Turning the scan about z by whole columns shifts them and changes nothing else.
    """
    x, y, z = points.unbind(1)
    level = torch.hypot(x, y)
    r = torch.hypot(level, z)
    seen = (r > 0.0).to(points.dtype)
    safe = level.clamp(min=1e-6)
    outwards = (normals[:, 0] * x + normals[:, 1] * y) / safe
    sideways = (normals[:, 1] * x - normals[:, 0] * y) / safe
    channels = (
        torch.log1p(level) - 2.0 * seen,
        2.0 * torch.atan2(z, safe) * seen,
        torch.tanh(0.5 * z),
        4.0 * seen / (1.0 + r),
        seen,
        outwards,
        sideways,
        normals[:, 2],
        has_normal(normals, 1).to(points.dtype),
    )
    return torch.stack(channels, dim=1)


class CorrelationNetwork(nn.Module):
    """Two scans' features -> the motion between them, and how far to believe it."""

    def __init__(self, config: CorrelationConfig) -> None:
        super().__init__()
        self.config = config
        c, reach, rows = config.widths[2], config.reach, config.rows // 4
        self.encoder = Encoder(config.widths)
        self.sharpness = nn.Parameter(torch.tensor(3.0))
        mixed = config.pair_width
        self.mix = CircularConv(2 * c + 2 * reach + 1 + EVIDENCE_CHANNELS, mixed, (1, 1), (1, 1))
        self.pair = nn.Sequential(Block(mixed), Block(mixed))
        self.columns = nn.Conv1d(mixed * rows, 2 * mixed, 1)
        described = 5 * (2 * mixed + rows * EVIDENCE_CHANNELS) + 2
        self.head = nn.Sequential(nn.Linear(described, 256), nn.SiLU(), nn.Linear(256, 256), nn.SiLU())
        self.motion = nn.Linear(256, 6)
        self.confidence = nn.Linear(256, 6)
        for layer in (self.motion, self.confidence):
            nn.init.zeros_(layer.bias)
            nn.init.normal_(layer.weight, std=1e-3)

    def encode(self, points: Tensor, normals: Tensor) -> Tensor:
        """What is kept of scans, points and normals (B, 3, H, W), for all pairs they are part of.

        Returns:
            (B, C + PACKED_CHANNELS, H/4, W/4): features, and the points and normals themselves.
        """
        return torch.cat([self.encoder(points, normals), pack(points, normals)], dim=1)

    def forward(self, previous: Tensor, current: Tensor) -> Estimate:
        """The motion between scans of which `encode` gave these."""
        previous, seen = previous[:, :-PACKED_CHANNELS], previous[:, -PACKED_CHANNELS:]
        current, seen_now = current[:, :-PACKED_CHANNELS], current[:, -PACKED_CHANNELS:]
        unit_previous, unit_current = (functional.normalize(f, dim=1) for f in (previous, current))
        with full_precision(previous.device):
            turns = self._turn_scores(unit_previous.float(), unit_current.float())  # (B, W')
        shift = turns.argmax(dim=1)
        turned, unit_turned = (_shift_columns(f, shift) for f in (current, unit_current))
        with full_precision(previous.device):
            shown = evidence(seen.float(), _shift_columns(seen_now, shift).float())  # (B, E, H', W')
        volume = torch.cat([previous, turned, self._local(unit_previous, unit_turned), shown], dim=1)
        x = self.pair(functional.silu(self.mix(volume)))  # (B, M, H', W')
        x = functional.silu(self.columns(x.flatten(1, 2)))  # (B, M, H', W') -> (B, M * H', W') -> (B, 2 M, W')
        moments = _moments(torch.cat([x, shown.flatten(1, 2)], dim=1))  # (B, 5 (2 M + E H'))
        certainty, fraction = turns.logsumexp(1) - turns.amax(1), _fraction(turns, shift)
        hidden = self.head(torch.cat([moments, certainty[:, None], fraction[:, None]], dim=1))
        with full_precision(previous.device):
            hidden = hidden.float()
            T_turned_curr = _turn(shift + fraction, turns.shape[1])
            log_sigma = self.confidence(hidden) - 3.0
            return Estimate(exp(self.motion(hidden)) @ T_turned_curr, log_sigma.clamp(*_LOG_SIGMA), turns)

    def _turn_scores(self, previous: Tensor, current: Tensor) -> Tensor:
        """(B, W') mean correlation with the current scan moved by 0, 1, ... columns; unit features (B, C, H', W')."""
        _, _, height, width = previous.shape
        gram = previous.flatten(1, 2).mT @ current.flatten(1, 2)  # (B, C H', W') -> (B, W', W')
        column = torch.arange(width, device=gram.device)
        # A scan turned by s columns shows at column p what it had at p - s.
        diagonals = (column[:, None] - column[None, :]).remainder(width)  # (W' of the previous, shift)
        mean: Tensor = gram.gather(2, diagonals.expand(gram.shape[0], -1, -1)).mean(dim=1) / height
        return mean * self.sharpness.exp()

    def _local(self, previous: Tensor, current: Tensor) -> Tensor:
        """(B, 2 reach + 1, H', W') correlation of every pixel with those nearby in its row."""
        reach = self.config.reach
        padded = functional.pad(current, (reach, reach, 0, 0), mode="circular")
        width = previous.shape[-1]
        shifted = [(previous * padded[..., s : s + width]).sum(dim=1) for s in range(2 * reach + 1)]
        return 3.0 * torch.stack(shifted, dim=1)


def _fraction(turns: Tensor, shift: Tensor) -> Tensor:
    """(B,) how far, in columns, the peak of scores (B, W') lies from its highest column: the mean around it.

    Through it the losses reach the scores, which they could not through the choice of the highest.
    """
    width = turns.shape[1]
    around = torch.arange(-_PEAK, _PEAK + 1, device=turns.device)
    scores = turns.gather(1, (shift[:, None] + around).remainder(width))  # (B, 2 _PEAK + 1)
    return (scores.softmax(dim=1) * around).sum(dim=1)


def _turn(columns: Tensor, width: int) -> Tensor:
    """(B, 4, 4) turns about z by so many of `width` columns."""
    angle = columns * (2.0 * math.pi / width)
    return turn_about_z(torch.where(angle > math.pi, angle - 2.0 * math.pi, angle))


def _shift_columns(features: Tensor, shift: Tensor) -> Tensor:
    """Features (B, C, H, W) of scans turned about z by whole columns (B,)."""
    width = features.shape[-1]
    source = (torch.arange(width, device=features.device) - shift[:, None]).remainder(width)
    return features.gather(3, source[:, None, None, :].expand(features.shape))


def _moments(x: Tensor) -> Tensor:
    """(B, 5 C): mean, and the first two harmonics over azimuth, of columns (B, C, W)."""
    width = x.shape[-1]
    azimuth = (torch.arange(width, device=x.device) + 0.5) * (2.0 * math.pi / width)
    waves = [torch.ones_like(azimuth), azimuth.cos(), azimuth.sin(), (2.0 * azimuth).cos(), (2.0 * azimuth).sin()]
    basis = torch.stack(waves).to(x.dtype) / width  # (5, W)
    return (x @ basis.mT).flatten(1)  # (B, C, 5) -> (B, 5 C)
