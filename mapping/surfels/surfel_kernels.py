"""Surfels and their sums of moments: the compiled loops of `SurfelGrid`.

A cell's sums are (15,) float32: number of points, first and second moments about the cell's centre in units of the cell
(x, y, z, xx, xy, xz, yy, yz, zz), first and second moment of the elevation, and the sum of the view directions (x, y,
z). They fill a cache line with a sixteenth number, see `other_side`. Keys, and the table of keys and rows, are those of
`mapping.surfels.voxel_hash`; the columns of surfels are as in `mapping.surfels.grid`.

A cell with a plane holds one side of it. Points of that plane seen from behind belong to another surface and to a cell
of their own, the cell's other side. Views are directions from a point to the sensor."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels.symmetric import write_eigenvalues, write_eigenvector
from lidarslam.mapping.surfels.voxel_hash import (
    ABSENT,
    FIRST_SIDE,
    PREFETCHED,
    Keys,
    Rows,
    cell_of,
    find_around,
    find_one,
    key_at,
    key_of,
    middle_of,
    prefetch_around,
    prefetch_slot,
)

Floats = NDArray[np.float32]

# Column of the link to a cell's other side: its row plus one, exact to 16 million cells; zero where there is none.
OTHER = 15
# A cell with this many points is frozen, so that drift does not smear it.
_MOST_POINTS = 60.0
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
# Least squared cosine between the view of a point and those of its cell for one side.
_SAME_VIEW = 0.5
# Columns of surfels: where the normal begins, and whether it is one of a plane.
_NORMAL, _IS_PLANE = 3, 14


class Cells(NamedTuple):
    """The arrays of a grid of M cells."""

    cell_m: float  # edge of a cell
    bits: int  # binary logarithm of the number of slots
    # table_keys, table_rows: of the hash
    table_keys: Keys
    table_rows: Rows
    keys: Keys  # (M,) of the cells, by row
    sums: Floats  # (M, 16) moments, and the link to the other side


# The cells of a grid, their surfels (M, 15), and the points (M,) of each when its surfel was computed.
Arrays = tuple[Cells, FloatArray, Floats]


@compiled_part
def other_side(row: int, sums: Floats) -> int:
    """Row of the other side of the cell in a row, `ABSENT` where there is none."""
    return int(sums[row, OTHER]) - 1


@compiled
def link_sides(keys: Keys, rows: Rows, bits: int, table_keys: Keys, table_rows: Rows, sums: Floats) -> None:
    """Write the links between both sides of cells into sums (M, 16), for the keys (N,) in rows (N,) of other sides."""
    for n in range(len(keys)):
        if keys[n] < 0 and other_side(rows[n], sums) == ABSENT:
            first = find_one(keys[n] & FIRST_SIDE, bits, table_keys, table_rows)
            sums[rows[n], OTHER] = first + 1
            if first != ABSENT:
                sums[first, OTHER] = rows[n] + 1


@compiled
def write_views(points: FloatArray, sensor: FloatArray, views: Floats) -> None:
    """Write the unit directions (N, 3) from points (N, 3) to the sensor (3,)."""
    for n in range(len(points)):
        x, y, z = sensor[0] - points[n, 0], sensor[1] - points[n, 1], sensor[2] - points[n, 2]
        scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-9)
        views[n, 0], views[n, 1], views[n, 2] = x * scale, y * scale, z * scale


def views_of(points: FloatArray, sensor: FloatArray) -> NDArray[np.float32]:
    """The unit directions (N, 3) from points (N, 3) to the sensor (3,)."""
    views = np.empty((len(points), 3), dtype=np.float32)
    write_views(np.ascontiguousarray(points), np.ascontiguousarray(sensor), views)
    return views


@compiled
def add_moments(
    points: FloatArray, elevations: FloatArray, views: Floats, rows: Rows, cell_m: float, sums: Floats, weight: float
) -> None:  # fmt: skip
    """Add points (N, 3) with elevations (N,) and views (N, 3) to the sums of their cells, unless these are frozen.

    Each point counts `weight` times.
    """
    scale, w = 1.0 / cell_m, np.float32(weight)
    is_growing = np.empty(len(rows), dtype=np.bool_)
    for n in range(len(rows)):
        prefetch(sums, rows[min(n + PREFETCHED, len(rows) - 1)])
        is_growing[n] = sums[rows[n], 0] < _MOST_POINTS
    for n in range(len(rows)):
        if not is_growing[n]:
            continue
        sx, sy, sz = points[n, 0] * scale, points[n, 1] * scale, points[n, 2] * scale
        # Within the cell's own frame single precision is enough.
        x = np.float32(sx - cell_of(sx) - 0.5)
        y = np.float32(sy - cell_of(sy) - 0.5)
        z = np.float32(sz - cell_of(sz) - 0.5)
        elevation = np.float32(elevations[n])
        cell = sums[rows[n]]
        cell[0] += w
        cell[1] += w * x
        cell[2] += w * y
        cell[3] += w * z
        cell[4] += w * x * x
        cell[5] += w * x * y
        cell[6] += w * x * z
        cell[7] += w * y * y
        cell[8] += w * y * z
        cell[9] += w * z * z
        cell[10] += w * elevation
        cell[11] += w * elevation * elevation
        cell[12] += w * views[n, 0]
        cell[13] += w * views[n, 1]
        cell[14] += w * views[n, 2]


@compiled
def look_up(points: FloatArray, cells: Cells, rows: Rows) -> None:
    """Write the rows (N,) of the cells of points (N, 3), else of the nearest around; or `ABSENT`."""
    scale, last, around = 1.0 / cells.cell_m, len(points) - 1, np.empty(27, dtype=np.int32)
    for n in range(len(points)):
        ahead = key_at(points[min(n + PREFETCHED, last)], scale)
        prefetch_slot(ahead, cells.bits, cells.table_keys, cells.table_rows)
        x, y, z = points[n, 0] * scale, points[n, 1] * scale, points[n, 2] * scale
        i, j, k = cell_of(x), cell_of(y), cell_of(z)
        row = find_one(key_of(i, j, k), cells.bits, cells.table_keys, cells.table_rows)
        rows[n] = row if row != ABSENT else _nearest(i, j, k, x, y, z, cells, around)


@compiled_part
def _nearest(i: int, j: int, k: int, x: float, y: float, z: float, cells: Cells, around: Rows) -> int:
    """Row of the occupied cell around an empty one whose mean is nearest to a point, all in units of cells.

    `around` (27,) holds the rows of all.
    """
    nearest, least, n = ABSENT, np.inf, -1
    find_around(key_of(i, j, k), cells.bits, cells.table_keys, cells.table_rows, around)
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            for c in range(k - 1, k + 2):
                n += 1
                row = around[n]
                if row == ABSENT:
                    continue
                count = cells.sums[row, 0]
                dx = cells.sums[row, 1] / count + (a + 0.5 - x)
                dy = cells.sums[row, 2] / count + (b + 0.5 - y)
                dz = cells.sums[row, 3] / count + (c + 0.5 - z)
                squared = dx * dx + dy * dy + dz * dz
                if squared < least:
                    nearest, least = row, squared
    return nearest


@compiled
def refresh(rows: NDArray[np.int32], cells: Cells, surfels: FloatArray, counts: NDArray[np.float32]) -> None:
    """Compute the surfels (M, 15) of the cells in these rows (N,), or -1, that have grown since the last computation.

    `counts` (M,) has the numbers of points at the last computation.
    """
    work = np.empty(15), np.empty(6), np.empty(3)
    waiting, around = np.empty(_TOGETHER, dtype=np.int32), np.empty((_TOGETHER, 27), dtype=np.int32)
    count = 0
    for n in range(len(rows)):
        ahead = rows[min(n + PREFETCHED, len(rows) - 1)]
        prefetch(cells.sums, ahead)
        prefetch(counts, ahead)
        row = rows[n]
        if row >= 0 and counts[row] * _GROWTH <= cells.sums[row, 0]:
            counts[row] = cells.sums[row, 0]
            prefetch_around(cells.keys[row], cells.bits, cells.table_keys, cells.table_rows)
            waiting[count] = row
            count += 1
        if count == _TOGETHER or n == len(rows) - 1:
            for i in range(count):
                prefetch(surfels, waiting[i])
                key = cells.keys[waiting[i]]
                find_around(key, cells.bits, cells.table_keys, cells.table_rows, around[i])
                for other in around[i]:
                    prefetch(cells.sums, other)
            for i in range(count):
                _compute(waiting[i], around[i], cells, surfels, work)
            count = 0


@compiled_part
def is_steep(along: float, distance: float) -> bool:
    """Whether a ray of some length meets a plane at no grazing angle, from the side of its normal."""
    return along > _LEAST_SINE * distance


@compiled_part
def _compute(
    row: int, around: NDArray[np.int32], cells: Cells, surfels: FloatArray,
    work: tuple[FloatArray, FloatArray, FloatArray],
) -> None:  # fmt: skip
    """Compute the surfel of a cell, with the rows (27,) of the cells around it, and room for 15, 6 and 3 numbers."""
    total, covariance, values = work
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
    surfel[12] = math.sqrt(max(total[11] / count - elevation * elevation, 0.0)) if total[11] > 0.0 else -1.0
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


@compiled
def belong_to_others(
    views: NDArray[np.float32], rows: NDArray[np.int32], cells: Cells, surfels: FloatArray, counts: NDArray[np.float32],
    chosen: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Write whether points (N,), with views (N, 3), belong to the other sides of their cells, in rows (N,).

    Outdated surfels (M, 15) are updated.
    """
    asked, stale = np.empty(len(rows), dtype=np.int32), np.empty(2 * len(rows), dtype=np.int32)
    count, size = 0, 0
    for n in range(len(rows)):
        prefetch(cells.sums, rows[min(n + PREFETCHED, len(rows) - 1)])
        chosen[n], other = False, other_side(rows[n], cells.sums)
        if other == ABSENT and _is_seen_alike(views[n], cells.sums[rows[n]]):
            continue
        asked[count] = n
        count += 1
        # An outdated plane is still the same plane; a cell without a plane may have one by now.
        if other != ABSENT or not surfels[rows[n], _IS_PLANE] > 0.0:
            stale[size], stale[size + 1] = rows[n], other
            size += 2
    refresh(stale[:size], cells, surfels, counts)
    for k in range(count):
        ahead = rows[asked[min(k + PREFETCHED, count - 1)]]
        prefetch(surfels[:, _IS_PLANE:], ahead)
        prefetch(surfels[:, _NORMAL:], ahead)
        n = asked[k]
        row, x, y, z = rows[n], float(views[n, 0]), float(views[n, 1]), float(views[n, 2])
        other = other_side(row, cells.sums)
        if other != ABSENT:
            chosen[n] = _facing(other, x, y, z, cells, surfels) > _facing(row, x, y, z, cells, surfels)
            continue
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
    others = np.empty(len(rows), dtype=np.int32)
    for n in range(len(rows)):
        prefetch(cells.sums, rows[min(n + PREFETCHED, len(rows) - 1)])
        others[n] = other_side(rows[n], cells.sums) if rows[n] >= 0 else ABSENT
    double = np.flatnonzero(others != ABSENT)
    refresh(rows[double], cells, surfels, counts)
    refresh(others[double], cells, surfels, counts)
    for m in double:
        x, y, z = sensor[0] - points[m, 0], sensor[1] - points[m, 1], sensor[2] - points[m, 2]
        if _facing(others[m], x, y, z, cells, surfels) > _facing(rows[m], x, y, z, cells, surfels):
            rows[m] = others[m]


@compiled_part
def _facing(row: int, x: float, y: float, z: float, cells: Cells, surfels: FloatArray) -> float:
    """Cosine of a view with a cell's normal, where it has a plane, else with the cell's mean view."""
    p, sums = surfels[row], cells.sums[row]
    if p[14] > 0.0:
        return float(x * p[3] + y * p[4] + z * p[5])
    length = math.sqrt(sums[12] * sums[12] + sums[13] * sums[13] + sums[14] * sums[14])
    return float((x * sums[12] + y * sums[13] + z * sums[14]) / max(length, 1e-9))
