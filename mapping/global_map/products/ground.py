"""Height of the ground around a path, grown outwards from below the sensor, so that slopes are ground."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.global_map.products.grid_kernels import grow_ground

CELL_M = 0.5
# Least |z| of the normal of a point of the ground.
_UPRIGHT = float(np.cos(np.deg2rad(35.0)))
# The ground rises or falls by so much from one cell to the next, at most: a slope, and the noise of the points.
_STEP_M = CELL_M * float(np.tan(np.deg2rad(15.0))) + 0.05
_FEWEST_POINTS = 3
# Cells without points of the ground that it is continued over: 3 m.
_LONGEST_GAP = 6
# Below the sensor: horizontal reach of a first look at the ground, least depth, and bins of its height.
_REACH_M, _LEAST_DEPTH_M, _BIN_M = 2.5, 0.1, 0.1


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
    """The ground around the positions (K, 3) of a sensor; None if none is found below it.

    It begins with the most frequent height of upright surfaces below the sensor, and grows from cell to cell: points of
    the next cell belong to it if they are a slope away from it, and over gaps it is continued.

    Args:
        points: (N, 3) of the map.
        normals: (N, 3) of its surfaces.
        positions: of the sensor, in the order of time.
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
    grow_ground(
        upright[order, 2],
        starts,
        row * columns + column,
        heights,
        _STEP_M,
        _FEWEST_POINTS,
        _LONGEST_GAP,
        ground.heights,
        ground.observed,
    )
    return ground


def _below(upright: FloatArray, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (M, 2) along the path, and the heights (M,) of the ground below them."""
    tree = cKDTree(upright[:, :2]) if len(upright) else None
    seeds, heights = [], []
    for position in along_path(positions, CELL_M):
        near = [] if tree is None else tree.query_ball_point(position[:2], _REACH_M)
        z = upright[near, 2]
        z = z[z < position[2] - _LEAST_DEPTH_M]
        if len(z) < _FEWEST_POINTS:
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
