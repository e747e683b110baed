"""Surfels from the moments of a cell and its neighbours: the compiled loops of `SurfelGrid.surfels`.

The columns of surfels are as in `mapping.surfels.grid`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels.cell_kernels import OTHER, Cells, other_side
from lidarslam.mapping.surfels.hash_kernels import PREFETCHED, find_one, middle_of, neighbour_key, prefetch_around
from lidarslam.mapping.surfels.symmetric import write_eigenvalues, write_eigenvector

# Surfels that are computed together: the data of one is prefetched while another is computed.
_TOGETHER = 16
# A surfel is computed again when its cell has grown by this factor.
_GROWTH = np.float32(1.5)
# Decrease of the weight of a neighbouring cell's points, for each coordinate in which it differs.
_LESS_PER_AXIS = 0.2
# Least number of points of a plane.
_FEWEST_POINTS = 6
# Sine of the least angle to a plane at which one of its sides is seen.
_LEAST_SINE = 0.17
# Largest ratio of thickness to width, least ratio of width to length, and least width in cells, of a plane (standard
# deviations): a narrow strip has the tilt of its noise.
_MOST_THICKNESS = 0.4
_LEAST_WIDTH = 0.15
_LEAST_WIDTH_CELLS = 0.2

Scratch = tuple[NDArray[np.int32], FloatArray, FloatArray, FloatArray]
"""Room for the rows (27,) of cells around one, and for 15, 6 and 3 numbers."""


@compiled
def refresh(rows: NDArray[np.int32], cells: Cells, surfels: FloatArray, counts: NDArray[np.float32]) -> None:
    """Compute the surfels (M, 15) of the cells in these rows (N,), or -1, that have grown since the last computation.

    `counts` (M,) has the numbers of points at the last computation.
    """
    work = scratch()
    waiting, around = np.empty(_TOGETHER, dtype=np.int32), np.empty((_TOGETHER, 27), dtype=np.int32)
    count = 0
    for n in range(len(rows)):
        ahead = rows[min(n + PREFETCHED, len(rows) - 1)]
        prefetch(cells.sums, ahead)
        prefetch(counts, ahead)
        row = rows[n]
        if row >= 0 and outdated(row, cells.sums, counts):
            counts[row] = cells.sums[row, 0]
            prefetch_around(cells.keys[row], cells.bits, cells.table_keys, cells.table_rows)
            waiting[count] = row
            count += 1
        if count == _TOGETHER or n == len(rows) - 1:
            for i in range(count):
                prefetch(surfels, waiting[i])
                _find_around(waiting[i], cells, around[i])
            for i in range(count):
                _compute(waiting[i], around[i], cells, surfels, work)
            count = 0


@compiled_part
def is_steep(along: float, distance: float) -> bool:
    """Whether a ray of some length meets a plane at no grazing angle, from the side of its normal."""
    return along > _LEAST_SINE * distance


@compiled_part
def outdated(row: int, sums: NDArray[np.float32], counts: NDArray[np.float32]) -> bool:
    """Whether the cell in a row has grown since its surfel was computed."""
    return bool(counts[row] * _GROWTH <= sums[row, 0])


@compiled_part
def scratch() -> Scratch:
    """Room for `refresh_one`."""
    return np.empty(27, dtype=np.int32), np.empty(15), np.empty(6), np.empty(3)


@compiled_part
def refresh_one(row: int, cells: Cells, surfels: FloatArray, counts: NDArray[np.float32], work: Scratch) -> None:
    """Compute the surfel of one cell."""
    counts[row] = cells.sums[row, 0]
    prefetch_around(cells.keys[row], cells.bits, cells.table_keys, cells.table_rows)
    _find_around(row, cells, work[0])
    _compute(row, work[0], cells, surfels, work)


@compiled_part
def _find_around(row: int, cells: Cells, around: NDArray[np.int32]) -> None:
    """Write the rows (27,) of a cell and its neighbours, or -1, and prefetch their sums."""
    key, n = cells.keys[row], 0
    for a in range(-1, 2):
        for b in range(-1, 2):
            for c in range(-1, 2):
                around[n] = find_one(neighbour_key(key, a, b, c), cells.bits, cells.table_keys, cells.table_rows)
                prefetch(cells.sums, around[n])
                n += 1


@compiled_part
def _compute(row: int, around: NDArray[np.int32], cells: Cells, surfels: FloatArray, work: Scratch) -> None:
    """Compute the surfel of a cell, with the rows (27,) of the cells around it."""
    _, total, covariance, values = work
    _gather(row, around, cells, total)
    count, x, y, z = total[0], total[1] / total[0], total[2] / total[0], total[3] / total[0]
    covariance[0], covariance[1], covariance[2] = -x * x, -x * y, -x * z
    covariance[3], covariance[4], covariance[5] = -y * y, -y * z, -z * z
    for column in range(6):
        covariance[column] += total[4 + column] / count
    write_eigenvalues(covariance, values)
    i, j, k = middle_of(cells.keys[row])
    surfel = surfels[row]
    surfel[0], surfel[1], surfel[2] = (i + x) * cells.cell_m, (j + y) * cells.cell_m, (k + z) * cells.cell_m
    write_eigenvector(covariance, values[0], surfel[3:6])
    if surfel[3] * total[12] + surfel[4] * total[13] + surfel[5] * total[14] < 0.0:  # towards where it was seen from
        surfel[3], surfel[4], surfel[5] = -surfel[3], -surfel[4], -surfel[5]
    write_eigenvector(covariance, values[2], surfel[6:9])
    for axis in range(3):
        surfel[9 + axis] = math.sqrt(max(values[axis], 0.0)) * cells.cell_m
    elevation = total[10] / count
    surfel[12] = math.sqrt(max(total[11] / count - elevation * elevation, 0.0))
    surfel[13] = count
    thickness, width, length = surfel[9], surfel[10], surfel[11]
    enough = surfel[13] >= _FEWEST_POINTS
    is_wide = width > _LEAST_WIDTH * length and width > _LEAST_WIDTH_CELLS * cells.cell_m
    surfel[14] = enough and thickness < _MOST_THICKNESS * width and is_wide


@compiled_part
def _gather(row: int, around: NDArray[np.int32], cells: Cells, total: FloatArray) -> None:
    """Write the weighted sums (15,) of a cell and its 26 neighbours, about its own centre.

    Neighbours seen from the other side are another surface: a thin wall has two.
    """
    own, at = cells.sums[row], -1
    # Sums in variables of their own stay in registers.
    n = x = y = z = xx = xy = xz = yy = yz = zz = elevation = squared = u = v = w = 0.0
    for a in range(-1, 2):
        for b in range(-1, 2):
            for c in range(-1, 2):
                at += 1
                other = around[at]
                if other < 0:
                    continue
                if cells.sums[other, OTHER] > 0.0:
                    other = row if a == b == c == 0 else _same_side(own, other, cells)
                s = cells.sums[other]
                if own[12] * s[12] + own[13] * s[13] + own[14] * s[14] < 0.0:
                    continue
                weight = 1.0 - _LESS_PER_AXIS * (abs(a) + abs(b) + abs(c))
                i, j, k = float(a), float(b), float(c)
                # Moments about the centre of the neighbour, then about the own centre.
                m, p, q, r = weight * s[0], weight * s[1], weight * s[2], weight * s[3]
                n += m
                x += p + i * m
                y += q + j * m
                z += r + k * m
                xx += weight * s[4] + i * (2.0 * p + i * m)
                xy += weight * s[5] + i * q + j * (p + i * m)
                xz += weight * s[6] + i * r + k * (p + i * m)
                yy += weight * s[7] + j * (2.0 * q + j * m)
                yz += weight * s[8] + j * r + k * (q + j * m)
                zz += weight * s[9] + k * (2.0 * r + k * m)
                elevation += weight * s[10]
                squared += weight * s[11]
                u += weight * s[12]
                v += weight * s[13]
                w += weight * s[14]
    total[0], total[1], total[2], total[3] = n, x, y, z
    total[4], total[5], total[6], total[7], total[8], total[9] = xx, xy, xz, yy, yz, zz
    total[10], total[11], total[12], total[13], total[14] = elevation, squared, u, v, w


@compiled_part
def _same_side(own: NDArray[np.float32], row: int, cells: Cells) -> int:
    """The row of that side of a cell whose view direction is nearer to that of the sums (15,)."""
    other = other_side(row, cells.sums)
    if _view_cosine(own, cells.sums[other]) > _view_cosine(own, cells.sums[row]):
        return int(other)
    return row


@compiled_part
def _view_cosine(own: NDArray[np.float32], sums: NDArray[np.float32]) -> float:
    """Cosine between the view directions of two cells, times the length of the first."""
    length = math.sqrt(sums[12] * sums[12] + sums[13] * sums[13] + sums[14] * sums[14])
    return float((own[12] * sums[12] + own[13] * sums[13] + own[14] * sums[14]) / max(length, 1e-9))
