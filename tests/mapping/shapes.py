"""Points on known surfaces, what else may be known of them, and the map of surfels that they give."""

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import PointAttributes
from lidarslam.mapping.registration.sampled_scan import sizes_of_cells
from lidarslam.mapping.surfels.surfel_map import SurfelMap

ORIGIN = (0.0, 0.0, 0.0)

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


def across_x(rng: np.random.Generator, x: float, half_size: float, count: int) -> FloatArray:
    """Points (N, 3) on a square piece of a wall across the x axis."""
    return np.column_stack([np.full(count, x), rng.uniform(-half_size, half_size, (count, 2))])


def attributes(rng: np.random.Generator, count: int, after_s: float = 0.0) -> PointAttributes:
    """Of so many points, all that there are; their times in any order."""
    return PointAttributes(
        intensity=rng.uniform(0.0, 300.0, count).astype(np.float32),
        rgb=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        ring=rng.integers(0, 128, count).astype(np.int32),
        time=1_700_000_000.0 + after_s + 1e-4 * rng.permutation(count),
    )


def elevations_of(points: FloatArray) -> FloatArray:
    """(N,) radians, seen from the origin."""
    return np.asarray(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)))


def insert(surfel_map: SurfelMap, points: FloatArray, sensor: Sequence[float] = ORIGIN) -> None:
    """Points (N, 3) seen from one place (3,)."""
    surfel_map.insert(points, elevations_of(points - np.asarray(sensor)), np.asarray(sensor))


def surfel_map_of(points: FloatArray, cell_m: float, radius_m: float = 100.0) -> SurfelMap:
    """The map of points (N, 3) seen from the origin."""
    surfel_map = SurfelMap(sizes_of_cells(cell_m), radius_m)
    insert(surfel_map, points)
    return surfel_map


def l_shaped_room(rng: np.random.Generator, count: int) -> FloatArray:
    """So many points (N, 3), and a few more, on the walls, floor and ceiling of a room that looks alike nowhere."""
    corners = np.array([[-4, -3], [6, -3], [6, 1], [1, 1], [1, 5], [-4, 5], [-4, -3]], dtype=float)
    parts = []
    for a, b in pairwise(corners):
        along = rng.uniform(0.0, 1.0, (round(count * np.linalg.norm(b - a) / 36.0), 1))
        parts.append(np.column_stack([a + along * (b - a), rng.uniform(-1.5, 1.5, len(along))]))
    flat = rng.uniform([-4, -3], [6, 5], (count, 2))
    flat = flat[(flat[:, 0] < 1) | (flat[:, 1] < 1)]
    parts += [np.column_stack([flat, np.full(len(flat), z)]) for z in (-1.5, 1.5)]
    return np.concatenate(parts)


def grass_on_a_slope(rng: np.random.Generator, blade_m: float) -> tuple[FloatArray, FloatArray]:
    """Points (N, 3) of blades up to a height, and the unit normal (3,) of the slope below, the same everywhere."""
    plane, normal = rng.uniform(-6.0, 6.0, (6000, 2)), np.array([-0.1, 0.05, 1.0])
    heights = -2.0 - plane @ normal[:2] + rng.uniform(0.0, blade_m, len(plane))
    return np.column_stack([plane, heights]), normal / np.linalg.norm(normal)
