"""Voxel thinning: equal density for clouds that are compared."""

import math

import numpy as np

from lidarslam.core.geometry import FloatArray

_MOST_CELLS = 2**63 - 1


def thin(points: FloatArray, cell_m: float) -> FloatArray:
    """One of the points (N, 3) for every occupied cell, (M, 3), in the order of the cells.

    It is the cell's first point, not the mean that Open3D gives, which would smooth the noise to be measured. Cells
    are counted from the cloud's lowest corner.
    """
    if not len(points):
        return points
    cells = np.floor((points - points.min(axis=0)) / cell_m)
    sizes = [int(size) + 1 for size in cells.max(axis=0)]
    columns = list(cells.astype(np.int64).T) if max(sizes) < _MOST_CELLS else list(cells.T)
    if math.prod(sizes) > _MOST_CELLS:  # a stray point far away: number the occupied rows of cells only
        columns = [np.unique(column, return_inverse=True)[1] for column in columns]
        sizes = [int(column.max()) + 1 for column in columns]
    keys = (columns[0] * sizes[1] + columns[1]) * sizes[2] + columns[2]
    _, first = np.unique(keys, return_index=True)
    return points[first]
