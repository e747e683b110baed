"""Fewer vertices for the same picture."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

MOST_VERTICES = 2000


def thin_path(points: FloatArray, tolerance_px: float = 0.3, most: int = MOST_VERTICES) -> FloatArray:
    """Vertices (K, 2) of a path (N, 2) in pixels that stays within the tolerance of it.

    Ramer, Douglas and Peucker's method, with a tolerance that grows until at most `most` vertices are left.
    """
    if len(points) < 3:
        return points
    kept = _within(points, tolerance_px)
    while len(kept) > most:
        tolerance_px *= 1.5
        points = points[kept]
        kept = _within(points, tolerance_px)
    kept_points: FloatArray = points[kept]
    return kept_points


def thin_curve(
    x_px: FloatArray, y_px: FloatArray, width_px: float = 2.0, most: int = MOST_VERTICES
) -> NDArray[np.intp]:
    """Rows (K,) of a curve over rising x that suffice to draw it: the highest and lowest point of each column.

    Peaks stay, however narrow.
    """
    if len(x_px) <= 4:
        return np.arange(len(x_px))
    span = float(x_px[-1] - x_px[0])
    width_px = max(width_px, 2.0 * span / max(most - 2, 1))
    column = np.floor((x_px - x_px[0]) / width_px).astype(np.int64)
    order = np.lexsort((y_px, column))
    ends = np.flatnonzero(np.diff(column[order])) + 1
    lowest, highest = order[np.r_[0, ends]], order[np.r_[ends - 1, len(order) - 1]]
    return np.unique(np.concatenate([[0, len(x_px) - 1], lowest, highest]))


def _within(points: FloatArray, tolerance: float) -> NDArray[np.intp]:
    keep = np.zeros(len(points), dtype=np.bool_)
    keep[[0, -1]] = True
    stretches = [(0, len(points) - 1)]
    while stretches:
        first, last = stretches.pop()
        if last - first < 2:
            continue
        farthest, distance = _farthest(points[first : last + 1])
        if distance > tolerance:
            keep[first + farthest] = True
            stretches += [(first, first + farthest), (first + farthest, last)]
    return np.flatnonzero(keep)


def _farthest(points: FloatArray) -> tuple[int, float]:
    """Row and distance of the point farthest from the line piece between the first and the last."""
    chord, offsets = points[-1] - points[0], points - points[0]
    length_squared = float(chord @ chord)
    along = np.clip(offsets @ chord / length_squared, 0.0, 1.0) if length_squared > 0.0 else np.zeros(len(points))
    distances = np.linalg.norm(offsets - along[:, None] * chord, axis=1)
    farthest = int(np.argmax(distances))
    return farthest, float(distances[farthest])
