"""A 2D occupancy grid of a map: obstacles above the ground, free space, and the unknown."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, convolve, distance_transform_edt, map_coordinates
from scipy.spatial import cKDTree

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray

CELL_M = 0.5
# Least |z| of the normal of a point of the ground.
_UPRIGHT = float(np.cos(np.deg2rad(35.0)))
# Largest change of the ground's height from one cell to the next: a slope, and the noise of the points.
_STEP_M = CELL_M * float(np.tan(np.deg2rad(15.0))) + 0.05
_FEWEST_GROUND_POINTS = 3
# Cells without points of the ground that it is continued over: 3 m.
_LONGEST_GAP = 6
# Below the sensor: horizontal reach of a first look at the ground, least depth, and bins of its height.
_REACH_M, _LEAST_DEPTH_M, _BIN_M = 2.5, 0.1, 0.1
# The four neighbours of a cell.
_DOWN, _RIGHT = (1, -1, 0, 0), (0, 0, 1, -1)
UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""The values of nav_msgs/OccupancyGrid."""

# Of an obstacle, in a cell and its neighbours.
_FEWEST_POINTS = 3
_VIEWPOINTS_M = 0.5
# How far free space reaches beyond cells in which the ground was seen, in cells of the ground: 1 m.
_GROUND_REACH = round(1.0 / CELL_M)
_MOST_CELLS = 200_000_000


@dataclass(frozen=True)
class GridOptions:
    """Heights of obstacles and extent of the grid; metres."""

    resolution_m: float = 0.05  # edge of a cell
    # min_height_m, max_height_m: obstacles have points between these heights above the ground
    min_height_m: float = 0.15
    max_height_m: float = 1.8
    max_range_m: float = 30.0  # largest distance of cells from the path
    robot_radius_m: float = 0.3  # distance from the path within which cells are free


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Cells of a horizontal grid in the world."""

    origin: FloatArray  # (2,) x and y of the corner of the first cell
    resolution_m: float  # edge of a cell
    cells: NDArray[np.int8]  # (rows, columns) by y and x: `UNKNOWN`, `FREE` or `OCCUPIED`


def occupancy_grid(
    points: FloatArray, normals: FloatArray, positions: FloatArray, options: GridOptions
) -> OccupancyGrid | None:
    """The grid of a map (N, 3) with normals, around the path (K, 3); None if no ground is found below the sensor.

    A cell is occupied if points lie in it at heights of obstacles above the ground. It is free if points of the ground
    lie in it, if a ray from the path reaches it with the ground seen nearby, or if the path crosses it. A ValueError is
    raised where the grid would have too many cells.
    """
    viewpoints = along_path(positions, _VIEWPOINTS_M)
    distance, _ = cKDTree(viewpoints[:, :2]).query(points[:, :2], distance_upper_bound=options.max_range_m)
    near = np.isfinite(distance)
    points, normals = points[near], normals[near]
    ground = find_ground(points, normals, positions)
    if ground is None:
        return None
    step = options.resolution_m
    everything = np.concatenate([points[:, :2], positions[:, :2]])
    origin = (np.floor(everything.min(axis=0) / step) - 1.0) * step
    columns, rows = np.floor((everything.max(axis=0) - origin) / step).astype(np.intp) + 2
    if rows * columns > _MOST_CELLS:
        raise ValueError(f"{rows * columns:,} cells, more than {_MOST_CELLS:,}")

    height = points[:, 2] - ground.at(points[:, :2])
    column, row = np.floor((points[:, :2] - origin) / step).astype(np.intp).T
    counts = np.zeros((rows, columns), dtype=np.int32)
    is_obstacle = (height > options.min_height_m) & (height < options.max_height_m)
    np.add.at(counts, (row[is_obstacle], column[is_obstacle]), 1)
    # A thinned map has one point of a table's top in a cell, and single points that are noise.
    occupied = (counts > 0) & (convolve(counts, np.ones((3, 3), dtype=np.int32), mode="constant") >= _FEWEST_POINTS)
    driven = _driven(positions, origin, occupied.shape, options)
    occupied &= ~driven

    is_ground = np.abs(height) <= options.min_height_m
    free = driven
    free[row[is_ground], column[is_ground]] = True
    visible = np.zeros_like(occupied)
    eyes = (viewpoints[:, 1::-1] - origin[::-1]) / step
    mark_visible(occupied, np.ascontiguousarray(eyes), options.max_range_m / step, visible)
    by_ground = binary_dilation(ground.observed, iterations=_GROUND_REACH)
    middles = origin + step * (np.arange(max(rows, columns))[:, None] + 0.5)
    ground_row, ground_column = ground.cells(middles)
    free |= visible & by_ground[np.ix_(ground_row[:rows], ground_column[:columns])]

    cells = np.full((rows, columns), UNKNOWN, dtype=np.int8)
    cells[free] = FREE
    cells[occupied] = OCCUPIED
    return OccupancyGrid(origin, step, cells)


def _driven(
    positions: FloatArray, origin: FloatArray, shape: tuple[int, ...], options: GridOptions
) -> NDArray[np.bool_]:
    """Cells (rows, columns) within the robot's radius of the path."""
    step, radius = options.resolution_m, options.robot_radius_m
    parts = [positions[:1, :2]]
    for start, end in zip(positions[:-1, :2], positions[1:, :2], strict=True):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / step)))
        parts.append(start + np.outer(np.arange(1, count + 1) / count, end - start))
    reach = int(np.ceil(radius / step))
    offsets = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    offsets = offsets[np.hypot(*offsets.T) * step <= radius]
    middle = np.unique(np.floor((np.concatenate(parts) - origin) / step).astype(np.intp), axis=0)
    column, row = (middle[:, None, :] + offsets).reshape(-1, 2).T
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    driven = np.zeros(shape, dtype=np.bool_)
    driven[row[inside], column[inside]] = True
    return driven


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground heights on a grid, in the world."""

    origin: FloatArray  # (2,) x and y of the corner of the first cell
    heights: FloatArray  # (rows, columns) z at the middle of cells of `CELL_M`, by y and x; NaN where unknown
    observed: NDArray[np.bool_]  # (rows, columns) whether points support it; elsewhere it is continued

    def cells(self, xy: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns (N,) of the cells of positions (N, 2); those outside are clipped."""
        indices = np.floor((xy - self.origin) / CELL_M).astype(np.intp)
        rows, columns = self.heights.shape
        return np.clip(indices[:, 1], 0, rows - 1), np.clip(indices[:, 0], 0, columns - 1)

    def at(self, xy: FloatArray) -> FloatArray:
        """Heights (N,) at positions (N, 2), bilinear; NaN where the ground is unknown."""
        known = np.isfinite(self.heights)
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        filled = self.heights[tuple(nearest)]
        column, row = ((xy - self.origin) / CELL_M - 0.5).T
        heights = map_coordinates(filled, [row, column], order=1, mode="nearest")
        return np.where(known[self.cells(xy)], heights, np.nan)


def find_ground(points: FloatArray, normals: FloatArray, positions: FloatArray) -> Ground | None:
    """The ground around the positions (K, 3) of a sensor, in the order of time; None if none is found below it.

    It begins with the most frequent height of upright surfaces below the sensor, and grows from cell to cell: points of
    the next cell belong to it if they are a slope away from it, and over gaps it is continued.
    """
    upright = points[np.abs(normals[:, 2]) > _UPRIGHT]
    everything = np.concatenate([points[:, :2], positions[:, :2]])
    origin = np.floor(everything.min(axis=0) / CELL_M) * CELL_M
    columns, rows = np.floor((everything.max(axis=0) - origin) / CELL_M).astype(np.intp) + 1
    ground = Ground(origin, np.full((rows, columns), np.nan), np.zeros((rows, columns), dtype=np.bool_))
    seeds, heights = _below(upright, positions)
    if not len(seeds):
        return None
    row, column = ground.cells(upright[:, :2])
    cell = row * columns + column
    order = np.lexsort((upright[:, 2], cell))
    starts = np.searchsorted(cell[order], np.arange(rows * columns + 1))
    row, column = ground.cells(seeds)
    grow_ground(upright[order, 2], starts, row * columns + column, heights, ground.heights, ground.observed)
    return ground


def _below(upright: FloatArray, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (M, 2) along the path, and the heights (M,) of the ground below them."""
    tree = cKDTree(upright[:, :2]) if len(upright) else None
    seeds, heights = [], []
    for position in along_path(positions, CELL_M):
        near = [] if tree is None else tree.query_ball_point(position[:2], _REACH_M)
        z = upright[near, 2]
        z = z[z < position[2] - _LEAST_DEPTH_M]
        if len(z) < _FEWEST_GROUND_POINTS:
            continue
        bins = np.floor(z / _BIN_M).astype(np.intp)
        values, counts = np.unique(bins, return_counts=True)
        seeds.append(position[:2])
        heights.append(float(np.median(z[np.abs(bins - values[np.argmax(counts)]) <= 1])))
    return np.array(seeds).reshape(-1, 2), np.array(heights)


def along_path(positions: FloatArray, spacing_m: float) -> FloatArray:
    """Those of the positions (K, 3) that are at least a distance away from the one before, with the first and last."""
    kept = [0]
    for number in range(1, len(positions)):
        if np.linalg.norm(positions[number] - positions[kept[-1]]) >= spacing_m:
            kept.append(number)
    return positions[[*kept, *([len(positions) - 1] if kept[-1] != len(positions) - 1 else [])]]


@compiled
def grow_ground(
    z: FloatArray, starts: NDArray[np.int64], seeds: NDArray[np.int64], seed_heights: FloatArray, heights: FloatArray,
    observed: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Write heights (rows, columns), NaN before, and where they were observed: the ground, grown breadth first.

    Points have heights z (N,) by cell and then ascending; those of a cell begin at its start (cells + 1,).
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
            measured_height = _height_near(z, starts[cell], starts[cell + 1], expected, _STEP_M * max(1, gap))
            if not math.isnan(measured_height):
                flat[cell], measured[cell], gaps[cell] = measured_height, True, 0
            elif gap > _LONGEST_GAP:
                continue
            else:
                flat[cell], gaps[cell] = expected, gap
            queue[tail] = cell
            tail += 1
        head += 1


@compiled_part
def _height_near(z: FloatArray, first: int, last: int, expected: float, tolerance: float) -> float:
    """Median of those of the ascending heights z[first:last] that are near the expected one; NaN of too few."""
    while first < last and z[first] < expected - tolerance:
        first += 1
    while last > first and z[last - 1] > expected + tolerance:
        last -= 1
    return z[(first + last - 1) // 2] if last - first >= _FEWEST_GROUND_POINTS else np.nan


@compiled
def mark_visible(occupied: NDArray[np.bool_], viewpoints: FloatArray, reach: float, visible: NDArray[np.bool_]) -> None:
    """Mark the cells of a grid that straight rays from viewpoints (K, 2), row and column, reach unobstructed."""
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
