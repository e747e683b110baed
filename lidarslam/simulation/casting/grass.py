"""Grass: rays that would meet the ground end at a blade before it, by chance."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Grass

# At a smaller cosine than this (87 degrees) the path among the blades is as long as at it.
_LEAST_COSINE = 0.05
# The tips of the blades are between this share of the grass's height and all of it.
_SHORTEST_BLADE = 0.5


def ranges_in_grass(
    grass: Grass, points: FloatArray, ranges: FloatArray, cosines: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Ranges (N,) of rays to points (N, 3) on the ground that blades may shorten, and which (N,) ended at a blade.

    The path among blades of height h at incidence cosine c is h / c long; until a blade is met it is exponentially
    distributed (Beer and Lambert's law). Close by most rays reach the ground, far away hardly any.
    """
    tips = grass.heights.height_at(points[:, :2]) * rng.uniform(_SHORTEST_BLADE, 1.0, len(points))
    path = np.minimum(tips / np.maximum(cosines, _LEAST_COSINE), ranges)
    until_blade = rng.exponential(grass.free_path_m, len(points))
    is_blade = until_blade < path
    return ranges - np.where(is_blade, path - until_blade, 0.0), is_blade
