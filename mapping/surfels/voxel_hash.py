"""Spatial hash from voxels to rows of arrays, and its compiled loops.

Blocks of two cells along each axis are hashed: a cell and its 26 neighbours lie in eight. Open addressing with linear
probing: `table_keys` (2^bits,) int64 of the blocks, -1 where free, and `table_rows` (2^bits, 8) int32 of their cells,
-1 where there is none.
"""

import math
from typing import Any

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
# The lowest bit of each coordinate is the place in a block.
_PLACE = STRIDE_X | STRIDE_Y | 1
# Fibonacci hashing: the multiplier is 2^64 over the golden ratio.
_MULTIPLIER = np.uint64(11_400_714_819_323_198_485)
OTHER_SIDE, FIRST_SIDE = np.int64(-(1 << 63)), np.int64((1 << 63) - 1)
# Number of elements ahead that loops prefetch.
PREFETCHED = 16
_STRIDES = np.array([STRIDE_X, STRIDE_Y, 1], dtype=np.int64)
_LARGEST_LOAD = 0.4
_FIRST_BITS = 12
_CELLS = 8  # of a block
# Bytes that the processor fetches at a time.
_CACHE_LINE = 64


@compiled_part
def cell_of(coordinate: float) -> int:
    """Cell along one axis; never the last one, so that no key is `EMPTY`."""
    return int(min(max(math.floor(coordinate), -OFFSET), OFFSET - 2))


@compiled_part
def key_of(i: int, j: int, k: int) -> int:
    return i * STRIDE_X + j * STRIDE_Y + k + ORIGIN


@compiled_part
def _place_of(key: int) -> int:
    """Place of a cell in its block."""
    return int((key >> (2 * BITS)) & 1) << 2 | int((key >> BITS) & 1) << 1 | int(key & 1)


@compiled_part
def _home(block: int, bits: int) -> int:
    """First slot of a block."""
    return int(np.int64((np.uint64(block) * _MULTIPLIER) >> np.uint64(64 - bits)))


@compiled_part
def _find_block(block: int, bits: int, table_keys: Keys) -> int:
    """Slot of a block, else the free one that it would have."""
    slot = _home(block, bits)
    while table_keys[slot] != block and table_keys[slot] != EMPTY:
        slot = (slot + 1) & ((1 << bits) - 1)
    return slot


@compiled_part
def find_one(key: int, bits: int, table_keys: Keys, table_rows: Rows) -> int:
    """Row of a key, or `ABSENT`."""
    return int(table_rows[_find_block(key & ~_PLACE, bits, table_keys), _place_of(key)])


@compiled_part
def find_around(key: int, bits: int, table_keys: Keys, table_rows: Rows, around: Rows) -> None:
    """Write the rows (27,) of a cell, of whatever side, and its neighbours, by x, y and z; or `ABSENT`."""
    low = int(key & FIRST_SIDE) - STRIDE_X - STRIDE_Y - 1
    block, place = low & ~_PLACE, _place_of(low)
    x, y, z = place >> 2, (place >> 1) & 1, place & 1
    for i in range(2):
        for j in range(2):
            for k in range(2):
                slot = _find_block(block + 2 * (i * STRIDE_X + j * STRIDE_Y + k), bits, table_keys)
                rows = table_rows[slot]
                # Of three cells in a row from the lower corner on, one or two are in the first block.
                for a in range(max(0, 2 * i - x), min(3, 2 * i - x + 2)):
                    for b in range(max(0, 2 * j - y), min(3, 2 * j - y + 2)):
                        for c in range(max(0, 2 * k - z), min(3, 2 * k - z + 2)):
                            at = ((x + a) & 1) << 2 | ((y + b) & 1) << 1 | ((z + c) & 1)
                            around[9 * a + 3 * b + c] = rows[at]


@compiled_part
def prefetch_slot(key: int, bits: int, table_keys: Keys, table_rows: Rows) -> None:
    """Prefetch the first slot of a key's block."""
    slot = _home(key & ~_PLACE, bits)
    prefetch(table_keys, slot)
    prefetch(table_rows, slot)


@compiled_part
def prefetch_around(key: int, bits: int, table_keys: Keys, table_rows: Rows) -> None:
    """Prefetch the slots of the blocks of a cell and its 26 neighbours."""
    low = int(key & FIRST_SIDE) - STRIDE_X - STRIDE_Y - 1
    for i in range(2):
        for j in range(2):
            for k in range(2):
                prefetch_slot(low + 2 * (i * STRIDE_X + j * STRIDE_Y + k), bits, table_keys, table_rows)


@compiled
def find_rows(keys: Keys, bits: int, table_keys: Keys, table_rows: Rows, rows: Rows) -> None:
    """Write the rows (N,) of keys (N,), `ABSENT` where there is none."""
    for n in range(len(keys)):
        rows[n] = find_one(keys[n], bits, table_keys, table_rows)


@compiled
def insert_keys(
    keys: Keys, begin: int, count: int, blocks: int, most: int, bits: int, table_keys: Keys, table_rows: Rows,
    rows: Rows,
) -> tuple[int, int, int]:  # fmt: skip
    """Write the rows of keys (N,) from `begin` on, the next ones for new keys, until the hash holds `most` blocks.

    The numbers of keys done, of rows and of blocks are returned.
    """
    for n in range(begin, len(keys)):
        prefetch_slot(keys[min(n + PREFETCHED, len(keys) - 1)], bits, table_keys, table_rows)
        block, place = keys[n] & ~_PLACE, _place_of(keys[n])
        slot = _find_block(block, bits, table_keys)
        if table_keys[slot] == EMPTY:
            if blocks >= most:
                return n, count, blocks
            table_keys[slot] = block
            blocks += 1
        if table_rows[slot, place] == ABSENT:
            table_rows[slot, place] = count
            count += 1
        rows[n] = table_rows[slot, place]
    return len(keys), count, blocks


@compiled
def write_new_keys(keys: Keys, rows: Rows, known: int, by_row: Keys) -> None:
    """Write those of the keys (N,) in rows (N,) that are not among the first `known` to an array by row."""
    for n in range(len(keys)):
        if rows[n] >= known:
            by_row[rows[n]] = keys[n]


@compiled
def move_blocks(from_keys: Keys, from_rows: Rows, bits: int, table_keys: Keys, table_rows: Rows) -> None:
    """Copy the blocks of another hash to an empty one."""
    for n in range(len(from_keys)):
        if from_keys[n] != EMPTY:
            slot = _find_block(from_keys[n], bits, table_keys)
            table_keys[slot] = from_keys[n]
            for place in range(_CELLS):
                table_rows[slot, place] = from_rows[n, place]


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


def resized(values: NDArray[Any], capacity: int) -> NDArray[Any]:
    """A copy with more rows, or fewer; it begins with a cache line, so that few rows lie across two."""
    shape = (capacity, *values.shape[1:])
    size = math.prod(shape) * values.itemsize
    room = np.zeros(size + _CACHE_LINE, dtype=np.uint8)
    begin = -room.ctypes.data % _CACHE_LINE
    out: NDArray[Any] = room[begin : begin + size].view(values.dtype).reshape(shape)
    out[: len(values)] = values[:capacity]
    return out


class VoxelHash:
    """Rows are numbered in the order of their first insertion."""

    _bits: int
    _count: int  # of rows
    _blocks: int
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
            done, self._count, self._blocks = insert_keys(
                keys, done, self._count, self._blocks, most, *self.slots, rows
            )
            if done == len(keys):
                return rows
            count, blocks, from_keys, from_rows = self._count, self._blocks, self._keys, self._rows
            self._clear(self._bits + 1)
            move_blocks(from_keys, from_rows, *self.slots)
            self._count, self._blocks = count, blocks

    def rebuild(self, keys: Keys) -> None:
        """Replace the contents by unique keys (N,) in rows 0 to N-1."""
        self._clear(_FIRST_BITS)
        self.insert(keys)

    def _clear(self, bits: int) -> None:
        self._bits, self._count, self._blocks = bits, 0, 0
        self._keys = np.full(1 << bits, EMPTY, dtype=np.int64)
        self._rows = resized(np.empty((0, _CELLS), dtype=np.int32), 1 << bits)
        self._rows.fill(ABSENT)
