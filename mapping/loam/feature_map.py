"""Map of edges and planar points: their moments in voxels of several sizes, and the lines and planes through these."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Shape, Stateful
from lidarslam.mapping.loam.feature_kernels import EDGE
from lidarslam.mapping.loam.neighbour_kernels import Voxels, add_moments, match_features
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.local_map import LEVELS, LocalMap
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.registration.surfaces import Matcher, Surfaces
from lidarslam.mapping.surfels.voxel_hash import VoxelHash, point_keys

# Correspondences are kept over a displacement of this share of a cell.
_SAME_CELLS = 0.1


class VoxelGrid(Stateful):
    """Number, mean and covariance of the points in each voxel.

    A mean of the last mean and the new scan's, as of PCL's voxel grid, would halve the weight of earlier scans each
    time: the map would follow the sensor.
    """

    cell_m: float
    _keys: Annotated[NDArray[np.int64], Shape(None)]  # (M,) of the voxels, by row
    _sums: Annotated[FloatArray, Shape(None, 10)]  # (M, 10) see `Voxels`

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self._keys, self._sums = np.empty(0, dtype=np.int64), np.empty((0, 10))
        self._hash = VoxelHash()

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def means(self) -> FloatArray:
        """(M, 3) in the world."""
        return np.asarray(self._sums[:, 1:4] / self._sums[:, :1], dtype=np.float64)

    def insert(self, points: FloatArray) -> None:
        """Insert points (N, 3) of the world."""
        keys = point_keys(points, self.cell_m)
        rows = self._hash.insert(keys)
        new = np.flatnonzero(rows >= len(self._keys))
        if len(new):
            grown = np.empty(len(self._hash), dtype=np.int64)
            grown[: len(self._keys)], grown[rows[new]] = self._keys, keys[new]
            self._sums = np.concatenate([self._sums, np.zeros((len(grown) - len(self._keys), 10))])
            self._keys = grown
        add_moments(np.ascontiguousarray(points), rows, self._sums)

    def insert_means(self, other: "VoxelGrid") -> None:
        """Insert the voxels of another grid, with their numbers of points."""
        rows = self._hash.insert(point_keys(other.means, self.cell_m))
        self._keys, self._sums = np.empty(len(self._hash), dtype=np.int64), np.zeros((len(self._hash), 10))
        self._keys[rows] = point_keys(other.means, self.cell_m)
        np.add.at(self._sums, rows, other._sums)

    def drop_beyond(self, centre: FloatArray, radius_m: float) -> None:
        """Drop the voxels farther than `radius_m` from `centre` (3,)."""
        near = np.flatnonzero(np.linalg.norm(self.means - centre, axis=1) < radius_m)
        self._keys, self._sums = self._keys[near], self._sums[near]
        self._hash.rebuild(self._keys)

    @property
    def voxels(self) -> Voxels:
        """The arrays for compiled loops."""
        return Voxels(self.cell_m, *self._hash.slots, self._sums)

    def _after_restore(self) -> None:
        self._hash = VoxelHash()
        self._hash.rebuild(self._keys)


class FeatureMatcher(Matcher):
    """Lines of edges and planes of other points, through their nearest voxels.

    A point that has moved by a small part of a cell since it was matched keeps its line or plane.

    Args:
        edges, planes: grids of voxels, the finest first.
        sweep: with the kinds of its points; without, all points are planar.
    """

    def __init__(self, edges: list[VoxelGrid], planes: list[VoxelGrid], sweep: Sweep) -> None:
        self._edges, self._planes = edges, planes
        self._is_edge = _edges_of(sweep)
        self._matched = np.full((len(sweep), 3), np.inf)  # where the points were matched
        self.surfaces = Surfaces.none(len(sweep))

    def match(self, points: FloatArray, T_world_lidar: FloatArray) -> None:
        """See `Matcher`."""
        points, sensor = np.ascontiguousarray(points), np.array(T_world_lidar[:3, 3])
        moved = np.abs(points - self._matched).max(axis=1) > _SAME_CELLS * self._planes[0].cell_m
        self._matched[moved] = points[moved]
        self.surfaces.counts[moved] = 0
        for is_line, grids in ((True, self._edges), (False, self._planes)):
            unmatched = np.flatnonzero(moved & (self._is_edge == is_line))
            for grid in grids:
                if not len(unmatched):
                    break
                left = match_features(points, unmatched, is_line, grid.voxels, sensor, self.surfaces)
                unmatched = unmatched[:left]


class FeatureMap(LocalMap):
    """Edges and planar points within a radius of the sensor."""

    _edges: list[VoxelGrid]
    _planes: list[VoxelGrid]

    def __init__(self, cell_m: float, radius_m: float) -> None:
        super().__init__(cell_m, radius_m)
        self._edges, self._planes = ([VoxelGrid(cell_m * level) for level in LEVELS] for _ in range(2))

    @property
    def grids(self) -> list[VoxelGrid]:
        """See `LocalMap`."""
        return [*self._edges, *self._planes]

    def add(self, scan: SampledScan, points: FloatArray, sensor: FloatArray) -> None:
        """See `LocalMap`."""
        is_edge = _edges_of(scan.sweep)
        for grids, chosen in ((self._edges, points[is_edge]), (self._planes, points[~is_edge])):
            for grid in grids:
                grid.insert(chosen)
        self._count(sensor)

    def matcher(self, sweep: Sweep, level: int = 0, is_inertial: bool = False) -> FeatureMatcher:  # noqa: ARG002
        """See `LocalMap`."""
        return FeatureMatcher(self._edges[level:], self._planes[level:], sweep)

    def resample(self, other: "FeatureMap") -> None:
        """See `LocalMap`."""
        for grids, finest in ((self._edges, other._edges[0]), (self._planes, other._planes[0])):
            for grid in grids:
                grid.insert_means(finest)

    def means(self) -> FloatArray:
        """See `LocalMap`."""
        return np.concatenate([self._edges[1].means, self._planes[1].means])

    def level_normals(self) -> FloatArray:
        """See `LocalMap`."""
        normals, spread_m = self.coarse_planes(self._planes[-1].means, np.zeros(3))
        return normals[np.isfinite(spread_m)]

    def coarse_planes(self, points: FloatArray, sensor: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `LocalMap`."""
        found, unmatched = Surfaces.none(len(points)), np.arange(len(points))
        voxels = self._planes[-1].voxels
        match_features(np.ascontiguousarray(points), unmatched, False, voxels, np.array(sensor), found)
        return found.normals[:, 0], np.where(found.counts > 0, found.thickness_m[:, 0], np.inf)


def _edges_of(sweep: Sweep) -> NDArray[np.bool_]:
    """Which points (N,) of a sweep are edges."""
    return np.zeros(len(sweep), dtype=np.bool_) if sweep.kinds is None else sweep.kinds == EDGE
