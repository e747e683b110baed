"""What the page and the pictures share: colours of distances, and which of several paths a picture holds."""

from collections.abc import Mapping, Sequence

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


WIDEST = 3.0
"""A path that reaches farther than this multiple of the usual leaves the picture."""
# A sensor that hardly moves has no size to compare with.
_LEAST_REACH_M = 1.0


def in_bulk(sizes: Sequence[float], most: float, usual: float | None = None) -> list[bool]:
    """Which sizes, such as largest errors, are at most `most` times the usual one: the lower median, unless given."""
    if usual is None and len(sizes):
        usual = float(np.percentile(sizes, 50.0, method="lower"))
    return [usual is not None and size <= most * usual for size in sizes]


def paths_in_bulk(paths: Sequence[FloatArray], reference: FloatArray | None = None) -> list[bool]:
    """Which paths (N, 3), N > 0, do not reach far beyond the true one (K, 3), or beyond the others without one."""
    if reference is None:
        starts = [path[:1] for path in paths]
        return in_bulk([_reach_m(path, start) for path, start in zip(paths, starts, strict=True)], WIDEST)
    middle = 0.5 * (reference.min(axis=0) + reference.max(axis=0))
    return in_bulk([_reach_m(path, middle) for path in paths], WIDEST, _reach_m(reference, middle))


def beyond_m(points: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Largest distance of points (N, D) outside a box, 0 where none is outside."""
    return float(np.maximum(np.maximum(low - points, points - high), 0.0).max(initial=0.0))


def leaves(name: str, far: Mapping[str, float]) -> str:
    """The note on a method of which a part is outside the picture: its largest values by their units."""
    texts = [f"{f'{value:,.0f}' if value >= 10.0 else f'{value:.2g}'}{unit}" for unit, value in far.items()]
    return f"{name} leaves the picture: up to {' and '.join(texts)}"


def _reach_m(path: FloatArray, centre: FloatArray) -> float:
    return max(float(np.linalg.norm(path - centre, axis=1).max()), _LEAST_REACH_M)
