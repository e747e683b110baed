"""A grid of surfels: in every cell of space the plane, or the line, that the points around it lie on.

A cell keeps the sums of its points' moments, so that adding a scan touches only the cells it falls into. What a cell
shows of the surface comes from its own sums and those of its 26 neighbours: patches overlap, and no wall is cut at a
cell's border. It is worked out when the cell is looked up, and again when the cell has grown.

A cell has another side where the plane it shows was seen from behind: cells of their own, in the same place.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved, State
from mapping.surfels import cell_kernels as kernels
from mapping.surfels.patch_kernels import refresh
from mapping.surfels.patches import PATCH_COLUMNS, PatchTable
from mapping.surfels.side_kernels import belong_to_others, turn_to_sensor
from mapping.surfels.symmetric import SYMMETRIC
from mapping.surfels.voxel_hash import ABSENT, Rows, VoxelTable, cell_keys, key_cells, point_keys

# Columns of a cell's sums: points, first and second moments about the cell's centre in units of the cell, first and
# second moment of the elevation they were seen at, and the sum of the directions that they were seen from.
_COUNT, _FIRST, _SECOND, _ELEVATION, _VIEW = 0, slice(1, 4), slice(4, 10), slice(10, 12), slice(12, 15)
_COLUMNS = 15

# A cell is handed on to another grid as so many points.
_SAMPLES = 6
# What noise and single misplaced scans left: cells that have less than this share of the mean of those in a cube of so
# many cells around. They are looked for whenever there are so many times the cells there were.
_STRAY_SHARE = 0.05
_AROUND = 12
_REGROWN = 1.1


class SurfelGrid:
    """Cells of one size, in the world."""

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self._table = VoxelTable()
        self._keys = np.zeros(0, dtype=np.int64)
        self._others = np.zeros(0, dtype=np.int32)
        self._sums = np.zeros((0, _COLUMNS), dtype=np.float32)
        self._patches = np.zeros((0, PATCH_COLUMNS))
        self._patch_counts = np.zeros(0, dtype=np.float32)
        self._tidied = 0  # how many cells were left when strays were forgotten last

    def __len__(self) -> int:
        return len(self._table)

    def state(self) -> State:
        """The cells in the order of their rows, and what was worked out of each."""
        count = len(self)
        return {
            "cell_m": self.cell_m,
            "keys": self._keys[:count],
            "sums": self._sums[:count],
            "patches": self._patches[:count],
            "patch_counts": self._patch_counts[:count],
            "tidied": self._tidied,
        }

    @classmethod
    def restored(cls, saved: Saved) -> "SurfelGrid":
        """The grid with a state."""
        grid = cls(saved.number("cell_m"))
        grid._keys = saved.array("keys", (None,), np.int64)
        count = len(grid._keys)
        grid._sums = saved.array("sums", (count, _COLUMNS), np.float32)
        grid._patches = saved.array("patches", (count, PATCH_COLUMNS))
        grid._patch_counts = saved.array("patch_counts", (count,), np.float32)
        grid._index()
        grid._tidied = saved.integer("tidied")
        return grid

    def add(self, points: FloatArray, elevations: FloatArray, views: NDArray[np.floating[Any]]) -> None:
        """Add points (N, 3) of the world.

        Args:
            points: which.
            elevations: (N,) angles above the sensor's own equator that they were seen at, radians.
            views: (N, 3) unit, from the points to the sensor.
        """
        if not len(points):
            return
        points = np.ascontiguousarray(points)
        views = np.ascontiguousarray(views, dtype=np.float32)
        keys = point_keys(points, self.cell_m)
        rows = self._table.insert(keys)
        self._reserve(len(self._table))
        behind = np.empty(len(points), dtype=np.bool_)
        belong_to_others(views, rows, self._cells(), self._patches, self._patch_counts, behind)
        turned = np.flatnonzero(behind)
        if len(turned):
            keys[turned] |= kernels.OTHER_SIDE
            rows[turned] = self._table.insert(keys[turned])
            self._reserve(len(self._table))
            kernels.link_sides(keys[turned], rows[turned], *self._table.slots, self._others)
        seen = np.ascontiguousarray(elevations), views
        kernels.add_moments(points, *seen, keys, rows, self.cell_m, self._keys, self._sums)

    def add_samples(self, points: FloatArray, elevations: FloatArray, views: FloatArray) -> None:
        """Add the `samples` of another grid; unlike a scan's, those (N, 3) in one cell may be of both its sides."""
        _, first, cell = np.unique(point_keys(points, self.cell_m), return_index=True, return_inverse=True)
        like_first = np.einsum("ij,ij->i", views, views[first[cell]]) >= 0.0
        for part in (like_first, ~like_first):
            self.add(points[part], elevations[part], views[part])

    def look_up(self, points: FloatArray, sensor: FloatArray | None = None) -> Rows:
        """Rows (N,) of the cells that points (N, 3) of the world lie in, else of the nearest around; or `ABSENT`.

        Of a cell with two sides, the one that faces a sensor (3,) that sees the points, or without it the first.
        """
        points, rows = np.ascontiguousarray(points), np.empty(len(points), dtype=np.int32)
        kernels.look_up(points, self._cells(), rows)
        if sensor is not None:
            sensor = np.ascontiguousarray(sensor)
            turn_to_sensor(points, sensor, self._cells(), self._patches, self._patch_counts, rows)
        return rows

    def patches(self, rows: Rows) -> PatchTable:
        """What the cells in these rows (N,) show."""
        return PatchTable(self.all_patches(rows).take(rows, axis=0))

    def all_patches(self, rows: Rows) -> FloatArray:
        """What cells show, row by row, as the values of a `PatchTable`; up to date in these rows (N,), or `ABSENT`."""
        refresh(rows, self._cells(), self._patches, self._patch_counts)
        return self._patches

    def means(self) -> FloatArray:
        """The mean point (M, 3) of every cell, in the world."""
        count = len(self._table)
        means = key_cells(self._keys[:count]) + 0.5 + self._sums[:count, _FIRST] / self._sums[:count, _COUNT, None]
        return np.asarray(means * self.cell_m, dtype=np.float64)

    def samples(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points (S, 3) of the world, their elevations (S,) and views (S, 3) with the moments of the cells: six a cell,
        two along each axis of its own points, or the mean alone where it has fewer than six."""
        count = len(self._table)
        sums = self._sums[:count].astype(np.float64)
        counts = sums[:, _COUNT]
        mean = sums[:, _FIRST] / counts[:, None]
        covariance = np.empty((count, 3, 3))
        for column, (i, j) in enumerate(SYMMETRIC, _SECOND.start):
            covariance[:, i, j] = covariance[:, j, i] = sums[:, column] / counts - mean[:, i] * mean[:, j]
        values, axes = np.linalg.eigh(covariance)
        # Three times the variance, as only one pair in three lies along each axis; and no farther than the cell goes.
        reach = np.minimum(np.sqrt(3.0 * np.maximum(values, 0.0)), 0.5)
        reach[counts < _SAMPLES] = 0.0
        arms = np.swapaxes(axes, 1, 2) * reach[:, :, None]
        offsets = np.concatenate([arms, -arms], axis=1)
        spread = _spread(counts, sums[:, _ELEVATION])[:, None] * np.repeat([1.0, -1.0], 3)
        elevations = sums[:, _ELEVATION.start, None] / counts[:, None] + spread
        points = (key_cells(self._keys[:count]) + 0.5 + mean)[:, None] + offsets
        several = np.ones((count, _SAMPLES), dtype=np.bool_)
        several[counts < _SAMPLES, 1:] = False
        views = np.repeat((sums[:, _VIEW] / counts[:, None])[:, None], _SAMPLES, axis=1)
        return points[several] * self.cell_m, elevations[several], views[several]

    def forget_beyond(self, centre: FloatArray, radius_m: float) -> None:
        """Drop the cells farther than `radius_m` from `centre` (3,)."""
        count = len(self._table)
        offsets = (key_cells(self._keys[:count]) + 0.5) * self.cell_m - centre
        kept = np.flatnonzero(np.einsum("ij,ij->i", offsets, offsets) <= radius_m**2)
        self._keep(kept)

    def tidy(self) -> None:
        """Have all that cells show worked out anew, and forget strays.

        What a cell shows is worked out again only when it has grown itself. One beside a wall hardly does, while the
        wall grows a hundredfold; and where a sensor goes round and round, noise reaches ever more cells.
        """
        count = len(self._table)
        if count > _REGROWN * self._tidied:
            counts = self._sums[:count, _COUNT]
            _, cube = np.unique(cell_keys(key_cells(self._keys[:count]) // _AROUND), return_inverse=True)
            mean = np.bincount(cube, weights=counts) / np.bincount(cube)
            self._keep(np.flatnonzero(counts >= _STRAY_SHARE * mean[cube]))
            self._tidied = len(self._table)
        self._patch_counts[:] = 0.0

    def _keep(self, kept: NDArray[np.intp]) -> None:
        """Drop all cells but those in these rows."""
        if len(kept) == len(self._table):
            return
        self._keys = self._keys[kept]
        self._sums = self._sums[kept]
        self._patches = self._patches[kept]
        self._patch_counts = self._patch_counts[kept]
        self._index()

    def _index(self) -> None:
        """Find cells, and their other sides, by their keys; another side without the first one becomes the first."""
        self._table.rebuild(self._keys)
        others = np.flatnonzero(self._keys < 0)
        first = self._keys[others] & kernels.FIRST_SIDE
        is_lone = self._table.find(first) == ABSENT
        if is_lone.any():
            self._keys[others[is_lone]] = first[is_lone]
            self._table.rebuild(self._keys)
        self._others = np.full(len(self._keys), ABSENT, dtype=np.int32)
        rows = np.arange(len(self._keys), dtype=np.int32)
        kernels.link_sides(self._keys, rows, *self._table.slots, self._others)

    def _cells(self) -> kernels.Cells:
        return kernels.Cells(self.cell_m, *self._table.slots, self._keys, self._others, self._sums)

    def _reserve(self, count: int) -> None:
        if count <= len(self._keys):
            return
        capacity = max(4096, 2 * count)
        self._keys = _extended(self._keys, capacity)
        others = np.full(capacity, ABSENT, dtype=np.int32)
        others[: len(self._others)] = self._others
        self._others = others
        self._sums = _extended(self._sums, capacity)
        self._patches = _extended(self._patches, capacity)
        self._patch_counts = _extended(self._patch_counts, capacity)


def _spread(counts: FloatArray, moments: FloatArray) -> FloatArray:
    """Standard deviation (N,) from counts (N,) and first and second moments (N, 2)."""
    mean = moments[:, 0] / counts
    return np.sqrt(np.maximum(moments[:, 1] / counts - mean * mean, 0.0))


def _extended(values: NDArray[Any], capacity: int) -> NDArray[Any]:
    out = np.zeros((capacity, *values.shape[1:]), dtype=values.dtype)
    out[: len(values)] = values
    return out
