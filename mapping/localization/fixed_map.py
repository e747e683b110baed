"""A finished map: its points by region as surfels to register scans to, and all of it from above to search in."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.registration.local_map import vertical_of
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.surfels.voxel_hash import point_keys, require_reach
from lidarslam.mapping.tracking.birds_eye_map import BirdsEyeMap

# Least edge of a surfel cell in spacings of the map's points. With fewer points in and around a cell normals are
# uncertain: at 1.7, roll was found to be degenerate in an office.
_CELLS_PER_SPACING = 3.5
_SAMPLES = 2000
# Edge of a cell of the view from above, in surfel cells, and of the parts of the map that are drawn, in such cells,
# with their overlap.
_VIEW_SCALE, _VIEW_CELLS, _OVERLAP_CELLS = 4.0, 800, 30


class FixedMap:
    """Points (M, 3) with unit normals (M, 3) towards the side that was seen, which are never changed."""

    def __init__(self, points: FloatArray, normals: FloatArray) -> None:
        self._points = points
        self._normals = normals
        self._least_cell_m = _CELLS_PER_SPACING * _spacing_m(points)
        self._up = vertical_of(normals)
        self._views: tuple[float, list[BirdsEyeMap]] = (0.0, [])

    def __len__(self) -> int:
        return len(self._points)

    def cell_m(self, wanted_m: float) -> float:
        """The edge of surfel cells nearest to the wanted one that the density of the points allows."""
        return max(wanted_m, self._least_cell_m)

    def region(self, centre: FloatArray, radius_m: float, cell_m: float) -> SurfelMap:
        """The surfels within a radius of a position (3,)."""
        offsets = self._points - centre
        near = np.einsum("ij,ij->i", offsets, offsets) < radius_m**2
        return SurfelMap.of_cloud(self._points[near], self._normals[near], cell_m, radius_m)

    def views(self, cell_m: float) -> list[BirdsEyeMap]:
        """The map from above, for surfel cells of an edge, in parts that overlap; kept for the next call."""
        if self._views[0] != cell_m:
            pixel_m = _VIEW_SCALE * cell_m
            require_reach(self._points, cell_m)
            _, kept = np.unique(point_keys(self._points, 0.5 * pixel_m), return_index=True)
            points = self._points[kept]
            parts = _parts(points[:, :2], _VIEW_CELLS * pixel_m, _OVERLAP_CELLS * pixel_m)
            self._views = cell_m, [BirdsEyeMap.of(points[part], self._up, pixel_m) for part in parts]
        return self._views[1]


def _spacing_m(points: FloatArray) -> float:
    """Median distance of points (M, 3) from their nearest neighbours."""
    if len(points) < 2:
        return 0.0
    sample = points[:: max(1, len(points) // _SAMPLES)]
    distances, _ = cKDTree(points, balanced_tree=False, compact_nodes=False).query(sample, k=2)
    return float(np.median(np.asarray(distances)[:, 1]))


def _parts(xy: FloatArray, edge_m: float, margin_m: float) -> list[NDArray[np.bool_]]:
    """Which of the points (M, 2) are in each square of a grid or within a margin of it; none of empty squares."""
    low = xy.min(axis=0)
    extent = xy.max(axis=0) - low
    counts = np.maximum(1, np.ceil(extent / edge_m)).astype(int)
    steps = extent / counts
    parts = []
    for i, j in np.ndindex(*counts):
        corner = low + steps * (i, j)
        inside = ((xy >= corner) & (xy <= corner + steps)).all(axis=1)
        if inside.any():
            parts.append(((xy >= corner - margin_m) & (xy <= corner + steps + margin_m)).all(axis=1))
    return parts


class Regions:
    """Regions of the map as surfels: all within reach of a position, and a margin; the latest few are kept."""

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
