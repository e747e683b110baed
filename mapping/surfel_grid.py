"""A grid of surfels: in every cell of space the plane, or the line, that the points around it lie on.

A cell keeps the sums of its points' moments, so that adding a scan touches only the cells it falls into. What a cell
shows of the surface comes from its own sums and those of its 26 neighbours: patches overlap, and no wall is cut at a
cell's border. It is worked out when the cell is looked up, and again when the cell has grown.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved, State
from mapping.patches import PATCH_COLUMNS, PatchTable
from mapping.symmetric import SYMMETRIC, eigenvalues, eigenvectors
from mapping.voxel_table import ABSENT, Keys, Rows, VoxelTable, cell_keys, key_cells, key_steps

# Columns of a cell's sums: points, first and second moments about the cell's centre in units of the cell, and first
# and second moment of the elevation they were seen at.
_COUNT, _FIRST, _SECOND, _ELEVATION = 0, slice(1, 4), slice(4, 10), slice(10, 12)
_COLUMNS = 12

_NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int64)
_NEIGHBOUR_STEPS = key_steps(_NEIGHBOURS)
# Weight of a neighbour's points in a patch, by how many coordinates it differs in: near ones decide.
_NEIGHBOUR_WEIGHTS = (1.0, 0.8, 0.6, 0.4)
# The cells around an empty one, nearest first.
_AROUND = np.argsort((_NEIGHBOURS**2).sum(axis=1), kind="stable")[1:]

# A cell that has seen so many points knows its surface; it is left as it is, and drift does not smear it.
_MOST_POINTS = 60.0
# A cell is handed on to another grid as so many points.
_SAMPLES = 6
# A patch is worked out again when its cell has this many times the points it had.
_GROWTH = 1.3


def _gathering() -> NDArray[np.float32]:
    """(27 * 12, 12): takes the sums of 27 cells, each about its own centre, to one sum about the middle one's."""
    W = np.zeros((27, _COLUMNS, _COLUMNS), dtype=np.float32)
    for k, offset in enumerate(_NEIGHBOURS.astype(np.float64)):
        W[k] = _NEIGHBOUR_WEIGHTS[int(np.abs(offset).sum())] * np.eye(_COLUMNS)
        weight = W[k, 0, 0]
        W[k, _COUNT, _FIRST] = weight * offset
        for column, (i, j) in enumerate(SYMMETRIC, _SECOND.start):
            W[k, _COUNT, column] += weight * offset[i] * offset[j]
            W[k, 1 + i, column] += weight * offset[j]
            W[k, 1 + j, column] += weight * offset[i]
    return W.reshape(27 * _COLUMNS, _COLUMNS)


_GATHERING = _gathering()


class SurfelGrid:
    """Cells of one size, in the world."""

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self._table = VoxelTable()
        self._keys = np.zeros(0, dtype=np.int64)
        self._sums = np.zeros((0, _COLUMNS), dtype=np.float32)
        self._patches = np.zeros((0, PATCH_COLUMNS))
        self._patch_counts = np.zeros(0, dtype=np.float32)

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
        grid._table.rebuild(grid._keys)
        return grid

    def add(self, points: FloatArray, elevations: FloatArray) -> None:
        """Add points (N, 3) of the world, seen by the sensor at these angles (N,) above its own equator, radians."""
        if not len(points):
            return
        scaled = points * (1.0 / self.cell_m)
        cells = np.floor(scaled)
        keys = cell_keys(cells.astype(np.int64))
        order = np.argsort(keys)
        keys = keys[order]
        first = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
        local = (scaled - cells - 0.5).take(order, axis=0).astype(np.float32)
        sums = np.add.reduceat(_moments(local, elevations.take(order)), first, axis=0)
        rows = self._table.insert(keys[first])
        self._reserve(len(self._table))
        self._keys[rows] = keys[first]
        growing = self._sums[rows, _COUNT] < _MOST_POINTS
        self._sums[rows[growing]] += sums[growing]

    def look_up(self, points: FloatArray) -> Rows:
        """Rows (N,) of the cells that points (N, 3) of the world lie in, else of the nearest around; or `ABSENT`."""
        scaled = points * (1.0 / self.cell_m)
        keys = cell_keys(np.floor(scaled).astype(np.int64))
        rows = self._table.find(keys)
        missing = np.flatnonzero(rows == ABSENT)
        if len(missing):
            rows[missing] = self._nearest(keys[missing], scaled[missing])
        return rows

    def patches(self, rows: Rows) -> PatchTable:
        """What the cells in these rows (N,) show."""
        stale = np.flatnonzero(self._patch_counts[rows] * _GROWTH <= self._sums[rows, _COUNT])
        if len(stale):
            self._work_out(np.unique(rows[stale]))
        return PatchTable(self._patches.take(rows, axis=0))

    def means(self) -> FloatArray:
        """The mean point (M, 3) of every cell, in the world."""
        count = len(self._table)
        means = key_cells(self._keys[:count]) + 0.5 + self._sums[:count, _FIRST] / self._sums[:count, _COUNT, None]
        return np.asarray(means * self.cell_m, dtype=np.float64)

    def samples(self) -> tuple[FloatArray, FloatArray]:
        """Points (S, 3) of the world and their elevations (S,) with the moments of the cells: six a cell, two along
        each axis of its own points, or the mean alone where it has fewer than six."""
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
        return points[several] * self.cell_m, elevations[several]

    def forget_beyond(self, centre: FloatArray, radius_m: float) -> None:
        """Drop the cells farther than `radius_m` from `centre` (3,)."""
        count = len(self._table)
        offsets = (key_cells(self._keys[:count]) + 0.5) * self.cell_m - centre
        kept = np.flatnonzero(np.einsum("ij,ij->i", offsets, offsets) <= radius_m**2)
        if len(kept) == count:
            return
        self._keys = self._keys[kept]
        self._sums = self._sums[kept]
        self._patches = self._patches[kept]
        self._patch_counts = self._patch_counts[kept]
        self._table.rebuild(self._keys)

    def _nearest(self, keys: Keys, scaled: FloatArray) -> Rows:
        """Of the occupied cells around empty ones, those whose mean is nearest to the points."""
        around = self._table.find(keys[:, None] + _NEIGHBOUR_STEPS[_AROUND])
        some = np.flatnonzero((around != ABSENT).any(axis=1))
        around = around[some]
        sums = self._sums.take(around, axis=0)
        means = sums[..., _FIRST] / np.maximum(sums[..., _COUNT], 1.0)[..., None]
        # Within the empty cell's own frame single precision is enough.
        local = (scaled[some] - (key_cells(keys[some]) + 0.5)).astype(np.float32)
        means += _NEIGHBOURS[_AROUND].astype(np.float32) - local[:, None]
        squared = np.einsum("ijk,ijk->ij", means, means)
        squared[around == ABSENT] = np.inf
        rows = np.full(len(keys), ABSENT, dtype=np.int32)
        rows[some] = around[np.arange(len(some)), squared.argmin(axis=1)]
        return rows

    def _work_out(self, rows: Rows) -> None:
        keys = self._keys[rows]
        around = self._table.find(keys[:, None] + _NEIGHBOUR_STEPS)
        gathered = self._sums.take(around, axis=0)
        gathered[around == ABSENT] = 0.0
        total = (gathered.reshape(len(rows), -1) @ _GATHERING).astype(np.float64)
        counts = total[:, _COUNT]
        mean = total[:, _FIRST] / counts[:, None]
        covariance = total[:, _SECOND] / counts[:, None]
        for column, (i, j) in enumerate(SYMMETRIC):
            covariance[:, column] -= mean[:, i] * mean[:, j]
        values = eigenvalues(covariance)
        self._patches[rows] = PatchTable.assemble(
            points=(key_cells(keys) + 0.5 + mean) * self.cell_m,
            normals=eigenvectors(covariance, values[:, 0]),
            directions=eigenvectors(covariance, values[:, 2]),
            spreads_m=np.sqrt(np.maximum(values, 0.0)) * self.cell_m,
            elevation_spreads=_spread(counts, total[:, _ELEVATION]),
            counts=counts,
        ).values
        self._patch_counts[rows] = self._sums[rows, _COUNT]

    def _reserve(self, count: int) -> None:
        if count <= len(self._keys):
            return
        capacity = max(4096, 2 * count)
        self._keys = _extended(self._keys, capacity)
        self._sums = _extended(self._sums, capacity)
        self._patches = _extended(self._patches, capacity)
        self._patch_counts = _extended(self._patch_counts, capacity)


def _spread(counts: FloatArray, moments: FloatArray) -> FloatArray:
    """Standard deviation (N,) from counts (N,) and first and second moments (N, 2)."""
    mean = moments[:, 0] / counts
    return np.sqrt(np.maximum(moments[:, 1] / counts - mean * mean, 0.0))


def _moments(local: NDArray[np.float32], elevations: FloatArray) -> NDArray[np.float32]:
    moments = np.empty((len(local), _COLUMNS), dtype=np.float32)
    moments[:, _COUNT] = 1.0
    moments[:, _FIRST] = local
    for column, (i, j) in enumerate(SYMMETRIC, _SECOND.start):
        np.multiply(local[:, i], local[:, j], out=moments[:, column])
    moments[:, _ELEVATION.start] = elevations
    moments[:, _ELEVATION.start + 1] = elevations * elevations
    return moments


def _extended(values: NDArray[Any], capacity: int) -> NDArray[Any]:
    out = np.zeros((capacity, *values.shape[1:]), dtype=values.dtype)
    out[: len(values)] = values
    return out
