"""What grass makes of true ranges: rays that would meet the ground end at a blade before it, by chance."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Grass

# A ray that meets the ground at a smaller cosine than this (87 degrees) has no longer path among the blades than at it.
_LEAST_COSINE = 0.05
# The tips of the blades are between this share of the grass's height and all of it.
_SHORTEST_BLADE = 0.5


def ranges_in_grass(
    grass: Grass, points: FloatArray, ranges: FloatArray, cosines: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Ranges (N,) of rays to the ground that blades may shorten, and which of them (N,) ended at a blade.

    The path among blades of height h at incidence cosine c is h / c long; until a blade is met it is exponentially
    distributed (Beer and Lambert's law). Close by most rays reach the ground, far away hardly any.

    Args:
        grass: of the world.
        points: (N, 3) where the rays meet the ground, in the world.
        ranges, cosines: (N,) to the ground, and of the incidence there.
        rng: of blades and tips.
    """
    tips = grass.heights.height_at(points[:, :2]) * rng.uniform(_SHORTEST_BLADE, 1.0, len(points))
    path = np.minimum(tips / np.maximum(cosines, _LEAST_COSINE), ranges)
    until_blade = rng.exponential(grass.free_path_m, len(points))
    is_blade = until_blade < path
    return ranges - np.where(is_blade, path - until_blade, 0.0), is_blade
