"""Spatial hash from voxels to rows of arrays, and its compiled loops.

Open addressing with linear probing: `table_keys` (2^bits,) int64, -1 where free, and `table_rows` (2^bits,) int32."""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray

Keys = NDArray[np.int64]
Rows = NDArray[np.int32]

ABSENT = -1
EMPTY = -1
# A key holds three signed cell coordinates in 63 bits and is linear in them, so that a neighbour's key is the cell's
# plus a constant. 21 bits reach 52 km at cells of 5 cm; farther points are clipped. The sign bit marks a cell's other
# side, with the points of a thin wall that were seen from behind.
BITS = 21
OFFSET = 1 << (BITS - 1)
STRIDE_X, STRIDE_Y = 1 << (2 * BITS), 1 << BITS
ORIGIN = OFFSET * (STRIDE_X + STRIDE_Y + 1)
# Fibonacci hashing: the multiplier is 2^64 over the golden ratio.
_MULTIPLIER = np.uint64(11_400_714_819_323_198_485)
_ABOVE_BITS = 3
OTHER_SIDE, FIRST_SIDE = np.int64(-(1 << 63)), np.int64((1 << 63) - 1)
# Number of elements ahead that loops prefetch.
PREFETCHED = 16
_STRIDES = np.array([STRIDE_X, STRIDE_Y, 1], dtype=np.int64)
_LARGEST_LOAD = 0.4
_FIRST_BITS = 14


@compiled_part
def cell_of(coordinate: float) -> int:
    """Cell along one axis; never the last one, so that no key is `EMPTY`."""
    return int(min(max(math.floor(coordinate), -OFFSET), OFFSET - 2))


@compiled_part
def key_of(i: int, j: int, k: int) -> int:
    return i * STRIDE_X + j * STRIDE_Y + k + ORIGIN


@compiled_part
def neighbour_key(key: int, i: int, j: int, k: int) -> int:
    """Key of the cell at an offset of (i, j, k) cells from a cell or from its other side."""
    return int((key & FIRST_SIDE) + i * STRIDE_X + j * STRIDE_Y + k)


@compiled_part
def _home(key: int, bits: int) -> int:
    """First slot of a key; cells above one another share a cache line."""
    column = np.uint64(key >> _ABOVE_BITS) * _MULTIPLIER
    return int(column >> np.uint64(64 - bits)) ^ (key & ((1 << _ABOVE_BITS) - 1))


@compiled_part
def find_one(key: int, bits: int, table_keys: Keys, table_rows: Rows) -> int:
    slot = _home(key, bits)
    while table_keys[slot] != EMPTY:
        if table_keys[slot] == key:
            return int(table_rows[slot])
        slot = (slot + 1) & ((1 << bits) - 1)
    return ABSENT


@compiled_part
def prefetch_slot(key: int, bits: int, table_keys: Keys, table_rows: Rows) -> None:
    """Prefetch the first slot of a key."""
    slot = _home(key, bits)
    prefetch(table_keys, slot)
    prefetch(table_rows, slot)


@compiled_part
def prefetch_around(key: int, bits: int, table_keys: Keys, table_rows: Rows) -> None:
    """Prefetch the slots of a cell and its 26 neighbours; those of cells above one another mostly share a line."""
    for i in range(-1, 2):
        for j in range(-1, 2):
            prefetch_slot(neighbour_key(key, i, j, 0), bits, table_keys, table_rows)


@compiled
def find_rows(keys: Keys, bits: int, table_keys: Keys, table_rows: Rows, rows: Rows) -> None:
    """Write the rows (N,) of keys (N,), `ABSENT` where there is none."""
    for n in range(len(keys)):
        rows[n] = find_one(keys[n], bits, table_keys, table_rows)


@compiled
def insert_keys(
    keys: Keys, begin: int, count: int, most: int, bits: int, table_keys: Keys, table_rows: Rows, rows: Rows
) -> tuple[int, int]:
    """Write the rows of keys (N,) from `begin` on, the next ones for new keys, until the hash holds `most`.

    The numbers of keys done and of rows are returned.
    """
    for n in range(begin, len(keys)):
        prefetch_slot(keys[min(n + PREFETCHED, len(keys) - 1)], bits, table_keys, table_rows)
        slot = _home(keys[n], bits)
        while table_keys[slot] != EMPTY and table_keys[slot] != keys[n]:
            slot = (slot + 1) & ((1 << bits) - 1)
        if table_keys[slot] == EMPTY:
            if count >= most:
                return n, count
            table_keys[slot] = keys[n]
            table_rows[slot] = count
            count += 1
        rows[n] = table_rows[slot]
    return len(keys), count


@compiled_part
def key_at(point: FloatArray, scale: float) -> int:
    """Key of the cell of a point (3,), with `scale` cells per metre."""
    return key_of(cell_of(point[0] * scale), cell_of(point[1] * scale), cell_of(point[2] * scale))


@compiled
def write_point_keys(points: FloatArray, cell_m: float, keys: Keys) -> None:
    """Write the keys (N,) of the cells that points (N, 3) lie in."""
    scale = 1.0 / cell_m
    for n in range(len(points)):
        keys[n] = key_at(points[n], scale)


@compiled_part
def middle_of(key: int) -> tuple[float, float, float]:
    """Centre of a cell, in units of cells."""
    mask = (1 << BITS) - 1
    i, j, k = (key >> (2 * BITS)) & mask, (key >> BITS) & mask, key & mask
    return i - OFFSET + 0.5, j - OFFSET + 0.5, k - OFFSET + 0.5


def cell_keys(cells: NDArray[np.int64]) -> Keys:
    """Keys (...) of cells (..., 3)."""
    return np.asarray(cells @ _STRIDES + ORIGIN, dtype=np.int64)


def key_cells(keys: Keys) -> NDArray[np.int64]:
    """Cells (..., 3) of keys (...)."""
    mask = (1 << BITS) - 1
    shifted = [keys >> (2 * BITS), keys >> BITS, keys]
    return np.stack([part & mask for part in shifted], axis=-1) - OFFSET


def reach_m(cell_m: float) -> float:
    """The least coordinate beyond which points share the outermost cells."""
    return (OFFSET - 2) * cell_m


def beyond_reach(position: FloatArray, range_m: float, cell_m: float) -> str | None:
    """The reason why not all points within a range of a position (3,) have a cell; None where they have."""
    if float(np.abs(position).max()) + range_m < reach_m(cell_m):
        return None
    return f"beyond the reach of a map with cells of {cell_m:g} m, {reach_m(cell_m) / 1000.0:.0f} km"


def require_reach(points: FloatArray, cell_m: float) -> None:
    """InputError for points (N, 3) beyond the reach of cells."""
    farthest_m = float(np.abs(points).max(initial=0.0))
    if not farthest_m < reach_m(cell_m):
        raise InputError(
            f"the map's points lie up to {farthest_m / 1000.0:,.0f} km from its origin, and cells of {cell_m:g} m reach"
            f" {reach_m(cell_m) / 1000.0:,.0f} km: shift the map towards its origin"
        )


def point_keys(points: FloatArray, cell_m: float) -> Keys:
    """Keys (N,) of the cells that points (N, 3) lie in; beyond their reach, of the outermost ones."""
    keys = np.empty(len(points), dtype=np.int64)
    write_point_keys(np.ascontiguousarray(points), cell_m, keys)
    return keys


def key_steps(offsets: NDArray[np.int64]) -> Keys:
    """Differences (...) between the key of a cell and those of the cells at offsets (..., 3)."""
    return np.asarray(offsets @ _STRIDES, dtype=np.int64)


class VoxelHash:
    """Open addressing with linear probing; rows are numbered in the order of their first insertion."""

    _bits: int
    _count: int
    _keys: Keys
    _rows: Rows

    def __init__(self) -> None:
        self._clear(_FIRST_BITS)

    def __len__(self) -> int:
        return self._count

    @property
    def slots(self) -> tuple[int, Keys, Rows]:
        """Binary logarithm of the number of slots, and the keys and rows in the slots."""
        return self._bits, self._keys, self._rows

    def find(self, keys: Keys) -> Rows:
        """Rows (N,) of keys (N,), `ABSENT` where there is none."""
        rows = np.empty(len(keys), dtype=np.int32)
        find_rows(np.ascontiguousarray(keys), *self.slots, rows)
        return rows

    def insert(self, keys: Keys) -> Rows:
        """Rows (N,) of keys (N,), the next ones for new keys; keys may repeat."""
        rows, done = np.empty(len(keys), dtype=np.int32), 0
        keys = np.ascontiguousarray(keys)
        while True:
            most = int(_LARGEST_LOAD * (1 << self._bits))
            done, self._count = insert_keys(keys, done, self._count, most, *self.slots, rows)
            if done == len(keys):
                return rows
            used = np.flatnonzero(self._keys != EMPTY)
            by_row = np.empty(len(used), dtype=np.int64)
            by_row[self._rows[used]] = self._keys[used]
            self._clear(self._bits + 1)
            self.insert(by_row)

    def rebuild(self, keys: Keys) -> None:
        """Replace the contents by unique keys (N,) in rows 0 to N-1."""
        bits = _FIRST_BITS
        while len(keys) > _LARGEST_LOAD * (1 << bits):
            bits += 1
        self._clear(bits)
        self.insert(keys)

    def _clear(self, bits: int) -> None:
        self._bits, self._count = bits, 0
        self._keys = np.full(1 << bits, EMPTY, dtype=np.int64)
        self._rows = np.zeros(1 << bits, dtype=np.int32)
