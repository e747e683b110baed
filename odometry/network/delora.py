"""The network of DeLORA (Nubert et al., ICRA 2021): two range images in, the motion between them out."""

from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from odometry.training.torch_geometry import full_precision, make_transform, rotation_from_quaternion

Activation = Literal["tanh", "relu"]

_ACTIVATIONS: dict[Activation, Callable[[], nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}

_MIN_SIZE = 16
# Output channels of the four stages, and their stride in (elevation, azimuth).
_STAGES = ((64, (1, 1)), (128, (1, 2)), (256, (1, 2)), (512, (2, 2)))
_STEM_CHANNELS = 64
_FEATURES = 1000
_HEAD_FEATURES = 100
# How much smaller than torch's default the weights of the two last layers begin.
_LAST_LAYER_GAIN = 0.1


class DeloraNetwork(nn.Module):
    """A ResNet of eight blocks without normalisation, convolving around the full circle of azimuth.

    Where the original first trains the network to answer the identity, this one begins close to it: the last layers'
    weights are scaled down, and their biases are zero but for the quaternion's w, which is one.

    Args:
        activation: tanh as in the paper, or relu.
        range_scale_m: what the images are divided by; 1 as in the paper. The translation comes out in metres.
    """

    def __init__(self, activation: Activation = "tanh", range_scale_m: float = 1.0) -> None:
        super().__init__()
        if not range_scale_m > 0.0:
            raise ValueError(f"range_scale_m={range_scale_m:g} must be positive")
        act = _ACTIVATIONS[activation]
        self.range_scale_m = range_scale_m
        self.stem = nn.Sequential(
            _CircularConv(8, _STEM_CHANNELS, stride=(1, 2)),
            act(),
            _CircularMaxPool(stride=(1, 2)),
        )
        self.stages = nn.Sequential(*_make_stages(act))
        self.pool = nn.AdaptiveAvgPool2d(1)
        self.trunk = nn.Sequential(nn.Linear(_STAGES[-1][0], _FEATURES), act())
        self.rotation = _head(4, act)
        self.translation = _head(3, act)
        _initialise(self)

    def forward(self, images_prev: Tensor, images_curr: Tensor) -> Tensor:
        """The motions T_prev_curr (B, 4, 4) between range images (B, 4, H, W) of x, y, z and range in metres.

        Raises:
            ValueError: the images differ in shape, are not (B, 4, H, W), or are smaller than 16 x 16.
        """
        _check_images(images_prev, images_curr)
        features = self.features(images_prev, images_curr)  # (B, 512, H/2, W/32)
        pooled = self.pool(features).flatten(1)  # (B, 512, 1, 1) -> (B, 512)
        shared = self.trunk(pooled)  # (B, 1000)
        with full_precision(shared.device):
            shared = shared.float()
            quaternions = self.rotation(shared)  # (B, 4), w first, of any length
            return make_transform(rotation_from_quaternion(quaternions), self.translation(shared))

    def features(self, images_prev: Tensor, images_curr: Tensor) -> Tensor:
        """What is pooled, (B, 512, ceil(H/2), ceil(W/32)): rolling the images by 32 columns rolls it by one."""
        images = torch.cat([images_prev, images_curr], dim=1) / self.range_scale_m  # (B, 8, H, W)
        narrow = self.stem(images)  # (B, 64, H, W/4)
        result: Tensor = self.stages(narrow)  # (B, 512, H/2, W/32)
        return result


class _CircularConv(nn.Conv2d):
    """A 3x3 convolution without bias, padded around the circle in azimuth and with zeros in elevation."""

    def __init__(self, channels_in: int, channels_out: int, stride: tuple[int, int] = (1, 1)) -> None:
        super().__init__(channels_in, channels_out, kernel_size=3, stride=stride, padding=(1, 0), bias=False)

    def forward(self, images: Tensor) -> Tensor:
        return super().forward(_wrap_azimuth(images))


class _CircularMaxPool(nn.MaxPool2d):
    """The maximum over 3x3, around the circle in azimuth; nothing is added in elevation."""

    def __init__(self, stride: tuple[int, int]) -> None:
        super().__init__(kernel_size=3, stride=stride, padding=(1, 0))

    def forward(self, images: Tensor) -> Tensor:
        result: Tensor = super().forward(_wrap_azimuth(images))
        return result


class _Block(nn.Module):
    """Two convolutions and a shortcut, which a 1x1 convolution takes to another shape."""

    def __init__(
        self, channels_in: int, channels_out: int, stride: tuple[int, int], act: Callable[[], nn.Module]
    ) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            _CircularConv(channels_in, channels_out, stride), act(), _CircularConv(channels_out, channels_out)
        )
        same = channels_in == channels_out and stride == (1, 1)
        self.shortcut = nn.Identity() if same else nn.Conv2d(channels_in, channels_out, 1, stride, bias=False)
        self.activation = act()

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.activation(self.residual(x) + self.shortcut(x))
        return result


def _wrap_azimuth(images: Tensor) -> Tensor:
    """(B, C, H, W) -> (B, C, H, W + 2): the last column before the first, the first after the last."""
    return functional.pad(images, (1, 1, 0, 0), mode="circular")


def _make_stages(act: Callable[[], nn.Module]) -> list[nn.Module]:
    channels_in, blocks = _STEM_CHANNELS, list[nn.Module]()
    for channels, stride in _STAGES:
        blocks += [_Block(channels_in, channels, stride, act), _Block(channels, channels, (1, 1), act)]
        channels_in = channels
    return blocks


def _head(outputs: int, act: Callable[[], nn.Module]) -> nn.Sequential:
    """(B, 1000) -> (B, outputs)."""
    return nn.Sequential(nn.Linear(_FEATURES, _HEAD_FEATURES), act(), nn.Linear(_HEAD_FEATURES, outputs))


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


def _check_images(images_prev: Tensor, images_curr: Tensor) -> None:
    shape = tuple(images_prev.shape)
    if shape != tuple(images_curr.shape) or len(shape) != 4 or shape[1] != 4 or min(shape[2:]) < _MIN_SIZE:
        raise ValueError(
            f"two equal batches (B, 4, H, W) with H, W >= {_MIN_SIZE} are needed,"
            f" got {shape} and {tuple(images_curr.shape)}"
        )
