"""Compiled loops over the cells of grids."""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray

# The four neighbours of a cell.
_DOWN, _RIGHT = (1, -1, 0, 0), (0, 0, 1, -1)


@compiled
def grow_ground(
    z: FloatArray,
    starts: NDArray[np.int64],
    seeds: NDArray[np.int64],
    seed_heights: FloatArray,
    step_m: float,
    fewest: int,
    longest_gap: int,
    heights: FloatArray,
    observed: NDArray[np.bool_],
) -> None:
    """Grow the ground from seeds, breadth first.

    Args:
        z: (N,) heights of upright points, by cell and then ascending.
        starts: (cells + 1,) the points of each cell.
        seeds: (M,) cells.
        seed_heights: (M,) the ground in them.
        step_m: largest change of the ground from one cell to the next.
        fewest: points that a height is measured from.
        longest_gap: cells without points that the ground is continued over.
        heights: (rows, columns) NaN; the ground.
        observed: (rows, columns) False; where it was measured.
    """
    rows, columns = heights.shape
    queue = np.empty(rows * columns, dtype=np.int64)
    gaps = np.zeros(rows * columns, dtype=np.int64)
    flat, measured = heights.ravel(), observed.ravel()
    head, tail = -len(seeds), 0  # first every seed, then the neighbours of each cell in the queue
    while head < tail:
        for side in range(1 if head < 0 else 4):
            if head < 0:
                cell, expected, gap = seeds[head], seed_heights[head], 0
            else:
                parent = queue[head]
                row, column = parent // columns + _DOWN[side], parent % columns + _RIGHT[side]
                if row < 0 or row >= rows or column < 0 or column >= columns:
                    continue
                cell, expected, gap = row * columns + column, flat[parent], gaps[parent] + 1
            if not math.isnan(flat[cell]):
                continue
            measured_height = _height_near(z, starts[cell], starts[cell + 1], expected, step_m * max(1, gap), fewest)
            if not math.isnan(measured_height):
                flat[cell], measured[cell], gaps[cell] = measured_height, True, 0
            elif gap > longest_gap:
                continue
            else:
                flat[cell], gaps[cell] = expected, gap
            queue[tail] = cell
            tail += 1
        head += 1


@compiled_part
def _height_near(z: FloatArray, first: int, last: int, expected: float, tolerance: float, fewest: int) -> float:
    """Median of those of the ascending heights z[first:last] that are near the expected one; NaN of too few."""
    while first < last and z[first] < expected - tolerance:
        first += 1
    while last > first and z[last - 1] > expected + tolerance:
        last -= 1
    return z[(first + last - 1) // 2] if last - first >= fewest else np.nan


@compiled
def mark_visible(occupied: NDArray[np.bool_], viewpoints: FloatArray, reach: float, visible: NDArray[np.bool_]) -> None:
    """Mark the cells of a grid that straight rays from viewpoints reach before an occupied cell.

    Args:
        occupied: (rows, columns).
        viewpoints: (K, 2) row and column, in cells.
        reach: length of a ray, in cells.
        visible: (rows, columns), False; True where a ray passes.
    """
    rows, columns = occupied.shape
    rays = max(8, math.ceil(2.0 * math.pi * reach))
    for k in range(len(viewpoints)):
        for ray in range(rays):
            angle = 2.0 * math.pi * ray / rays
            down, right = math.sin(angle), math.cos(angle)
            for step in range(int(reach) + 1):
                row = math.floor(viewpoints[k, 0] + step * down)
                column = math.floor(viewpoints[k, 1] + step * right)
                if row < 0 or row >= rows or column < 0 or column >= columns or occupied[row, column]:
                    break
                visible[row, column] = True
