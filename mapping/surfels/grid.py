"""Grid of surfels: the plane, and its extent, of the points in and around every occupied cell.

A cell holds the sums of its points' moments, so that a scan's insertion touches only the cells that it falls into. A
surfel is computed from the sums of its cell and the 26 neighbours when the cell is looked up, and again when the cell
has grown; surfels overlap, so that no wall is cut at a cell's border. A plane seen from behind has a second cell in the
same place, its other side.
"""

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Shape, State, Stateful
from lidarslam.mapping.surfels.surfel_kernels import (
    OTHER,
    Arrays,
    Cells,
    add_moments,
    belong_to_others,
    link_sides,
    look_up,
    refresh,
    turn_to_sensor,
)
from lidarslam.mapping.surfels.symmetric import SYMMETRIC
from lidarslam.mapping.surfels.voxel_hash import (
    ABSENT,
    FIRST_SIDE,
    OTHER_SIDE,
    Keys,
    Rows,
    VoxelHash,
    cell_keys,
    key_cells,
    point_keys,
    resized,
    write_new_keys,
)

# Columns of a cell's sums: number of points, first and second moments about the cell's centre in units of the cell,
# first and second moment of the elevation, the sum of the view directions, and the link to the other side.
_COUNT, _FIRST, _SECOND, _ELEVATION, _VIEW = 0, slice(1, 4), slice(4, 10), slice(10, 12), slice(12, 15)
_SUMS, _SURFELS = 16, 15
# Columns of surfels: mean in the world, unit axes of least (towards the sensor) and of largest extent, standard
# deviations along the principal axes (ascending) and of the elevation (radians; -1 without rings), weighted number of
# points, whether it is a plane.
MEAN, NORMAL, DIRECTION, SPREADS = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
ELEVATION_SPREAD, COUNT, IS_PLANE = 12, 13, 14

# Points that represent a cell in a grid of another size.
_SAMPLES = 6
# Stray cells have less than this share of the mean number of points in a cube of this many cells. They are looked for
# whenever the number of cells has grown by this factor.
_STRAY_SHARE = 0.05
_AROUND = 12
_REGROWN = 1.1


class SurfelGrid(Stateful):
    """Cells of one size, in the world."""

    cell_m: float
    _keys: Annotated[NDArray[np.int64], Shape(None)]
    _sums: Annotated[NDArray[np.float32], Shape(None, _SUMS)]
    _surfels: Annotated[FloatArray, Shape(None, _SURFELS)]
    _surfel_counts: Annotated[NDArray[np.float32], Shape(None)]
    _tidied: int

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self._hash = VoxelHash()
        self._keys = np.zeros(0, dtype=np.int64)
        self._sums = np.zeros((0, _SUMS), dtype=np.float32)
        self._surfels = np.zeros((0, _SURFELS))
        self._surfel_counts = np.zeros(0, dtype=np.float32)  # points of the cell when its surfel was computed
        self._tidied = 0  # cells left at the last removal of strays

    def __len__(self) -> int:
        return len(self._hash)

    def state(self) -> State:
        """The cells in the order of their rows, and their surfels."""
        self._resize(len(self))
        return super().state()

    def _after_restore(self) -> None:
        self._hash = VoxelHash()
        self._resize(len(self._keys))
        self._index(len(self._keys))

    def insert(
        self, points: FloatArray, elevations: FloatArray, views: NDArray[np.floating[Any]], weight: float = 1.0
    ) -> None:
        """Insert points (N, 3) of the world, each of which counts as `weight`.

        They have elevations (N,) above the sensor's equator, radians, and unit views (N, 3) towards the sensor.
        """
        if not len(points):
            return
        points = np.ascontiguousarray(points)
        views = np.ascontiguousarray(views, dtype=np.float32)
        keys = point_keys(points, self.cell_m)
        rows = self._rows_of(keys)
        behind = np.empty(len(points), dtype=np.bool_)
        belong_to_others(views, rows, *self.arrays, behind)
        turned = np.flatnonzero(behind)
        if len(turned):
            keys[turned] |= OTHER_SIDE
            rows[turned] = self._rows_of(keys[turned])
            link_sides(keys[turned], rows[turned], *self._hash.slots, self._sums)
        add_moments(points, np.ascontiguousarray(elevations), views, rows, self.cell_m, self._sums, weight)

    def insert_samples(self, points: FloatArray, elevations: FloatArray, views: FloatArray) -> None:
        """Insert the `samples` of another grid; samples in one cell may be of both its sides."""
        _, first, cell = np.unique(point_keys(points, self.cell_m), return_index=True, return_inverse=True)
        like_first = np.einsum("ij,ij->i", views, views[first[cell]]) >= 0.0
        for part in (like_first, ~like_first):
            self.insert(points[part], elevations[part], views[part])

    def find(self, points: FloatArray, sensor: FloatArray | None = None) -> Rows:
        """Rows (N,) of the cells of points (N, 3) of the world, else of the nearest cells around; or `ABSENT`.

        Of a cell with two sides, the one that faces the sensor (3,), or the first where no sensor is given.
        """
        points, rows = np.ascontiguousarray(points), np.empty(len(points), dtype=np.int32)
        look_up(points, self.arrays[0], rows)
        if sensor is not None:
            turn_to_sensor(points, np.ascontiguousarray(sensor), *self.arrays, rows)
        return rows

    def surfels(self, rows: Rows) -> FloatArray:
        """Surfels (N, 15) of the cells in these rows (N,)."""
        return self.refreshed(rows).take(rows, axis=0)

    def refreshed(self, rows: Rows) -> FloatArray:
        """Surfels (M, 15) of all cells by row, up to date in these rows (N,), or `ABSENT`."""
        refresh(rows, *self.arrays)
        return self._surfels

    @property
    def arrays(self) -> Arrays:
        """For compiled loops."""
        return Cells(self.cell_m, *self._hash.slots, self._keys, self._sums), self._surfels, self._surfel_counts

    def means(self) -> FloatArray:
        """Mean point (M, 3) of every cell, in the world."""
        count = len(self)
        means = key_cells(self._keys[:count]) + 0.5 + self._sums[:count, _FIRST] / self._sums[:count, _COUNT, None]
        return np.asarray(means * self.cell_m, dtype=np.float64)

    def samples(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points (S, 3) of the world, their elevations (S,) and views (S, 3), with the moments of the cells.

        Six per cell, two along each principal axis of its own points, or the mean alone of a cell with fewer than six.
        """
        count = len(self)
        sums = self._sums[:count].astype(np.float64)
        counts = sums[:, _COUNT]
        mean = sums[:, _FIRST] / counts[:, None]
        covariance = np.empty((count, 3, 3))
        for column, (i, j) in enumerate(SYMMETRIC, _SECOND.start):
            covariance[:, i, j] = covariance[:, j, i] = sums[:, column] / counts - mean[:, i] * mean[:, j]
        values, axes = np.linalg.eigh(covariance)
        # Three times the variance, as only one pair in three is along each axis; clipped to the cell.
        reach = np.minimum(np.sqrt(3.0 * np.maximum(values, 0.0)), 0.5)
        reach[counts < _SAMPLES] = 0.0
        arms = np.swapaxes(axes, 1, 2) * reach[:, :, None]
        offsets = np.concatenate([arms, -arms], axis=1)
        elevation, squared = sums[:, _ELEVATION].T / counts
        spread = np.sqrt(np.maximum(squared - elevation * elevation, 0.0))
        elevations = elevation[:, None] + spread[:, None] * np.repeat([1.0, -1.0], 3)
        points = (key_cells(self._keys[:count]) + 0.5 + mean)[:, None] + offsets
        several = np.ones((count, _SAMPLES), dtype=np.bool_)
        several[counts < _SAMPLES, 1:] = False
        views = np.repeat((sums[:, _VIEW] / counts[:, None])[:, None], _SAMPLES, axis=1)
        return points[several] * self.cell_m, elevations[several], views[several]

    def drop_beyond(self, centre: FloatArray, radius_m: float) -> None:
        """Drop the cells farther than `radius_m` from `centre` (3,)."""
        away = (key_cells(self._keys[: len(self)]) + 0.5) * self.cell_m - centre
        self._keep(np.flatnonzero((away**2).sum(axis=1) <= radius_m**2))

    def tidy(self) -> None:
        """Recompute all surfels, and drop stray cells.

        A surfel is computed again only when its own cell has grown, which a cell next to a wall hardly does while the
        wall grows a hundredfold. Where a sensor circles, noise reaches ever more cells.
        """
        count = len(self)
        if count > _REGROWN * self._tidied:
            counts = self._sums[:count, _COUNT]
            _, cube = np.unique(cell_keys(key_cells(self._keys[:count]) // _AROUND), return_inverse=True)
            mean = np.bincount(cube, weights=counts) / np.bincount(cube)
            self._keep(np.flatnonzero(counts >= _STRAY_SHARE * mean[cube]))
            self._tidied = len(self)
        self._surfel_counts[:] = 0.0

    def _keep(self, kept: NDArray[np.intp]) -> None:
        """Keep the cells in these rows only."""
        count = len(self)
        if len(kept) == count:
            return
        for values in (self._keys, self._sums, self._surfels, self._surfel_counts):
            values[: len(kept)] = values.take(kept, axis=0)
            values[len(kept) : count] = 0  # new cells begin empty
        self._index(len(kept))

    def _index(self, count: int) -> None:
        """Rebuild the hash and the links of sides; the other side of a cell without a first one becomes the first."""
        keys = self._keys[:count]
        self._hash.rebuild(keys)
        others = np.flatnonzero(keys < 0)
        first = keys[others] & FIRST_SIDE
        is_lone = self._hash.find(first) == ABSENT
        if is_lone.any():
            keys[others[is_lone]] = first[is_lone]
            self._hash.rebuild(keys)
        self._sums[:, OTHER] = 0.0
        link_sides(keys, np.arange(count, dtype=np.int32), *self._hash.slots, self._sums)

    def _rows_of(self, keys: Keys) -> Rows:
        """Rows (N,) of keys (N,), new ones for new keys."""
        known, rows = len(self), self._hash.insert(keys)
        if len(self) > len(self._keys):
            self._resize(max(4096, 2 * len(self)))
        write_new_keys(keys, rows, known, self._keys)
        return rows

    def _resize(self, capacity: int) -> None:
        self._keys = resized(self._keys, capacity)
        self._sums = resized(self._sums, capacity)
        self._surfels = resized(self._surfels, capacity)
        self._surfel_counts = resized(self._surfel_counts, capacity)
