"""Voxel downsampling by a spatial hash, after Teschner et al., "Optimized Spatial Hashing" (VMV 2003), or exactly."""

import math
import threading

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.geometry import FloatArray

# Cells share this many slots; where two meet in one slot, one of them is dropped (a few per cent of a large scan).
_SLOTS = 1 << 20
_PRIME_X, _PRIME_Y, _PRIME_Z = 73_856_093, 19_349_669, 83_492_791
# Points farther away, in cells, share one cell: the range of the integers.
_FARTHEST = float(1 << 31)
_MOST_KEYS = 2**63 - 1
# Number of elements that loops prefetch ahead.
_PREFETCHED = 32

# Slots of this thread; they are never cleared, as allocating them for every scan takes longer than all other work.
_room = threading.local()


def one_per_cell(points: FloatArray, cell_m: float) -> NDArray[np.intp]:
    """Indices, ascending, of one of the points (N, 3) in nearly every occupied cell of a grid.

    The last point of a cell is kept: several times faster than sorting, and deterministic.
    """
    kept = np.empty(len(points), dtype=np.intp)
    slots = _slots_of(np.ascontiguousarray(points), cell_m)
    return kept[: _last_comers(slots, _slot_values(), kept)]


def central_per_cell(points: FloatArray, cell_m: float) -> NDArray[np.intp]:
    """Indices, ascending, of one of the points (N, 3) in nearly every cell of a grid: the nearest to the cell's mean.

    It does not depend on the order of the points, unlike the last point. Cells that share a slot count as one.
    """
    points = np.ascontiguousarray(points)
    kept = np.empty(len(points), dtype=np.intp)
    slots = _slots_of(points, cell_m)
    sums = np.empty((len(points), 4), dtype=np.float32)
    return np.sort(kept[: _most_central(points, slots, _slot_values(), sums, kept)])


def first_per_cell(points: FloatArray, cell_m: float) -> FloatArray:
    """One of the points (N, 3) for every occupied cell, (M, 3), in the order of the cells.

    It is the cell's first point, not the mean that Open3D gives, which would smooth the noise to be measured. Cells
    are counted from the cloud's lowest corner.
    """
    if not len(points):
        return points
    cells = np.floor((points - points.min(axis=0)) / cell_m)
    sizes = [int(size) + 1 for size in cells.max(axis=0)]
    columns = list(cells.astype(np.int64).T) if max(sizes) < _MOST_KEYS else list(cells.T)
    if math.prod(sizes) > _MOST_KEYS:  # a stray point far away: number the occupied rows of cells only
        columns = [np.unique(column, return_inverse=True)[1] for column in columns]
        sizes = [int(column.max()) + 1 for column in columns]
    keys = (columns[0] * sizes[1] + columns[1]) * sizes[2] + columns[2]
    _, first = np.unique(keys, return_index=True)
    return points[first]


def evenly(indices: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """At most so many of the indices, evenly spread."""
    count = len(indices)
    return indices if count <= most else indices[np.linspace(0, count - 1, most).astype(np.intp)]


def _slots_of(points: FloatArray, cell_m: float) -> NDArray[np.int32]:
    slots = np.empty(len(points), dtype=np.int32)
    _write_slots(points, np.float32(1.0 / cell_m), slots)
    return slots


def _slot_values() -> NDArray[np.int32]:
    """This thread's slots, with arbitrary content."""
    if not hasattr(_room, "values"):
        _room.values = np.empty(_SLOTS, dtype=np.int32)
    values: NDArray[np.int32] = _room.values
    return values


@compiled_part
def _cell(scaled: np.float32) -> int:
    cell = np.floor(scaled)
    # Written so that NaN goes to zero.
    return int(cell) if cell > -_FARTHEST and cell < _FARTHEST else 0


@compiled
def _write_slots(points: FloatArray, per_metre: np.float32, slots: NDArray[np.int32]) -> None:
    """Write the slot (N,) of the cell that each of the points (N, 3) lies in."""
    for n in range(len(points)):
        x, y, z = np.float32(points[n, 0]), np.float32(points[n, 1]), np.float32(points[n, 2])
        mixed = _cell(x * per_metre) * _PRIME_X + _cell(y * per_metre) * _PRIME_Y + _cell(z * per_metre) * _PRIME_Z
        slots[n] = mixed & (_SLOTS - 1)


@compiled
def _last_comers(slots: NDArray[np.int32], last_comer: NDArray[np.int32], kept: NDArray[np.intp]) -> int:
    """Write which points are the last in their slots (N,), ascending; return their number."""
    for n in range(len(slots)):
        last_comer[slots[n]] = n
    count = 0
    for n in range(len(slots)):
        # Without a branch, which no processor would predict.
        kept[count] = n
        count += last_comer[slots[n]] == n
    return count


@compiled
def _most_central(
    points: FloatArray, slots: NDArray[np.int32], cells: NDArray[np.int32], sums: NDArray[np.float32],
    nearest: NDArray[np.intp],
) -> int:  # fmt: skip
    """Write which points (N, 3) are the nearest to the means of those in their slots (N,); return their number.

    Args:
        points, slots: which.
        cells: of all slots, written: the number of the cell in it.
        sums: (N, 4) room for sums of coordinates and the number of points, by cell.
        nearest: (N,) written, by cell.
    """
    count = 0
    for n in range(len(slots)):
        prefetch(cells, slots[min(n + _PREFETCHED, len(slots) - 1)])
        cell = cells[slots[n]]
        # A number that was left here by an earlier scan points to a cell of another slot, or to none.
        if cell < 0 or cell >= count or slots[nearest[cell]] != slots[n]:
            cell = count
            cells[slots[n]] = cell
            nearest[cell] = n
            sums[cell, :] = np.float32(0.0)
            count += 1
        for axis in range(3):
            sums[cell, axis] += np.float32(points[n, axis])
        sums[cell, 3] += np.float32(1.0)
    for cell in range(count):
        for axis in range(3):
            sums[cell, axis] /= sums[cell, 3]
        sums[cell, 3] = np.inf  # the least square of a distance so far
    for n in range(len(slots)):
        cell = cells[slots[n]]
        squared = np.float32(0.0)
        for axis in range(3):
            squared += (np.float32(points[n, axis]) - sums[cell, axis]) ** 2
        if squared < sums[cell, 3]:
            sums[cell, 3] = squared
            nearest[cell] = n
    return count
