"""Fewer points with the same coverage."""

import threading

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray

# Cells share this many slots; where two meet in one slot, one of them is dropped (a few per cent of a large scan).
_SLOTS = 1 << 20
_PRIME_X, _PRIME_Y, _PRIME_Z = 73_856_093, 19_349_669, 83_492_791
# Farther away, in cells, all is one cell: integers go no farther.
_FARTHEST = float(1 << 31)

_room = (
    threading.local()
)  # the slots, which need not be cleared: to have them anew for every scan takes longer than all


def one_per_cell(points: FloatArray, cell_m: float) -> NDArray[np.intp]:
    """Indices, ascending, of one point in nearly every occupied cell of a grid.

    A spatial hash that keeps the last comer, after Teschner et al., "Optimized Spatial Hashing" (VMV 2003): several
    times faster than sorting, the same for the same points.

    Args:
        points: (N, 3).
        cell_m: edge of a cell.
    """
    if not hasattr(_room, "last_comer"):
        _room.last_comer = np.empty(_SLOTS, dtype=np.int32)
    kept = np.empty(len(points), dtype=np.intp)
    slots = np.empty(len(points), dtype=np.int32)
    _write_slots(np.ascontiguousarray(points), np.float32(1.0 / cell_m), slots)
    return kept[: _last_comers(slots, _room.last_comer, kept)]


@compiled
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
    """Write which points are the last in their slots (N,), ascending; return how many."""
    for n in range(len(slots)):
        last_comer[slots[n]] = n
    count = 0
    for n in range(len(slots)):
        if last_comer[slots[n]] == n:
            kept[count] = n
            count += 1
    return count


def nearest_per_cell(points: FloatArray, cell_m: float, to_mean: bool) -> NDArray[np.intp]:
    if not hasattr(_room, "best"):
        _room.best = np.empty(_SLOTS, dtype=np.int32)
        _room.sums = np.zeros((_SLOTS, 4), dtype=np.float32)
    kept = np.empty(len(points), dtype=np.intp)
    slots = np.empty(len(points), dtype=np.int32)
    _write_slots(np.ascontiguousarray(points), np.float32(1.0 / cell_m), slots)
    return kept[: _nearest(np.ascontiguousarray(points), np.float32(1.0 / cell_m), slots, _room.best, _room.sums, to_mean, kept)]


@compiled
def _nearest(points: FloatArray, per_metre: np.float32, slots: NDArray[np.int32], best: NDArray[np.int32], sums: NDArray[np.float32], to_mean: bool, kept: NDArray[np.intp]) -> int:
    for n in range(len(slots)):
        s = slots[n]
        best[s] = -1
        for a in range(4):
            sums[s, a] = 0.0
    if to_mean:
        for n in range(len(slots)):
            s = slots[n]
            sums[s, 0] += np.float32(points[n, 0])
            sums[s, 1] += np.float32(points[n, 1])
            sums[s, 2] += np.float32(points[n, 2])
            sums[s, 3] += np.float32(1.0)
        for n in range(len(slots)):
            s = slots[n]
            if best[s] == -1:
                best[s] = -2
                for a in range(3):
                    sums[s, a] /= sums[s, 3]
                sums[s, 3] = np.inf
    else:
        for n in range(len(slots)):
            s = slots[n]
            if best[s] == -1:
                best[s] = -2
                for a in range(3):
                    sums[s, a] = (np.floor(np.float32(points[n, a]) * per_metre) + np.float32(0.5)) / per_metre
                sums[s, 3] = np.inf
    for n in range(len(slots)):
        s = slots[n]
        x = np.float32(points[n, 0]) - sums[s, 0]
        y = np.float32(points[n, 1]) - sums[s, 1]
        z = np.float32(points[n, 2]) - sums[s, 2]
        d = x * x + y * y + z * z
        if d < sums[s, 3]:
            sums[s, 3] = d
            best[s] = n
    count = 0
    for n in range(len(slots)):
        if best[slots[n]] == n:
            kept[count] = n
            count += 1
    return count
