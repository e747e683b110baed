"""Point-to-plane correspondences of a set of points with grids of surfels, kept from one pose to the next."""

from collections.abc import Sequence

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.registration.surfaces import Matcher, Surfaces
from lidarslam.mapping.surfels.correspondence_kernels import match_compact, match_planes
from lidarslam.mapping.surfels.grid import SurfelGrid
from lidarslam.mapping.surfels.voxel_hash import point_keys

# Largest extent of a compact object along an axis, in cells: evenly filled, a surfel has a standard deviation of 0.8.
_COMPACT = 0.5
# Standard deviation of a normal from which a coarser plane is asked for: in grass, the finest cells have normals of any
# direction.
_CERTAIN_TILT = 0.02
# No cell has this key.
_NOWHERE = -1


class SurfelMatcher(Matcher):
    """Surfels of the cells that points lie in.

    A point that has stayed in its cell keeps its surface: once an iteration moves by a small part of a cell, few are
    looked up again. The grids must not change meanwhile.

    Args:
        grids: the finest first; each cell of one lies within a cell of the next.
        count: N.
        keeps_finest: whether planes of uncertain normals are kept. In a young map coarser ones are of a few strokes;
            without an IMU, whose prediction they would contradict, they still hold a fast start.
    """

    def __init__(self, grids: Sequence[SurfelGrid], count: int, keeps_finest: bool = False) -> None:
        self._grids, self._certain_tilt = grids, np.inf if keeps_finest else _CERTAIN_TILT
        self._cells = np.full(count, _NOWHERE, dtype=np.int64)
        self._spread_m = np.empty(count)  # standard deviation of the points of each plane from it
        self.surfaces = Surfaces.none(count)

    def match(self, points: FloatArray, T_world_lidar: FloatArray) -> None:
        """Update the surfaces for points (N, 3) of the world, seen from a pose (4, 4)."""
        points, T = np.ascontiguousarray(points), np.ascontiguousarray(T_world_lidar)
        cells = point_keys(points, self._grids[0].cell_m)
        unmatched = np.flatnonzero(cells != self._cells)
        self._cells = cells
        if not len(unmatched):
            return
        self.surfaces.counts[unmatched] = 0
        sensor, finest = np.array(T[:3, 3]), None
        for grid in self._grids:
            rows = grid.find(points.take(unmatched, axis=0), sensor)
            surfels = grid.refreshed(rows)
            if finest is None:
                finest = np.empty(len(points), dtype=np.int32), surfels
                finest[0][unmatched] = rows
            given = self._spread_m, self._certain_tilt, self.surfaces
            unmatched = unmatched[: match_planes(points, unmatched, rows, surfels, sensor, *given)]
        assert finest is not None
        match_compact(points, unmatched, *finest, T, _COMPACT * self._grids[0].cell_m, self.surfaces)
