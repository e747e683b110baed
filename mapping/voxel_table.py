"""A hash table from cells of a grid to rows of arrays, whole arrays of keys at a time."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

Keys = NDArray[np.int64]
Rows = NDArray[np.int32]

# Three signed cell coordinates share one 64-bit key. It is linear in them: a neighbour's key is the cell's plus a
# constant. 21 bits reach 52 km at cells of 5 cm.
_BITS = 21
_OFFSET = 1 << (_BITS - 1)
_STRIDES = np.array([1 << (2 * _BITS), 1 << _BITS, 1], dtype=np.int64)
_ORIGIN = int(_OFFSET * _STRIDES.sum())

_EMPTY = np.int64(-1)
# Fibonacci hashing: the multiplier is 2^64 over the golden ratio.
_MULTIPLIER = np.uint64(11_400_714_819_323_198_485)
_LARGEST_LOAD = 0.4
_FIRST_BITS = 14

ABSENT = -1


def cell_keys(cells: NDArray[np.int64]) -> Keys:
    """Keys (...) of cells (..., 3)."""
    return np.asarray(cells @ _STRIDES + _ORIGIN, dtype=np.int64)


def key_cells(keys: Keys) -> NDArray[np.int64]:
    """Cells (..., 3) of keys (...)."""
    mask = (1 << _BITS) - 1
    return np.stack([(keys >> (2 * _BITS)) & mask, (keys >> _BITS) & mask, keys & mask], axis=-1) - _OFFSET


def point_keys(points: FloatArray, cell_m: float) -> Keys:
    """Keys (N,) of the cells that points (N, 3) lie in."""
    return cell_keys(np.floor(points * (1.0 / cell_m)).astype(np.int64))


def key_steps(offsets: NDArray[np.int64]) -> Keys:
    """What to add to a cell's key to get that of the cell `offsets` (..., 3) away."""
    return np.asarray(offsets @ _STRIDES, dtype=np.int64)


class VoxelTable:
    """Open addressing with linear probing; rows are numbered in the order of their first insertion."""

    def __init__(self) -> None:
        self._bits = _FIRST_BITS
        self._keys = np.full(1 << self._bits, _EMPTY)
        self._rows = np.zeros(1 << self._bits, dtype=np.int32)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def find(self, keys: Keys) -> Rows:
        """Rows (...) of keys (...), `ABSENT` where there is none."""
        wanted = keys.ravel()
        slots = self._home(wanted)
        held = self._keys.take(slots)
        rows = np.where(held == wanted, self._rows.take(slots), np.int32(ABSENT))
        open_ = np.flatnonzero((held != wanted) & (held != _EMPTY))
        wanted, slots = wanted[open_], slots[open_]
        while len(open_):
            slots = (slots + 1) & (len(self._keys) - 1)
            held = self._keys.take(slots)
            hit = held == wanted
            rows[open_[hit]] = self._rows.take(slots[hit])
            going_on = np.flatnonzero(~hit & (held != _EMPTY))
            open_, wanted, slots = open_[going_on], wanted[going_on], slots[going_on]
        return rows.reshape(keys.shape)

    def insert(self, keys: Keys) -> Rows:
        """Rows (N,) of keys (N,), new ones for keys that are not there yet; keys may repeat."""
        rows = self.find(keys)
        missing = np.flatnonzero(rows == ABSENT)
        if len(missing):
            fresh = np.unique(keys[missing])
            self._reserve(self._count + len(fresh))
            self._place(fresh, np.arange(self._count, self._count + len(fresh), dtype=np.int32))
            self._count += len(fresh)
            rows[missing] = self.find(keys[missing])
        return rows

    def rebuild(self, keys: Keys) -> None:
        """Hold these unique keys (N,) instead, in rows 0 to N-1."""
        self._count = len(keys)
        self._bits = _FIRST_BITS
        while len(keys) > _LARGEST_LOAD * (1 << self._bits):
            self._bits += 1
        self._keys = np.full(1 << self._bits, _EMPTY)
        self._rows = np.zeros(1 << self._bits, dtype=np.int32)
        self._place(keys, np.arange(len(keys), dtype=np.int32))

    def _home(self, keys: Keys) -> NDArray[np.int64]:
        return ((keys.view(np.uint64) * _MULTIPLIER) >> np.uint64(64 - self._bits)).view(np.int64)

    def _reserve(self, count: int) -> None:
        if count <= _LARGEST_LOAD * len(self._keys):
            return
        used = np.flatnonzero(self._keys != _EMPTY)
        keys, rows = self._keys[used], self._rows[used]
        while count > _LARGEST_LOAD * (1 << self._bits):
            self._bits += 1
        self._keys = np.full(1 << self._bits, _EMPTY)
        self._rows = np.zeros(1 << self._bits, dtype=np.int32)
        self._place(keys, rows)

    def _place(self, keys: Keys, rows: Rows) -> None:
        """Put unique new keys into free slots: all write at once, those that were overwritten go on to the next."""
        slots = self._home(keys)
        while len(keys):
            free = self._keys.take(slots) == _EMPTY
            self._keys[slots[free]] = keys[free]
            self._rows[slots[free]] = rows[free]
            # Of several keys that wrote to one slot, both arrays keep the last: NumPy assigns in order.
            waiting = np.flatnonzero(self._keys.take(slots) != keys)
            keys, rows = keys[waiting], rows[waiting]
            slots = (slots[waiting] + 1) & (len(self._keys) - 1)
