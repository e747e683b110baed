"""A 2D occupancy grid of a map: obstacles above the ground, free space, and the unknown."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, convolve
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.global_map.products.grid_kernels import mark_visible
from lidarslam.mapping.global_map.products.ground import CELL_M, along_path, find_ground

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
    """What is an obstacle, and how far the grid reaches; metres."""

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
    """The grid of a map around a path; None if no ground is found below the sensor.

    A cell is occupied if points lie in it at heights of obstacles above the ground. It is free if points of the ground
    lie in it, if a ray from the path reaches it with the ground seen nearby, or if the path crosses it.

    Args:
        points: (N, 3) of the map, in the world with z up.
        normals: (N, 3) of its surfaces.
        positions: (K, 3) of the sensor.
        options: heights, resolution and range.

    Raises:
        ValueError: the grid would have too many cells.
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
    y = origin[1] + step * (np.arange(rows) + 0.5)
    x = origin[0] + step * (np.arange(columns) + 0.5)
    ground_row, _ = ground.cells(np.column_stack([np.full(rows, x[0]), y]))
    _, ground_column = ground.cells(np.column_stack([x, np.full(columns, y[0])]))
    free |= visible & by_ground[np.ix_(ground_row, ground_column)]

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
