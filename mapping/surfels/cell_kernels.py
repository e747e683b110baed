"""Moments of cells: the compiled loops of `SurfelGrid`.

A cell's sums are (15,) float32: number of points, first and second moments about the cell's centre in units of the cell
(x, y, z, xx, xy, xz, yy, yz, zz), first and second moment of the elevation, and the sum of the view directions (x, y,
z). They fill a cache line with a sixteenth number, see `other_side`. Keys, and the table of keys and rows, are those of
`mapping.surfels.hash_kernels`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels.hash_kernels import (
    ABSENT,
    FIRST_SIDE,
    PREFETCHED,
    Keys,
    Rows,
    cell_of,
    find_one,
    key_at,
    key_of,
    middle_of,
    prefetch_around,
    prefetch_slot,
)

Floats = NDArray[np.float32]

# Column of the link to a cell's other side: its row plus one, exact to 16 million cells; zero where there is none.
OTHER = 15
# A cell with this many points is frozen, so that drift does not smear it.
_MOST_POINTS = 60.0


class Cells(NamedTuple):
    """The arrays of a grid of M cells."""

    cell_m: float  # edge of a cell
    bits: int  # binary logarithm of the number of slots
    # table_keys, table_rows: of the hash
    table_keys: Keys
    table_rows: Rows
    keys: Keys  # (M,) of the cells, by row
    sums: Floats  # (M, 16) moments, and the link to the other side


@compiled_part
def other_side(row: int, sums: Floats) -> int:
    """Row of the other side of the cell in a row, `ABSENT` where there is none."""
    return int(sums[row, OTHER]) - 1


@compiled
def link_sides(keys: Keys, rows: Rows, bits: int, table_keys: Keys, table_rows: Rows, sums: Floats) -> None:
    """Write the links between both sides of cells into sums (M, 16), for the keys (N,) in rows (N,) of other sides."""
    for n in range(len(keys)):
        if keys[n] < 0 and other_side(rows[n], sums) == ABSENT:
            first = find_one(keys[n] & FIRST_SIDE, bits, table_keys, table_rows)
            sums[rows[n], OTHER] = first + 1
            if first != ABSENT:
                sums[first, OTHER] = rows[n] + 1


@compiled
def write_views(points: FloatArray, sensor: FloatArray, views: Floats) -> None:
    """Write the unit directions (N, 3) from points (N, 3) to the sensor (3,)."""
    for n in range(len(points)):
        x, y, z = sensor[0] - points[n, 0], sensor[1] - points[n, 1], sensor[2] - points[n, 2]
        scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-9)
        views[n, 0], views[n, 1], views[n, 2] = x * scale, y * scale, z * scale


@compiled
def add_moments(
    points: FloatArray, elevations: FloatArray, views: Floats, keys: Keys, rows: Rows, cell_m: float,
    grid_keys: Keys, sums: Floats, weight: float,
) -> None:  # fmt: skip
    """Add points (N, 3) with elevations (N,) and views (N, 3) to the sums of their cells, unless these are frozen.

    Each point counts `weight` times.
    """
    scale, w = 1.0 / cell_m, np.float32(weight)
    is_growing = np.empty(len(rows), dtype=np.bool_)
    for n in range(len(rows)):
        ahead = rows[min(n + PREFETCHED, len(rows) - 1)]
        prefetch(sums, ahead)
        prefetch(grid_keys, ahead)
        is_growing[n] = sums[rows[n], 0] < _MOST_POINTS
        grid_keys[rows[n]] = keys[n]
    for n in range(len(rows)):
        if not is_growing[n]:
            continue
        sx, sy, sz = points[n, 0] * scale, points[n, 1] * scale, points[n, 2] * scale
        # Within the cell's own frame single precision is enough.
        x = np.float32(sx - cell_of(sx) - 0.5)
        y = np.float32(sy - cell_of(sy) - 0.5)
        z = np.float32(sz - cell_of(sz) - 0.5)
        elevation = np.float32(elevations[n])
        cell = sums[rows[n]]
        cell[0] += w
        cell[1] += w * x
        cell[2] += w * y
        cell[3] += w * z
        cell[4] += w * x * x
        cell[5] += w * x * y
        cell[6] += w * x * z
        cell[7] += w * y * y
        cell[8] += w * y * z
        cell[9] += w * z * z
        cell[10] += w * elevation
        cell[11] += w * elevation * elevation
        cell[12] += w * views[n, 0]
        cell[13] += w * views[n, 1]
        cell[14] += w * views[n, 2]


@compiled
def within(keys: Keys, cell_m: float, centre: FloatArray, radius_m: float, rows: NDArray[np.intp]) -> int:
    """Write which cells (M,) have their centres within a radius of a point (3,), ascending; return their number."""
    count = 0
    for n in range(len(keys)):
        x, y, z = middle_of(keys[n])
        x, y, z = x * cell_m - centre[0], y * cell_m - centre[1], z * cell_m - centre[2]
        rows[count] = n
        count += x * x + y * y + z * z <= radius_m * radius_m
    return count


@compiled
def look_up(points: FloatArray, cells: Cells, rows: Rows) -> None:
    """Write the rows (N,) of the cells of points (N, 3), else of the nearest around; or `ABSENT`."""
    scale, last = 1.0 / cells.cell_m, len(points) - 1
    for n in range(len(points)):
        ahead = key_at(points[min(n + PREFETCHED, last)], scale)
        prefetch_slot(ahead, cells.bits, cells.table_keys, cells.table_rows)
        x, y, z = points[n, 0] * scale, points[n, 1] * scale, points[n, 2] * scale
        i, j, k = cell_of(x), cell_of(y), cell_of(z)
        row = find_one(key_of(i, j, k), cells.bits, cells.table_keys, cells.table_rows)
        rows[n] = row if row != ABSENT else _nearest(i, j, k, x, y, z, cells)


@compiled_part
def _nearest(i: int, j: int, k: int, x: float, y: float, z: float, cells: Cells) -> int:
    """Row of the occupied cell around an empty one whose mean is nearest to a point, all in units of cells."""
    nearest, least = ABSENT, np.inf
    prefetch_around(key_of(i, j, k), cells.bits, cells.table_keys, cells.table_rows)
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            for c in range(k - 1, k + 2):
                row = find_one(key_of(a, b, c), cells.bits, cells.table_keys, cells.table_rows)
                if row == ABSENT:
                    continue
                count = cells.sums[row, 0]
                dx = cells.sums[row, 1] / count + (a + 0.5 - x)
                dy = cells.sums[row, 2] / count + (b + 0.5 - y)
                dz = cells.sums[row, 3] / count + (c + 0.5 - z)
                squared = dx * dx + dy * dy + dz * dz
                if squared < least:
                    nearest, least = row, squared
    return nearest
