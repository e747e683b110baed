"""Both sides of thin walls, by the direction that points were seen from: compiled loops of `SurfelGrid`.

A cell with a plane holds one side of it. Points of that plane seen from behind belong to another surface and to a cell
of their own, the cell's other side. Views are directions from a point to the sensor.
"""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels.cell_kernels import Cells, other_side
from lidarslam.mapping.surfels.hash_kernels import ABSENT, PREFETCHED
from lidarslam.mapping.surfels.surfel_kernels import is_steep, outdated, refresh_one, scratch

# Least squared cosine between the view of a point and those of its cell for one side.
_SAME_VIEW = 0.5
# Columns of surfels: where the normal begins, and whether it is one of a plane.
_NORMAL, _IS_PLANE = 3, 14


@compiled
def belong_to_others(
    views: NDArray[np.float32], rows: NDArray[np.int32], cells: Cells, surfels: FloatArray, counts: NDArray[np.float32],
    chosen: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Write whether points (N,), with views (N, 3), belong to the other sides of their cells, in rows (N,).

    Outdated surfels (M, 15) are updated.
    """
    work, asked = scratch(), np.empty(len(rows), dtype=np.int32)
    count = 0
    for n in range(len(rows)):
        prefetch(cells.sums, rows[min(n + PREFETCHED, len(rows) - 1)])
        chosen[n] = False
        asked[count] = n
        count += other_side(rows[n], cells.sums) >= 0 or not _is_seen_alike(views[n], cells.sums[rows[n]])
    for k in range(count):
        ahead = rows[asked[min(k + PREFETCHED, count - 1)]]
        prefetch(surfels[:, _IS_PLANE:], ahead)
        prefetch(surfels[:, _NORMAL:], ahead)
        n = asked[k]
        row, x, y, z = rows[n], float(views[n, 0]), float(views[n, 1]), float(views[n, 2])
        other = other_side(row, cells.sums)
        if other >= 0:
            if outdated(row, cells.sums, counts):
                refresh_one(row, cells, surfels, counts, work)
            if outdated(other, cells.sums, counts):
                refresh_one(other, cells, surfels, counts, work)
            chosen[n] = _facing(other, x, y, z, cells, surfels) > _facing(row, x, y, z, cells, surfels)
            continue
        # An outdated plane is still the same plane; a cell without a plane may have one by now.
        if not surfels[row, _IS_PLANE] > 0.0 and outdated(row, cells.sums, counts):
            refresh_one(row, cells, surfels, counts, work)
        p = surfels[row]
        behind = -(x * p[_NORMAL] + y * p[_NORMAL + 1] + z * p[_NORMAL + 2])
        chosen[n] = p[_IS_PLANE] > 0.0 and is_steep(behind, math.sqrt(x * x + y * y + z * z))


@compiled_part
def _is_seen_alike(view: NDArray[np.float32], sums: NDArray[np.float32]) -> bool:
    """Whether a point's view (3,) is near the mean view of its cell, so that both are of one side."""
    x, y, z = float(view[0]), float(view[1]), float(view[2])
    u, v, w = float(sums[12]), float(sums[13]), float(sums[14])
    along, squared = x * u + y * v + z * w, x * x + y * y + z * z
    return not (along < 0.0 or along * along < _SAME_VIEW * squared * (u * u + v * v + w * w))


@compiled
def turn_to_sensor(
    points: FloatArray, sensor: FloatArray, cells: Cells, surfels: FloatArray, counts: NDArray[np.float32],
    rows: NDArray[np.int32],
) -> None:  # fmt: skip
    """Change the rows (N,) of cells, or -1, to those of their other sides where these face the sensor.

    The sensor at (3,) measured points (N, 3).
    """
    work = scratch()
    for n in range(len(rows)):
        prefetch(cells.sums, rows[min(n + PREFETCHED, len(rows) - 1)])
        row = rows[n]
        other = other_side(row, cells.sums) if row >= 0 else ABSENT
        if other == ABSENT:
            continue
        if outdated(row, cells.sums, counts):
            refresh_one(row, cells, surfels, counts, work)
        if outdated(other, cells.sums, counts):
            refresh_one(other, cells, surfels, counts, work)
        x, y, z = sensor[0] - points[n, 0], sensor[1] - points[n, 1], sensor[2] - points[n, 2]
        if _facing(other, x, y, z, cells, surfels) > _facing(row, x, y, z, cells, surfels):
            rows[n] = other


@compiled_part
def _facing(row: int, x: float, y: float, z: float, cells: Cells, surfels: FloatArray) -> float:
    """Cosine of a view with a cell's normal, where it has a plane, else with the cell's mean view."""
    p, sums = surfels[row], cells.sums[row]
    if p[14] > 0.0:
        return float(x * p[3] + y * p[4] + z * p[5])
    length = math.sqrt(sums[12] * sums[12] + sums[13] * sums[13] + sums[14] * sums[14])
    return float((x * sums[12] + y * sums[13] + z * sums[14]) / max(length, 1e-9))
