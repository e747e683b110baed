"""The network of DeLORA (Nubert et al., ICRA 2021): two range images in, the motion between them out."""

from functools import partial

import torch
from torch import Tensor, nn

from lidarslam.odometry.network.pair_network import Estimate, PairImages
from lidarslam.odometry.network.torch_geometry import make_transform, rotation_from_quaternion

# Output channels of the four stages, and their stride in (elevation, azimuth).
_STAGES = ((64, (1, 1)), (128, (1, 2)), (256, (1, 2)), (512, (2, 2)))
_STEM_CHANNELS = 64
_FEATURES = 1000
_HEAD_FEATURES = 100
# How much smaller than torch's default the weights of the two last layers begin.
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
            stages += [_Block(channels_in, channels, stride), _Block(channels, channels, (1, 1))]
            channels_in = channels
        self.stages = nn.Sequential(*stages)
        self.pool = nn.AdaptiveAvgPool2d(1)
        self.trunk = nn.Sequential(nn.Linear(channels_in, _FEATURES), nn.Tanh())
        self.rotation = _head(4)
        self.translation = _head(3)
        _initialise(self)

    def forward(self, pairs: PairImages) -> Estimate:
        """The motions of B pairs, with constant standard deviations."""
        images = torch.cat([_with_ranges(pairs.previous), _with_ranges(pairs.current)], dim=1)  # (B, 8, H, W)
        features = self.stages(self.stem(images))  # (B, 64, H, W/4) -> (B, 512, H/2, W/32)
        shared = self.trunk(self.pool(features).flatten(1))  # (B, 512, 1, 1) -> (B, 1000)
        quaternions = self.rotation(shared)  # (B, 4), w first, of any length
        T_prev_curr = make_transform(rotation_from_quaternion(quaternions), self.translation(shared))
        size = T_prev_curr.shape[0]  # len() would fix the size of exported batches
        log_sigma = T_prev_curr.new_full((size, 6), _UNKNOWN_SIGMA).log()
        return Estimate(T_prev_curr, log_sigma, log_sigma.new_zeros(size, 0), log_sigma.new_zeros(size, 0, 0))


class _Block(nn.Module):
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


def _with_ranges(images: Tensor) -> Tensor:
    """(B, 4, H, W) points and ranges of points and normals (B, 6, H, W)."""
    points = images[:, :3]
    return torch.cat([points, points.square().sum(1, keepdim=True).sqrt()], dim=1)


def _around(layer: nn.Module) -> nn.Module:
    """A layer of 3 x 3 pixels that goes round in azimuth: (B, C, H, W + 2) -> (B, C', H, W)."""
    return nn.Sequential(nn.CircularPad2d((1, 1, 0, 0)), layer)


def _convolution(channels_in: int, channels_out: int, stride: tuple[int, int] = (1, 1)) -> nn.Module:
    return _around(nn.Conv2d(channels_in, channels_out, 3, stride, padding=(1, 0), bias=False))


def _head(outputs: int) -> nn.Sequential:
    """(B, 1000) -> (B, outputs)."""
    return nn.Sequential(nn.Linear(_FEATURES, _HEAD_FEATURES), nn.Tanh(), nn.Linear(_HEAD_FEATURES, outputs))


@torch.no_grad()
def _initialise(network: DeloraNetwork) -> None:
    """Kaiming's normal weights by fan-out for the convolutions, and a first answer close to the identity."""
    # The gain of relu for tanh as well, as ResNets have it: without normalisation a smaller one lets signals die out.
    draw = partial(nn.init.kaiming_normal_, mode="fan_out", nonlinearity="relu")
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            draw(module.weight)
    for head in (network.rotation, network.translation):
        last = head[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_(_LAST_LAYER_GAIN)
        nn.init.zeros_(last.bias)
    quaternion = network.rotation[-1]
    assert isinstance(quaternion, nn.Linear)
    quaternion.bias[0] = 1.0
