"""The default network in the form in which ONNX Runtime computes it fastest: other operations, the same function.

ONNX Runtime keeps the features between convolutions in an order of its own, eight channels together, and every other
operation costs a reordering. Here an image goes round once, at its beginning, by as many columns as the encoder sees;
the convolutions after it take zeros at its ends for what is beyond, and what becomes wrong there is cut off.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from lidarslam.odometry.network.correlation import CircularConv, ColumnEncoder

# Columns to either side by which an image goes round: the encoder sees 28 of them, and four make one of its features.
_AROUND, _COLUMNS_PER_FEATURE = 32, 4
# Where `seen` is among the channels of `column_channels`. The first convolution takes the eight others together.
_SEEN = 4


class InferenceColumns(nn.Module):
    """`ColumnEncoder`, trained."""

    def __init__(self, encoder: ColumnEncoder) -> None:
        super().__init__()
        first, _, second, _, block, third, _, other_block, last = encoder.layers
        self.first, self.seen = _divided(_folded(first))
        self.second, self.third, self.last = _folded(second), _folded(third), last
        halves = [half for one in (block, other_block) for half in one.children()]
        self.blocks = nn.ModuleList([_folded(half) for half in halves])

    def forward(self, points: Tensor, normals: Tensor) -> Tensor:
        """(B, 3, H, W) twice -> (B, C, H/4, W/4)."""
        image = torch.cat([points, normals], dim=1)
        together, seen = _channels(torch.cat([image[..., -_AROUND:], image, image[..., :_AROUND]], dim=-1))
        x = functional.relu(self.first(together) + self.seen(seen))
        x = functional.relu(self.second(x))
        x = functional.relu(x + self.blocks[1](functional.relu(self.blocks[0](x))))
        x = functional.relu(self.third(x))
        x = functional.relu(x + self.blocks[3](functional.relu(self.blocks[2](x))))
        cut = _AROUND // _COLUMNS_PER_FEATURE
        return functional.normalize(self.last(x)[..., cut:-cut], dim=1)


def _channels(image: Tensor) -> tuple[Tensor, Tensor]:
    """`column_channels` of points and normals (B, 6, H, W): (B, 8, H, W), and (B, 1, H, W) which pixels are seen."""
    x, y, z, u, v, w = image.chunk(6, dim=1)
    level = (x * x + y * y).sqrt()
    r = (level * level + z * z).sqrt()
    seen = r.sign()
    each = level.clamp(min=1e-6).reciprocal()
    cosine, sine = x * each, y * each
    channels = (
        (1.0 + level).log() - 2.0 * seen,
        2.0 * (z * each).atan(),  # of an empty pixel zero
        (0.5 * z).tanh(),
        4.0 * seen / (1.0 + r),
        u * cosine + v * sine,
        v * cosine - u * sine,
        w,
        (u * u + v * v + w * w > 0.5).to(image.dtype),
    )
    return torch.cat(channels, dim=1), seen


def _folded(layer: nn.Module) -> nn.Conv2d:
    """A convolution and its normalisation as one convolution, which sees zeros at all borders."""
    if not isinstance(layer, CircularConv):
        raise TypeError(f"expected a CircularConv, got {type(layer).__name__}")
    conv, norm = layer.conv, layer.norm
    if norm.running_mean is None or norm.running_var is None:
        raise TypeError("expected a normalisation with statistics")
    gain = norm.weight / (norm.running_var + norm.eps).sqrt()
    return _convolution(conv.weight * gain[:, None, None, None], norm.bias - norm.running_mean * gain, conv)


def _divided(whole: nn.Conv2d) -> tuple[nn.Conv2d, nn.Conv2d]:
    """Two convolutions, the second of `seen` alone, whose sum is this one."""
    others = [channel for channel in range(whole.in_channels) if channel != _SEEN]
    first = _convolution(whole.weight[:, others], whole.bias, whole)
    return first, _convolution(whole.weight[:, [_SEEN]], None, whole)


def _convolution(weight: Tensor, bias: Tensor | None, like: nn.Conv2d) -> nn.Conv2d:
    """A convolution with these weights (C', C, rows, columns) and the stride of another."""
    rows, columns = weight.shape[2:]
    size, stride, around = (rows, columns), (like.stride[0], like.stride[1]), (rows // 2, columns // 2)
    made = nn.Conv2d(weight.shape[1], weight.shape[0], size, stride, around, bias=bias is not None)
    made.weight.data = weight.detach()
    if made.bias is not None and bias is not None:
        made.bias.data = bias.detach()
    return made
