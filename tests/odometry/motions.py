"""Motions of known twists, and how far those that are found are off."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.odometry.network.torch_geometry import skew

STILL = (0.0,) * 6
# By 2 degrees about an axis of no particular direction, and by 10 cm.
WRONG = (0.012, -0.012, 0.030, 0.06, -0.06, 0.05)


def moved(twist: Sequence[float], wrong: Sequence[float] = STILL) -> FloatArray:
    """The true motion (4, 4) from one sweep to the next at rad/s and m/s, or a guess off by so much."""
    return exp(wrong) @ exp(0.1 * np.array(twist))


def errors(T: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Degrees and metres (...) between motions (..., 4, 4)."""
    error = log(inverse(truth) @ T)
    return np.rad2deg(np.linalg.norm(error[..., :3], axis=-1)), np.linalg.norm(error[..., 3:], axis=-1)


def assert_close(T: FloatArray, truth: FloatArray, rotation_deg: float, translation_m: float) -> None:
    """No motion (..., 4, 4) is off by more."""
    found_deg, found_m = errors(T, truth)
    assert np.max(found_deg) < rotation_deg
    assert np.max(found_m) < translation_m


def torch_exp(xi: Tensor) -> Tensor:
    """SE(3) exponential (..., 4, 4) of tangents (..., 6), rotation first; differentiable."""
    top = torch.cat([skew(xi[..., :3]), xi[..., 3:, None]], dim=-1)
    return torch.linalg.matrix_exp(torch.nn.functional.pad(top, (0, 0, 0, 1)))
