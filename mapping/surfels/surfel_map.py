"""Local map of surfels in three sizes of cells, and the point-to-plane correspondences of a scan with it."""

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state.stateful import Shape, Stateful
from lidarslam.mapping.surfels.cell_kernels import write_views
from lidarslam.mapping.surfels.grid import IS_PLANE, NORMAL, SurfelGrid
from lidarslam.mapping.surfels.matching import Correspondences, Matcher
from lidarslam.mapping.surfels.voxel_hash import require_reach

# Sizes of the grids, in cells. A point's correspondence is the plane of the finest grid that has one.
LEVELS = (1, 2, 4)
# Cells beyond the radius are dropped each time the sensor has moved by this share of it.
_FORGET_AFTER = 0.2
# Scans between two removals of stray cells.
_TIDIED_AFTER = 500
# Surfaces within this cosine of the z axis are floors or ceilings.
_LEVEL_COSINE = 0.7
# Spread of the elevations of points that were seen from many places.
_ANY_HEIGHT_RAD = 0.2
# Surfels of fewer scans are of few points: their normals are uncertain.
_YOUNG_SCANS = 5
# A direction that few walls are parallel to.
_UNEVEN = np.array([0.46, 0.29, 0.84])


class SurfelMap(Stateful):
    """Surfels within a radius of the sensor."""

    cell_m: float  # edge of the finest cells
    scans: int  # number of inserted scans
    _radius_m: float
    _grids: list[SurfelGrid]
    _centre: Annotated[FloatArray, Shape(3)] | None

    def __init__(self, cell_m: float, radius_m: float) -> None:
        self.cell_m = cell_m
        self.scans = 0
        self._radius_m = radius_m
        self._grids = [SurfelGrid(cell_m * level) for level in LEVELS]
        self._centre = None

    @classmethod
    def of_cloud(cls, points: FloatArray, normals: FloatArray, cell_m: float, radius_m: float) -> "SurfelMap":
        """The surfels of points (N, 3) of the world whose normals (N, 3) face the side that was seen.

        Raises:
            InputError: points lie beyond the reach of the cells.
        """
        require_reach(points, cell_m)
        surfel_map = cls(cell_m, radius_m)
        # No plane of a merged map is that of a single ring.
        elevations = np.where(np.arange(len(points)) % 2, _ANY_HEIGHT_RAD, -_ANY_HEIGHT_RAD)
        # The two sides of a thin wall after one another: the second is known by its view then.
        faces_up = normals @ _UNEVEN > 0.0
        for side in (faces_up, ~faces_up):
            surfel_map.insert_seen(points[side], elevations[side], normals[side])
        return surfel_map

    def _after_restore(self) -> None:
        if len(self._grids) != len(LEVELS):
            raise ValueError(f"{len(self._grids)} grids instead of {len(LEVELS)}")
        sizes = [grid.cell_m / level for grid, level in zip(self._grids, LEVELS, strict=True)]
        if not (self._radius_m > 0.0 and np.allclose(sizes, self.cell_m, rtol=1e-9, atol=0.0)):
            raise ValueError(f"grids of cells of {sizes} m in a map of {self.cell_m:g} m")

    def __len__(self) -> int:
        """Number of cells in all grids."""
        return sum(len(grid) for grid in self._grids)

    @property
    def is_young(self) -> bool:
        """Whether so few scans were inserted that normals are uncertain; a map that was given has none."""
        return 0 < self.scans < _YOUNG_SCANS

    def insert(self, points: FloatArray, elevations: FloatArray, sensor: FloatArray) -> None:
        """Insert a scan.

        Args:
            points: (N, 3) in the world.
            elevations: (N,) their angles above the sensor's equator, radians.
            sensor: (3,) position in the world.
        """
        views = np.empty((len(points), 3), dtype=np.float32)
        write_views(np.ascontiguousarray(points), np.ascontiguousarray(sensor), views)
        self.insert_seen(points, elevations, views)
        if self._centre is None:
            self._centre = sensor
        if float(np.linalg.norm(sensor - self._centre)) > _FORGET_AFTER * self._radius_m:
            self._centre = sensor
            for grid in self._grids:
                grid.drop_beyond(sensor, self._radius_m)
        self.scans += 1
        if self.scans % _TIDIED_AFTER == 0:
            for grid in self._grids:
                grid.tidy()

    def insert_seen(
        self, points: FloatArray, elevations: FloatArray, views: NDArray[np.floating[Any]], weight: float = 1.0
    ) -> None:
        """Insert points (N, 3) of the world, with elevations (N,), seen from along views (N, 3), unit length.

        Each counts as so many points as its weight.
        """
        for grid in self._grids:
            grid.insert(points, elevations, views, weight)

    def match(self, points: FloatArray, T_world_lidar: FloatArray, level: int = 0) -> Correspondences:
        """Correspondences of points (N, 3) of the world, seen from a pose (4, 4).

        A point corresponds to the plane of the finest grid that has one in its cell; where none has, to the middle of a
        compact object in the finest grid, along the axes of small extent.

        Args:
            points: in the world.
            T_world_lidar: pose of the sensor.
            level: finest grid that is used, for points that may be off by more than a cell.
        """
        matcher = self.matcher(len(points), level)
        matcher.match(points, T_world_lidar)
        return matcher.correspondences()

    def matcher(self, count: int, level: int = 0) -> Matcher:
        """Correspondences of so many points, as of `match`, at one pose after another; until the map changes."""
        return Matcher(self._grids[level:], count)

    def vertical(self) -> FloatArray:
        """Unit normal (3,) of floors and ceilings near the sensor; the world's z axis when there are none."""
        grid = self._grids[-1]
        surfels = grid.surfels(np.arange(len(grid), dtype=np.int32))
        normals = surfels[surfels[:, IS_PLANE] > 0.0, NORMAL]
        normals = normals[np.abs(normals[:, 2]) > _LEVEL_COSINE]
        mean = (normals * np.sign(normals[:, 2:])).sum(axis=0)
        length = float(np.linalg.norm(mean))
        return np.array([0.0, 0.0, 1.0]) if length == 0.0 else np.asarray(mean / length, dtype=np.float64)

    def goes_on(
        self, points: FloatArray, normals: FloatArray, sensor: FloatArray, cosine: float, thickness: float
    ) -> NDArray[np.bool_]:
        """Whether planes (N, 3) at points (N, 3) of the world, seen from (3,), go on over the coarsest cell.

        Args:
            points: in the world.
            normals: unit.
            sensor: position in the world.
            cosine: least, between the normals.
            thickness: largest standard deviation along the normal, as a share of the cell.
        """
        grid = self._grids[-1]
        rows = grid.find(points, np.array(sensor))
        coarse = grid.refreshed(rows)[rows]
        is_plane = (rows >= 0) & (coarse[:, 14] > 0.0) & (coarse[:, 9] < thickness * grid.cell_m)
        return np.asarray(is_plane & (np.abs(np.einsum("ij,ij->i", normals, coarse[:, 3:6])) > cosine))

    def means(self) -> FloatArray:
        """Mean points (M, 3) of the cells of the middle size, in the world."""
        return self._grids[1].means()

    def resized(self, cell_m: float) -> "SurfelMap":
        """The map in cells of another size, resampled from the finest cells; the map itself for its own size."""
        if cell_m == self.cell_m:
            return self
        other = SurfelMap(cell_m, self._radius_m)
        other._centre, other.scans = self._centre, self.scans
        samples = self._grids[0].samples()
        for grid in other._grids:
            grid.insert_samples(*samples)
        return other
