"""Spatial hash from voxels to rows of arrays, vectorised over keys."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels import hash_kernels as kernels
from lidarslam.mapping.surfels.hash_kernels import ABSENT, Keys, Rows

__all__ = [
    "ABSENT", "Keys", "Rows", "VoxelHash", "beyond_reach", "cell_keys", "key_cells", "key_steps", "point_keys",
    "reach_m", "require_reach",
]  # fmt: skip

_STRIDES = np.array([kernels.STRIDE_X, kernels.STRIDE_Y, 1], dtype=np.int64)

_LARGEST_LOAD = 0.4
_FIRST_BITS = 14


def cell_keys(cells: NDArray[np.int64]) -> Keys:
    """Keys (...) of cells (..., 3)."""
    return np.asarray(cells @ _STRIDES + kernels.ORIGIN, dtype=np.int64)


def key_cells(keys: Keys) -> NDArray[np.int64]:
    """Cells (..., 3) of keys (...)."""
    mask = (1 << kernels.BITS) - 1
    shifted = [keys >> (2 * kernels.BITS), keys >> kernels.BITS, keys]
    return np.stack([part & mask for part in shifted], axis=-1) - kernels.OFFSET


def reach_m(cell_m: float) -> float:
    """The least coordinate beyond which points share the outermost cells."""
    return (kernels.OFFSET - 2) * cell_m


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
    kernels.point_keys(np.ascontiguousarray(points), cell_m, keys)
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
        """Rows (...) of keys (...), `ABSENT` where there is none."""
        rows = np.empty(keys.size, dtype=np.int32)
        kernels.find(np.ascontiguousarray(keys).reshape(-1), *self.slots, rows)
        return rows.reshape(keys.shape)

    def insert(self, keys: Keys) -> Rows:
        """Rows (N,) of keys (N,), the next ones for new keys; keys may repeat."""
        rows, done = np.empty(len(keys), dtype=np.int32), 0
        keys = np.ascontiguousarray(keys)
        while True:
            most = int(_LARGEST_LOAD * (1 << self._bits))
            done, self._count = kernels.insert(keys, done, self._count, most, *self.slots, rows)
            if done == len(keys):
                return rows
            used = np.flatnonzero(self._keys != kernels.EMPTY)
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
        self._keys = np.full(1 << bits, kernels.EMPTY, dtype=np.int64)
        self._rows = np.zeros(1 << bits, dtype=np.int32)
