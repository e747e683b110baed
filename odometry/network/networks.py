"""The networks: images of pairs of scans in, motions with standard deviations out.

The default one finds a turn and a translation by correlations over all turns and all shifts: a turn about z shifts the
columns of a range image, a translation the cells of a bird's-eye grid. Two encoders give the features of one scan each,
from its image and from its grid; their correlations over all shifts are the scores of turns and of translations,
whatever their size. A small head estimates standard deviations from the shape of both. The other one is DeLORA's
(Nubert et al., ICRA 2021).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from lidarslam.odometry.config import NetworkConfig
from lidarslam.odometry.images import bird_eye
from lidarslam.odometry.images.bird_eye import SHIFTS
from lidarslam.odometry.network.torch_geometry import make_transform, rotation_from_quaternion, turn_about_z


@dataclass(frozen=True, eq=False)
class PairImages:
    """The input of the networks for B pairs of scans."""

    scans: Tensor  # (B, 2, 6, H, W) points and normals of the previous and the current scan
    # (B, 2, CHANNELS, CELLS, CELLS) both seen from above, the current scan turned by about the turn between the two;
    # None for networks that do not look from above
    birds: Tensor | None = None
    scale: Tensor | None = None  # (B,) of the scene in these grids, as in `training.pairs`; None: its own


@dataclass(frozen=True, eq=False)
class PairEstimate:
    """The output of a network for B pairs."""

    T_prev_curr: Tensor  # (B, 4, 4)
    # (B, 6) logarithm of the standard deviation along each direction of a change of `T_prev_curr` from the left:
    # rotation in radians, then translation in metres
    log_sigma: Tensor
    # (B, S) log-likelihoods, up to a constant, of the turns about z by a whole number of feature columns; (B, 0) where
    # the network has none
    turn_scores: Tensor
    shift_scores: Tensor  # (B, SHIFTS, SHIFTS) the same of shifts by whole cells along y and x; (B, 0, 0) without


PairNetwork = Callable[[PairImages], PairEstimate]
"""A network that estimates the motion between two scans, for B pairs."""


def make_network(config: NetworkConfig) -> nn.Module:
    """The configured network, a `PairNetwork`, with its first random weights."""
    return DeloraNetwork() if config.name == "delora" else CorrelationNetwork()


def of_two_images(network: PairNetwork) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """The network as a function of two images (B, 6, H, W): the motions (B, 4, 4) and log sigma (B, 6)."""

    def estimate(previous: Tensor, current: Tensor) -> tuple[Tensor, Tensor]:
        estimated = network(PairImages(torch.stack([previous, current], dim=1)))
        return estimated.T_prev_curr, estimated.log_sigma

    return estimate


def has_normal(normals: Tensor, dim: int) -> Tensor:
    """Which pixels or points have a normal: those without hold zeros along the dimension of x, y and z."""
    return normals.square().sum(dim=dim) > 0.5


INPUT_CHANNELS = 9
# Channels of the three stages of the column encoder, and of the bird's-eye encoder; features that are correlated.
_WIDTHS = (16, 24, 32)
_BIRD_WIDTH, _BIRD_FEATURES = 16, 8
# Bounds of the standard deviations. Peaks of columns of 2 degrees and of cells of a metre are known to a part of
# them at best: while a sensor turns, both sweeps are bent, and the peak with them.
_LEAST_TURN, _LEAST_SHIFT_M, _LARGEST_SIGMA = 0.01, 0.2, 20.0
# A peak is the mean over this many turns or shifts to either side of the highest.
_PEAK = 2
# Standard deviations of the directions that are not estimated: roll and pitch, radians, and z, metres.
_TILT, _CLIMB_M = 0.05, 0.2
# Numbers that describe the shape of the two peaks.
_SHAPE = 8


class CircularConv(nn.Module):
    """A 2D convolution that goes round in azimuth and sees zeros above and below; with normalisation."""

    def __init__(self, channels_in: int, channels_out: int, kernel: tuple[int, int], stride: tuple[int, int]) -> None:
        super().__init__()
        self.around = kernel[1] // 2
        self.conv = nn.Conv2d(channels_in, channels_out, kernel, stride, (kernel[0] // 2, 0), bias=False)
        # Statistics of the training data become part of the weights and cost nothing afterwards.
        self.norm = nn.BatchNorm2d(channels_out)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C', H / stride, W / stride)."""
        x = torch.cat([x[..., -self.around :], x, x[..., : self.around]], dim=-1)
        normalised: Tensor = self.norm(self.conv(x))
        return normalised


class Block(nn.Module):
    """Two convolutions with a skip connection."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = CircularConv(channels, channels, (3, 3), (1, 1))
        self.second = CircularConv(channels, channels, (3, 3), (1, 1))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H, W)."""
        return functional.relu(x + self.second(functional.relu(self.first(x))))


class ColumnEncoder(nn.Module):
    """Unit features of one range image, cell by cell; turning the scan shifts them and does nothing else."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c = _WIDTHS
        self.layers = nn.Sequential(
            CircularConv(INPUT_CHANNELS, a, (3, 5), (1, 2)), nn.ReLU(),  # H x W/2
            CircularConv(a, b, (3, 5), (2, 2)), nn.ReLU(), Block(b),  # H/2 x W/4
            CircularConv(b, c, (3, 3), (2, 1)), nn.ReLU(), Block(c),  # H/4 x W/4
            nn.Conv2d(c, c, 1),
        )  # fmt: skip

    def forward(self, points: Tensor, normals: Tensor) -> Tensor:
        """(B, 3, H, W) twice -> (B, C, H/4, W/4)."""
        features: Tensor = self.layers(column_channels(points, normals))
        return functional.normalize(features, dim=1)


def column_channels(points: Tensor, normals: Tensor) -> Tensor:
    """(B, 9, H, W) network inputs in the frame of each column, all about the size of one.

    Turning the scan about z by whole columns shifts them and changes nothing else.
    """
    x, y, z = points.unbind(1)
    level = (x * x + y * y).sqrt()
    r = (level * level + z * z).sqrt()
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


class BirdEncoder(nn.Module):
    """Features of one bird's-eye grid, cell by cell, from the cell's surroundings at two scales."""

    def __init__(self) -> None:
        super().__init__()
        width, features = _BIRD_WIDTH, _BIRD_FEATURES
        self.fine = _convolved(bird_eye.CHANNELS, width)
        self.coarse = nn.Sequential(_convolved(width, 2 * width, stride=2), _convolved(2 * width, 2 * width))
        self.from_coarse = nn.Conv2d(2 * width, features, 1)
        self.from_fine = nn.Conv2d(width, features, 3, padding=1)
        self.sharpness = nn.Parameter(torch.tensor(-4.0))

    def forward(self, grids: Tensor) -> Tensor:
        """(B, CHANNELS, CELLS, CELLS) -> (B, F, CELLS, CELLS)."""
        fine = self.fine(grids)
        coarse = functional.interpolate(self.from_coarse(self.coarse(fine)), scale_factor=2.0, mode="nearest")
        features: Tensor = self.from_fine(fine) + coarse
        # Empty cells have no features; the first channel is the count.
        return features * (grids[:, :1] > 0.0) * (0.5 * self.sharpness).exp()


def _convolved(channels_in: int, channels_out: int, stride: int = 1) -> nn.Module:
    convolution = nn.Conv2d(channels_in, channels_out, 3, stride, padding=1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(channels_out), nn.ReLU())


class Peaks(nn.Module):
    """Where the scores of turns and shifts are highest, and standard deviations by the shape of both peaks."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Sequential(nn.Linear(_SHAPE, 32), nn.ReLU(), nn.Linear(32, 3))

    def forward(self, turn_scores: Tensor, shift_scores: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, S) and (B, SHIFTS, SHIFTS) -> turn (B,), radians; shift (B, 2), metres; (B, 6) log sigma."""
        turns = turn_scores.shape[1]
        column, turn_shape = _turn_peak(turn_scores)
        shift, shift_shape = _shift_peak(shift_scores)
        angle = column * (2.0 * math.pi / turns)
        angle = torch.where(angle > math.pi, angle - 2.0 * math.pi, angle)
        planar = self.head(torch.cat([turn_shape, shift_shape], dim=1)) - 3.0
        least = planar.new_tensor([_LEAST_TURN, _LEAST_SHIFT_M, _LEAST_SHIFT_M]).log()
        planar = torch.maximum(planar, least).clamp(max=math.log(_LARGEST_SIGMA))
        tilt, climb = torch.full_like(planar[:, :2], _TILT).log(), torch.full_like(planar[:, :1], _CLIMB_M).log()
        return angle, shift, torch.cat([tilt, planar, climb], dim=1)


def _turn_peak(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Column (B,) of the peak of scores (B, S), between columns, and its shape (B, 3).

    The mean over the columns around the highest, through which losses of the motion have gradients.
    """
    width = scores.shape[1]
    around = torch.arange(-_PEAK, _PEAK + 1, device=scores.device)
    best = scores.argmax(dim=1)
    likelihood = scores.log_softmax(dim=1)
    near = likelihood.gather(1, (best[:, None] + around).remainder(width))  # (B, 2 _PEAK + 1)
    share = near.softmax(dim=1)
    mean = (share * around).sum(dim=1)
    variance = (share * (around - mean[:, None]).square()).sum(dim=1)
    entropy = -(likelihood.exp() * likelihood).sum(dim=1)
    return best + mean, torch.stack([near.logsumexp(dim=1), (variance + 1e-3).log(), entropy], dim=1)


def _shift_peak(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Shift (B, 2) along x and y, metres, of the peak of scores (B, SHIFTS, SHIFTS), and its shape (B, 5)."""
    count = scores.shape[-1]
    likelihood = scores.flatten(1).log_softmax(dim=1)
    # A peak on the border would have surroundings beyond it.
    inner = scores[:, _PEAK:-_PEAK, _PEAK:-_PEAK].flatten(1).argmax(dim=1)
    row = torch.div(inner, count - 2 * _PEAK, rounding_mode="floor") + _PEAK
    column = inner.remainder(count - 2 * _PEAK) + _PEAK
    around = torch.arange(-_PEAK, _PEAK + 1, device=scores.device)
    cells = (row[:, None, None] + around[:, None]) * count + column[:, None, None] + around  # (B, 5, 5)
    near = likelihood.gather(1, cells.flatten(1))
    share = near.softmax(dim=1).reshape(-1, 2 * _PEAK + 1, 2 * _PEAK + 1)
    across, along = share.sum(dim=1), share.sum(dim=2)  # over rows: along x; over columns: along y
    mean = torch.stack([(across * around).sum(dim=1), (along * around).sum(dim=1)], dim=1)
    squares = torch.stack([(across * around.square()).sum(dim=1), (along * around.square()).sum(dim=1)], dim=1)
    variance = squares - mean.square()
    cell = torch.stack([column, row], dim=1) - count // 2 + mean
    entropy = -(likelihood.exp() * likelihood).sum(dim=1)
    far = (cell.square().sum(dim=1) + 1.0).log()
    shape = torch.stack([near.logsumexp(dim=1), entropy, far], dim=1)
    return bird_eye.CELL_M * cell, torch.cat([shape, (variance + 1e-3).log()], dim=1)


class CorrelationNetwork(nn.Module):
    """The motion between two scans, and its standard deviations."""

    def __init__(self) -> None:
        super().__init__()
        self.columns = ColumnEncoder()
        self.bird = BirdEncoder()
        self.peaks = Peaks()
        self.turn_sharpness = nn.Parameter(torch.tensor(3.0))

    def forward(self, pairs: PairImages) -> PairEstimate:
        """The motions of B pairs that are seen from above as well."""
        if pairs.birds is None:
            raise ValueError("the network `correlation` needs the scans as seen from above")
        images, grids = (both.transpose(0, 1).flatten(0, 1) for both in (pairs.scans, pairs.birds))  # (2 B, C, H, W)
        columns, cells = self.columns(images[:, :3], images[:, 3:]), self.bird(grids)
        turn_scores = self.turn_scores(*columns.chunk(2))
        shift_scores = self.shift_scores(*cells.chunk(2))
        angle, shift, log_sigma = self.peaks(turn_scores, shift_scores)
        if pairs.scale is not None:
            shift = shift / pairs.scale[:, None]
            log_sigma = log_sigma - pairs.scale[:, None].log() * log_sigma.new_tensor([0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
        translation = torch.cat([shift, torch.zeros_like(shift[:, :1])], dim=1)
        T_prev_curr = make_transform(turn_about_z(angle), translation)
        return PairEstimate(T_prev_curr, log_sigma, turn_scores, shift_scores)

    def turn_scores(self, previous: Tensor, current: Tensor) -> Tensor:
        """(B, W') correlation with the current scan turned by 0, 1, ... columns; unit features (B, C, H', W')."""
        height, width = previous.shape[2:]
        gram = previous.flatten(1, 2).mT @ current.flatten(1, 2)  # (B, C H', W') -> (B, W', W')
        column = torch.arange(width, device=gram.device)
        # A scan turned by s columns shows at column p what it had at p - s.
        diagonals = (column[:, None] - column[None, :]).remainder(width)  # (W' of the previous, shift)
        mean: Tensor = gram.gather(2, diagonals.expand(gram.shape[0], -1, -1)).mean(dim=1) / height
        return mean * self.turn_sharpness.exp()

    def shift_scores(self, previous: Tensor, current: Tensor) -> Tensor:
        """(B, SHIFTS, SHIFTS) correlation with the current scan shifted along y and x; features (B, F, CELLS, CELLS).

        A sum over cells, not a mean: every cell adds its log-likelihood.
        """
        spectrum = torch.fft.rfft2(previous) * torch.fft.rfft2(current).conj()
        scores: Tensor = torch.fft.irfft2(spectrum.sum(dim=1), s=previous.shape[-2:])  # shift by s at index s
        most = bird_eye.MOST_CELLS
        return scores.roll((most, most), (1, 2))[:, :SHIFTS, :SHIFTS]


# Output channels of the four stages, and their stride in (elevation, azimuth).
_STAGES = ((64, (1, 1)), (128, (1, 2)), (256, (1, 2)), (512, (2, 2)))
_STEM_CHANNELS = 64
_FEATURES = 1000
_HEAD_FEATURES = 100
# Initial weights of the two last layers, relative to torch's default.
_LAST_LAYER_GAIN = 0.1
# It has no standard deviations; these are written for it, radians and metres.
_UNKNOWN_SIGMA = 0.1


class DeloraNetwork(nn.Module):
    """A ResNet of eight blocks without normalisation, convolving around the full circle of azimuth.

    Where the original first trains the network to answer the identity, this one begins close to it: the last layers'
    weights are scaled down, and their biases are zero but for the quaternion's w, which is one. Images are in metres,
    16 x 16 or larger.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            _convolution(8, _STEM_CHANNELS, (1, 2)),
            nn.Tanh(),
            _around(nn.MaxPool2d(3, (1, 2), padding=(1, 0))),
        )
        stages, channels_in = list[nn.Module](), _STEM_CHANNELS
        for channels, stride in _STAGES:
            stages += [_DeloraBlock(channels_in, channels, stride), _DeloraBlock(channels, channels, (1, 1))]
            channels_in = channels
        self.stages = nn.Sequential(*stages)
        self.pool = nn.AdaptiveAvgPool2d(1)
        self.trunk = nn.Sequential(nn.Linear(channels_in, _FEATURES), nn.Tanh())
        self.rotation = _head([1.0, 0.0, 0.0, 0.0])
        self.translation = _head([0.0, 0.0, 0.0])
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                # The gain of relu for tanh as well, as ResNets have it: without normalisation a smaller one makes
                # signals vanish.
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, pairs: PairImages) -> PairEstimate:
        """The motions of B pairs, with constant standard deviations."""
        points = pairs.scans[:, :, :3]
        ranges = points.square().sum(2, keepdim=True).sqrt()
        images = torch.cat([points, ranges], dim=2).flatten(1, 2)  # (B, 8, H, W)
        features = self.stages(self.stem(images))  # (B, 64, H, W/4) -> (B, 512, H/2, W/32)
        shared = self.trunk(self.pool(features).flatten(1))  # (B, 512, 1, 1) -> (B, 1000)
        quaternions = self.rotation(shared)  # (B, 4), w first, of any length
        T_prev_curr = make_transform(rotation_from_quaternion(quaternions), self.translation(shared))
        size = T_prev_curr.shape[0]  # len() would fix the size of exported batches
        log_sigma = T_prev_curr.new_full((size, 6), _UNKNOWN_SIGMA).log()
        return PairEstimate(T_prev_curr, log_sigma, log_sigma.new_zeros(size, 0), log_sigma.new_zeros(size, 0, 0))


class _DeloraBlock(nn.Module):
    """Two convolutions and a shortcut, which a 1x1 convolution takes to another shape."""

    def __init__(self, channels_in: int, channels_out: int, stride: tuple[int, int]) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            _convolution(channels_in, channels_out, stride), nn.Tanh(), _convolution(channels_out, channels_out)
        )
        same = channels_in == channels_out and stride == (1, 1)
        self.shortcut = nn.Identity() if same else nn.Conv2d(channels_in, channels_out, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return torch.tanh(self.residual(x) + self.shortcut(x))


def _around(layer: nn.Module) -> nn.Module:
    """A layer of 3 x 3 pixels that goes round in azimuth: (B, C, H, W + 2) -> (B, C', H, W)."""
    return nn.Sequential(nn.CircularPad2d((1, 1, 0, 0)), layer)


def _convolution(channels_in: int, channels_out: int, stride: tuple[int, int] = (1, 1)) -> nn.Module:
    return _around(nn.Conv2d(channels_in, channels_out, 3, stride, padding=(1, 0), bias=False))


@torch.no_grad()
def _head(answer: Sequence[float]) -> nn.Sequential:
    """Two layers whose first answers are close to the given one."""
    hidden, last = nn.Linear(_FEATURES, _HEAD_FEATURES), nn.Linear(_HEAD_FEATURES, len(answer))
    last.weight.mul_(_LAST_LAYER_GAIN)
    last.bias.copy_(torch.tensor(answer))
    return nn.Sequential(hidden, nn.Tanh(), last)
