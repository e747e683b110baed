"""Fewer points with the same coverage."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

# Cells share this many slots; where two meet in one slot, one of them is dropped (a few per cent of a large scan).
_SLOTS = 1 << 20
_PRIMES = np.array([73_856_093, 19_349_669, 83_492_791], dtype=np.int32)


def one_per_cell(points: FloatArray, cell_m: float) -> NDArray[np.intp]:
    """Indices, ascending, of one point in nearly every occupied cell of a grid.

    A spatial hash that keeps the last comer, after Teschner et al., "Optimized Spatial Hashing" (VMV 2003): several
    times faster than sorting, the same for the same points.

    Args:
        points: (N, 3).
        cell_m: edge of a cell.
    """
    scaled = points.astype(np.float32)
    scaled *= np.float32(1.0 / cell_m)
    cells = np.floor(scaled, out=scaled).astype(np.int32)
    cells *= _PRIMES  # wraps around, as a hash may
    slots = cells[:, 0] + cells[:, 1] + cells[:, 2]
    slots &= _SLOTS - 1
    order = np.arange(len(points), dtype=np.int32)
    last_comer = np.empty(_SLOTS, dtype=np.int32)
    last_comer[slots] = order
    return np.flatnonzero(last_comer[slots] == order)
