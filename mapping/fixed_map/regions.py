"""Regions of a finished map as surfels, drawn where they are needed."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.fixed_map.fixed_map import FixedMap
from lidarslam.mapping.surfels.surfel_map import SurfelMap


class Regions:
    """Regions of the map as surfels.

    Args:
        fixed_map: the map.
        cell_m: edge of the surfel cells.
        reach_m: how far around a position a region must reach.
        spare_m: how much farther it reaches, so that it serves other positions too.
        kept: how many are kept.
    """

    def __init__(self, fixed_map: FixedMap, cell_m: float, reach_m: float, spare_m: float, kept: int = 1) -> None:
        self._map, self.cell_m, self._reach_m, self._spare_m, self._kept = fixed_map, cell_m, reach_m, spare_m, kept
        self._drawn: list[tuple[FloatArray, SurfelMap]] = []

    def around(self, position: FloatArray) -> SurfelMap:
        """A region with all that is within reach of a position (3,)."""
        for centre, region in self._drawn:
            if np.linalg.norm(centre - position) < self._spare_m:
                return region
        region = self._map.region(position, self._reach_m + self._spare_m, self.cell_m)
        self._drawn = [*self._drawn, (position.copy(), region)][-self._kept :]
        return region
