"""The bulk of several methods: one that diverges leaves the picture instead of flattening the others."""

from collections.abc import Mapping, Sequence

import numpy as np

from lidarslam.core.geometry import FloatArray

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
