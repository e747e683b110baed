"""Colours of distances, distinguishable under every colour blindness."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

DEFAULT_CLIP_M = 0.5
DISTANCE_FIELD = "distance_m"
"""Of the points of a file, their distances to the reference map."""

# Viridis at nine even stops (van der Walt, Smith, 2015): even in lightness, from dark for none to bright for far.
_VIRIDIS = (
    (68, 1, 84), (72, 40, 120), (62, 74, 137), (49, 104, 142), (38, 130, 142), (31, 158, 137), (53, 183, 121),
    (109, 205, 89), (253, 231, 37),
)  # fmt: skip


def error_colours(distances_m: FloatArray, clip_m: float = DEFAULT_CLIP_M) -> NDArray[np.uint8]:
    """Colours (N, 3) of distances (N,), from the darkest at 0 to the brightest at `clip_m` and beyond."""
    level = np.clip(np.nan_to_num(distances_m, nan=clip_m, posinf=clip_m) / clip_m, 0.0, 1.0)
    return viridis(level)


def viridis(level: FloatArray) -> NDArray[np.uint8]:
    """Colours (N, 3) of levels (N,): dark violet at 0, over blue and green to yellow at 1."""
    return ramp(level, _VIRIDIS)


def ramp(level: FloatArray, stops: Sequence[tuple[int, int, int]]) -> NDArray[np.uint8]:
    """Colours (N, 3) of levels (N,) from 0 to 1, between colours at even distances."""
    places = np.linspace(0.0, 1.0, len(stops))
    channels = [np.interp(level, places, stop) for stop in zip(*stops, strict=True)]
    return np.stack(channels, axis=1).round().astype(np.uint8)
