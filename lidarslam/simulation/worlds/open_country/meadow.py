"""Grass that grows unevenly on a ground."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Grass, HeightField
from lidarslam.simulation.worlds.building import smooth_noise

# Of meadows: at 10 degrees of incidence a ray sees half a decimetre deep.
_FREE_PATH_M = 0.3
_EDGE_M = 0.6


def grown(rng: np.random.Generator, ground: HeightField, height_m: FloatArray, distance_m: FloatArray) -> Grass:
    """Tussocks on the ground's grid.

    Args:
        rng: of the tussocks.
        ground: whose grid (X, Y) it is.
        height_m: (X, Y) mean height of the blades, 0 where none grow.
        distance_m: (X, Y) from what is kept free of grass, negative on it.
    """
    shape = (ground.heights.shape[0], ground.heights.shape[1])
    tussocks = 1.0 + 0.3 * smooth_noise(rng, shape, 1.0) + 0.3 * smooth_noise(rng, shape, 8.0)
    heights = height_m * np.clip(tussocks, 0.2, 2.0) * np.clip(distance_m / _EDGE_M, 0.0, 1.0)
    return Grass(HeightField(ground.origin_xy, ground.cell_m, heights), _FREE_PATH_M)
