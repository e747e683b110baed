"""Which side of a cell a point belongs to, by where it was seen from: the loops behind `SurfelGrid`, compiled.

A cell that shows a plane holds one side of it. What is seen of that plane from behind is another surface, as of a thin
wall, and goes into a cell of its own, the cell's other side. Views are directions from a point to the sensor.
"""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from mapping.surfels.cell_kernels import Cells
from mapping.surfels.patch_kernels import is_steep, outdated, refresh_one

# A plane is not seen from behind when it is seen from much the same direction as the cell was: the least squared cosine
# between them.
_SAME_VIEW = 0.5


@compiled
def belong_to_others(
    views: NDArray[np.float32], rows: NDArray[np.int32], cells: Cells, patches: FloatArray, counts: NDArray[np.float32],
    chosen: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Write which points (N,), seen from directions (N, 3), belong to the other sides of their cells, in rows (N,).

    What the cells show, (M, 15), is worked out where it must be; see `mapping.surfels.patch_kernels.refresh`.
    """
    room = np.empty(15), np.empty(6), np.empty(3)
    for n in range(len(rows)):
        row, chosen[n] = rows[n], False
        x, y, z = float(views[n, 0]), float(views[n, 1]), float(views[n, 2])
        other = cells.others[row]
        if other >= 0:
            if outdated(row, cells.sums, counts):
                refresh_one(row, cells, patches, counts, room)
            if outdated(other, cells.sums, counts):
                refresh_one(other, cells, patches, counts, room)
            chosen[n] = _facing(other, x, y, z, cells, patches) > _facing(row, x, y, z, cells, patches)
            continue
        u, v, w = float(cells.sums[row, 12]), float(cells.sums[row, 13]), float(cells.sums[row, 14])
        along, squared = x * u + y * v + z * w, x * x + y * y + z * z
        if along < 0.0 or along * along < _SAME_VIEW * squared * (u * u + v * v + w * w):
            # A plane that has grown since is still the same plane; what was none may have become one.
            if not patches[row, 14] > 0.0 and outdated(row, cells.sums, counts):
                refresh_one(row, cells, patches, counts, room)
            p = patches[row]
            chosen[n] = p[14] > 0.0 and is_steep(-(x * p[3] + y * p[4] + z * p[5]), math.sqrt(squared))


@compiled
def turn_to_sensor(
    points: FloatArray, sensor: FloatArray, cells: Cells, patches: FloatArray, counts: NDArray[np.float32],
    rows: NDArray[np.int32],
) -> None:  # fmt: skip
    """Change the rows (N,) of cells, or -1, to those of their other sides where these face a sensor (3,) that sees
    points (N, 3)."""
    room = np.empty(15), np.empty(6), np.empty(3)
    for n in range(len(rows)):
        row = rows[n]
        if row < 0 or cells.others[row] < 0:
            continue
        other = cells.others[row]
        if outdated(row, cells.sums, counts):
            refresh_one(row, cells, patches, counts, room)
        if outdated(other, cells.sums, counts):
            refresh_one(other, cells, patches, counts, room)
        x, y, z = sensor[0] - points[n, 0], sensor[1] - points[n, 1], sensor[2] - points[n, 2]
        if _facing(other, x, y, z, cells, patches) > _facing(row, x, y, z, cells, patches):
            rows[n] = other


@compiled
def _facing(row: int, x: float, y: float, z: float, cells: Cells, patches: FloatArray) -> float:
    """How far a cell faces a view: by the plane it shows, else by where it was seen from."""
    p, sums = patches[row], cells.sums[row]
    if p[14] > 0.0:
        return float(x * p[3] + y * p[4] + z * p[5])
    length = math.sqrt(sums[12] * sums[12] + sums[13] * sums[13] + sums[14] * sums[14])
    return float((x * sums[12] + y * sums[13] + z * sums[14]) / max(length, 1e-9))
