"""Points on boxes, and the map of surfels that they give."""

from collections.abc import Iterable, Sequence

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels.surfel_map import SurfelMap

Box = tuple[Sequence[float], Sequence[float]]  # centre and half size, in metres


def on_sides(
    rng: np.random.Generator, half_m: FloatArray, count: int, axes: tuple[int, ...] = (0, 1, 2), margin_m: float = 0.0
) -> FloatArray:
    """Points (N, 3) on the sides of a box across these axes, as far from its edges as the margin."""
    points = rng.uniform(-1.0, 1.0, (count, 3)) * (half_m - margin_m)
    axis = rng.choice(axes, count)
    points[np.arange(count), axis] = rng.choice([-1.0, 1.0], count) * half_m[axis]
    return points


def on_boxes(boxes: Iterable[Box], area_m2: float, rng: np.random.Generator, noise_m: float = 0.0) -> FloatArray:
    """Points (N, 3) on the faces of boxes, inside or outside alike, so much area to each."""
    parts = []
    for centre, half in boxes:
        c, h = np.array(centre, dtype=float), np.array(half, dtype=float)
        for axis in range(3):
            u, v = [a for a in range(3) if a != axis]
            for side in (-1.0, 1.0):
                p = rng.uniform(-1.0, 1.0, (int(4.0 * h[u] * h[v] / area_m2), 3)) * h
                p[:, axis] = side * h[axis] + (rng.normal(0.0, noise_m, len(p)) if noise_m else 0.0)
                parts.append(c + p)
    return np.concatenate(parts)


def surfel_map_of(points: FloatArray, cell_m: float, sensor: Sequence[float] = (0.0, 0.0, 0.0)) -> SurfelMap:
    """The map of points (N, 3) seen from one place (3,)."""
    surfel_map = SurfelMap(cell_m, 100.0)
    rays = points - np.asarray(sensor)
    surfel_map.insert(points, np.arcsin(rays[:, 2] / np.linalg.norm(rays, axis=1)), np.asarray(sensor))
    return surfel_map
