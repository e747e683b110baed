"""What cells and those around them show of a surface: the loop behind `SurfelGrid.patches`, compiled.

The columns of patches are those of `mapping.patches`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from mapping.cell_kernels import Cells, gather, middle_of
from mapping.symmetric import write_eigenvalues, write_eigenvector

# A patch is worked out again when its cell has this many times the points it had.
_GROWTH = np.float32(1.3)
# Fewer points show nothing.
_FEWEST_POINTS = 6
# Spreads are standard deviations along the principal axes. A plane is thin beside its width, and no line; a line is
# long beside its width: LOAM asks for a largest eigenvalue of three times the next.
_MOST_THICKNESS = 0.4
_LEAST_WIDTH = 0.15
_LEAST_LENGTH = 3.0**0.5


@compiled
def refresh(rows: NDArray[np.int32], cells: Cells, patches: FloatArray, counts: NDArray[np.float32]) -> None:
    """Work out what the cells in these rows (N,), or -1, show, if they have grown since they were last looked at.

    Args:
        rows: which.
        cells: all of them.
        patches: (M, 16), written.
        counts: (M,) how many points the cells had when they were last looked at, written.
    """
    room = np.empty(15), np.empty(6), np.empty(3)
    for n in range(len(rows)):
        if rows[n] >= 0:
            refresh_one(rows[n], cells, patches, counts, room)


@compiled
def refresh_one(
    row: int, cells: Cells, patches: FloatArray, counts: NDArray[np.float32],
    room: tuple[FloatArray, FloatArray, FloatArray],
) -> None:  # fmt: skip
    """Do so for the cell in one row, in room for 15, 6 and 3 numbers."""
    if counts[row] * _GROWTH > cells.sums[row, 0]:
        return
    total, covariance, values = room
    counts[row] = cells.sums[row, 0]
    gather(row, cells, total)
    count, x, y, z = total[0], total[1] / total[0], total[2] / total[0], total[3] / total[0]
    covariance[0], covariance[1], covariance[2] = -x * x, -x * y, -x * z
    covariance[3], covariance[4], covariance[5] = -y * y, -y * z, -z * z
    for column in range(6):
        covariance[column] += total[4 + column] / count
    write_eigenvalues(covariance, values)
    i, j, k = middle_of(cells.keys[row])
    patch = patches[row]
    patch[0], patch[1], patch[2] = (i + x) * cells.cell_m, (j + y) * cells.cell_m, (k + z) * cells.cell_m
    write_eigenvector(covariance, values[0], patch[3:6])
    if patch[3] * total[12] + patch[4] * total[13] + patch[5] * total[14] < 0.0:  # towards where it was seen from
        patch[3], patch[4], patch[5] = -patch[3], -patch[4], -patch[5]
    write_eigenvector(covariance, values[2], patch[6:9])
    for axis in range(3):
        patch[9 + axis] = math.sqrt(max(values[axis], 0.0)) * cells.cell_m
    elevation = total[10] / count
    patch[12] = math.sqrt(max(total[11] / count - elevation * elevation, 0.0))
    patch[13] = count
    _judge(patch)


@compiled
def _judge(patch: FloatArray) -> None:
    """Write what it is."""
    thickness, width, length = patch[9], patch[10], patch[11]
    enough = patch[13] >= _FEWEST_POINTS
    patch[14] = enough and thickness < _MOST_THICKNESS * width and width > _LEAST_WIDTH * length
    patch[15] = enough and length > _LEAST_LENGTH * width
