"""Compiled loops over points and voxels behind `GlobalMap`.

Rows are float32, their columns those of `mapping.global_map.voxel_rows`; positions are within the voxel. Keys are those
of `mapping.surfels.hash_kernels`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels.hash_kernels import EMPTY, PREFETCHED, cell_of, key_of
from lidarslam.mapping.surfels.voxel_hash import reach_m

Keys = NDArray[np.int64]
Sums = NDArray[np.float32]

_reach_m = compiled_part(reach_m)


@compiled
def write_sums(points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float, keys: Keys, sums: Sums) -> int:
    """Write keys (N,) and the first seven columns of rows (N, C) of the points (N, 3) of a scan, in the LiDAR frame.

    Returns:
        Number of points beyond the reach of the voxels, whose keys are `EMPTY`.
    """
    T, sensor = T_world_lidar, T_world_lidar[:3, 3]
    reach, beyond = _reach_m(voxel_size_m), 0
    for n in range(len(points)):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if not (abs(x) < reach and abs(y) < reach and abs(z) < reach):
            keys[n] = EMPTY
            beyond += 1
            continue
        u, v, w = sensor[0] - x, sensor[1] - y, sensor[2] - z
        distance = math.sqrt(u * u + v * v + w * w)
        i, j, k = cell_of(x / voxel_size_m), cell_of(y / voxel_size_m), cell_of(z / voxel_size_m)
        keys[n] = key_of(i, j, k)
        # Within the voxel float32 is exact enough.
        sums[n, 0], sums[n, 1], sums[n, 2] = x - i * voxel_size_m, y - j * voxel_size_m, z - k * voxel_size_m
        sums[n, 3], sums[n, 4], sums[n, 5], sums[n, 6] = u / distance, v / distance, w / distance, 1.0
    return beyond


@compiled
def add_up(order: NDArray[np.intp], keys: Keys, sums: Sums, summed: int, unique: Keys, totals: Sums) -> int:
    """Write the keys (M,) and the totals (M, C) of the rows (N, C) of equal keys (N,), given an order that sorts these.

    The first columns are summed, so many; those behind are those of the earliest row, by the first two of them.

    Returns:
        M.
    """
    count, columns = 0, sums.shape[1]
    for n in range(len(order)):
        ahead = order[min(n + PREFETCHED, len(order) - 1)]
        prefetch(keys, ahead)
        prefetch(sums, ahead)
        row = order[n]
        if count == 0 or keys[row] != unique[count - 1]:
            unique[count] = keys[row]
            for column in range(
                columns
            ):  # copying a whole row brings the text of its error, which takes 4 s to compile
                totals[count, column] = sums[row, column]
            count += 1
        else:
            for column in range(summed):
                totals[count - 1, column] += sums[row, column]
            if summed < columns and _is_earlier(sums[row], totals[count - 1], summed):
                for column in range(summed, columns):
                    totals[count - 1, column] = sums[row, column]
    return count


@compiled
def unite(
    first_keys: Keys, first_sums: Sums, second_keys: Keys, second_sums: Sums, summed: int, unique: Keys, totals: Sums
) -> int:  # fmt: skip
    """As `add_up` for two tables, each with its keys (N,) sorted and unique."""
    count, a, b, columns = 0, 0, 0, first_sums.shape[1]
    while a < len(first_keys) or b < len(second_keys):
        from_first = b >= len(second_keys) or (a < len(first_keys) and first_keys[a] <= second_keys[b])
        from_second = a >= len(first_keys) or (b < len(second_keys) and second_keys[b] <= first_keys[a])
        unique[count] = first_keys[a] if from_first else second_keys[b]
        for column in range(columns):
            totals[count, column] = first_sums[a, column] if from_first else second_sums[b, column]
        if from_first and from_second:
            for column in range(summed):
                totals[count, column] += second_sums[b, column]
            if summed < columns and _is_earlier(second_sums[b], totals[count], summed):
                for column in range(summed, columns):
                    totals[count, column] = second_sums[b, column]
        a, b, count = a + from_first, b + from_second, count + 1
    return count


@compiled_part
def _is_earlier(row: Sums, other: Sums, column: int) -> bool:
    """Whether the time of one row (C,) is before another's: a column and the rest of it in the next one."""
    high, rest = row[column] - other[column], row[column + 1] - other[column + 1]
    return bool(high < 0.0 or (high == 0.0 and rest < 0.0))
