"""Map of edges and planar points: their moments in voxels of several sizes, and the lines and planes through these.

The voxels are hashed as in `mapping.surfels.voxel_hash`: the five nearest to a point, by their means, are looked for in
its voxel and the 26 around it."""

import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Shape, State, Stateful
from lidarslam.mapping.loam.features import EDGE, squared_distance
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.local_map import (
    COARSE,
    LocalMap,
    Matcher,
    Surfaces,
    for_each_grid,
    vertical_of,
)
from lidarslam.mapping.registration.sampled_scan import CellSizes, SampledScan
from lidarslam.mapping.surfels.surfel_kernels import is_steep, views_of
from lidarslam.mapping.surfels.symmetric import SYMMETRIC, write_eigenvalues, write_eigenvector
from lidarslam.mapping.surfels.voxel_hash import (
    ABSENT,
    Keys,
    Rows,
    VoxelHash,
    find_around,
    key_at,
    point_keys,
    prefetch_around,
    resized,
    write_new_keys,
)

# Voxels whose points a plane or line is fitted to, and the least number for a line, which passes through few.
NEIGHBOURS, _LINE_VOXELS = 5, 3
# Least ratio of the two largest variances of a line's neighbours, and of a plane's: points of one ring span no plane.
_LINE_RATIO, _PLANE_RATIO = 3.0, 0.0225
# Least ratio of the two smallest variances of a plane's.
_FLAT_RATIO = 3.0
# Largest distance of a plane's neighbours from it: of these, the smaller one.
_PLANE_M, _PLANE_CELLS = 0.2, 0.5
# Standard deviation of a range, and the number of points it counts as in the scatter of few.
_RANGE_NOISE_M, _COUNTED = 0.02, 2.0
# A line or plane is as uncertain as if this many of its points counted as one: neighbours share their errors.
_SHARED = 120.0
# Largest standard deviation of the direction of a line or plane, without and with rings: across the corner of a floor
# and a wall, and along a ring or stroke, five points make planes of any direction, and these move with the sensor.
# Planes of a single ring are rejected by `_spans_rings`; at 0.05, a third of the planes in high grass would be, too.
_MOST_TILT, _MOST_TILT_OF_RINGS = 0.05, 0.1
# Least width of a plane, a standard deviation: per distance along it from the sensor, and at most. A ring that is swept
# a little, as by a sensor that starts to move, makes a plane that errors of attitude tilt, the more the narrower it is.
_LEAST_WIDTH, _LEAST_WIDTH_M = 1.0 / 80.0, 0.08
# From this on, a plane of coarser voxels is asked for.
_CERTAIN_TILT = 0.03
# Least cosine of the angle between a plane's normal and the beam. The beams of a ring span a plane of their own.
_LEAST_COSINE = 0.1
# Seen at a grazing angle, a plane's points have to differ so much in height across the rings: the relief along a single
# ring moves with the sensor.
_LEAST_HEIGHT_M = 0.07
# Mean cosine of the views beyond which a plane faces away from the sensor, as the other face of a thin wall does.
_SIDE_COSINE = 0.05
# Points whose slots are prefetched.
_PREFETCHED = 4
# A voxel with this many points is frozen, so that drift does not smear it.
_MOST_POINTS = 60.0
# Correspondences are kept over a displacement of this share of a cell.
_SAME_CELLS = 0.1


class Voxels(NamedTuple):
    """The arrays of a map of M voxels."""

    cell_m: float  # edge of a voxel
    bits: int  # binary logarithm of the number of slots
    # table_keys, table_rows: of the hash
    table_keys: Keys
    table_rows: Rows
    # sums: (M, 15) number of points, sums of their coordinates in the world, of the products of these, of the unit
    # views, the directions to the sensor, and of the elevations and their squares
    sums: FloatArray


@compiled
def add_moments(
    points: FloatArray, views: NDArray[np.float32], elevations: FloatArray, rows: Rows, sums: FloatArray
) -> None:
    """Add points, their views (N, 3) and elevations (N,) to the sums (M, 15) of their rows (N,), if not frozen."""
    for n in range(len(points)):
        cell = sums[rows[n]]
        if cell[0] < _MOST_POINTS:
            cell[0] += 1.0
            cell[13] += elevations[n]
            cell[14] += elevations[n] * elevations[n]
            for axis in range(3):
                cell[1 + axis] += points[n, axis]
                cell[10 + axis] += views[n, axis]
            for entry in range(6):
                i, j = SYMMETRIC[entry]
                cell[4 + entry] += points[n, i] * points[n, j]


@compiled
def match_features(
    points: FloatArray, unmatched: NDArray[np.intp], is_line: bool, voxels: Voxels, sensor: FloatArray,
    has_rings: bool, found: Surfaces,
) -> int:  # fmt: skip
    """Write the line or plane of every unmatched point (N, 3) whose nearest neighbours are on one.

    `unmatched` (W,) has the indices of the points; those without a line or plane, or with a plane of an uncertain
    normal, are moved to its beginning; their number is returned. A plane that is known better takes the place of
    another. The normal of a plane faces the sensor (3,), and so did the plane when it was seen; the first of a line
    points from that to the point. With `has_rings`, planes that may be those of a single ring do not count.
    """
    left, scale = 0, 1.0 / voxels.cell_m
    around, near = np.empty(27, dtype=np.int32), np.empty(NEIGHBOURS, dtype=np.int64)
    squared = np.empty(NEIGHBOURS)
    scatter = np.empty(6)
    mean, variances, axis = np.empty(3), np.empty(3), np.empty(3)
    most_off = min(_PLANE_M, _PLANE_CELLS * voxels.cell_m)
    most_tilt = _MOST_TILT_OF_RINGS if has_rings else _MOST_TILT
    for w in range(len(unmatched)):
        ahead = points[unmatched[min(w + _PREFETCHED, len(unmatched) - 1)]]
        prefetch_around(key_at(ahead, scale), voxels.bits, voxels.table_keys, voxels.table_rows)
        n = unmatched[w]
        count = _nearest(points[n], key_at(points[n], scale), voxels, around, near, squared)
        if count >= (_LINE_VOXELS if is_line else NEIGHBOURS):
            number = _moments(points[n], near[:count], voxels.sums, mean, scatter)
            write_eigenvalues(scatter, variances)
            if is_line and variances[2] > _LINE_RATIO * variances[1]:
                thickness_m, tilt = _uncertainty(variances[1], variances[2], number, 2.0)
                if tilt < most_tilt:
                    write_eigenvector(scatter, variances[2], axis)
                    _write_line(found, n, points[n], mean, axis, thickness_m, tilt)
                    continue
            if not is_line and variances[1] > max(_PLANE_RATIO * variances[2], _FLAT_RATIO * variances[0]):
                thickness_m, tilt = _uncertainty(variances[0], variances[1], number, 3.0)
                write_eigenvector(scatter, variances[0], axis)
                cosine = _turn_to(sensor, mean, axis)
                if (
                    cosine > _LEAST_COSINE
                    and tilt < most_tilt
                    and (
                        not has_rings
                        or _spans_rings(near[:count], number, voxels.sums, variances[1], cosine, sensor, mean)
                    )
                    and _is_surface(near[:count], number, voxels.sums, mean, axis, most_off)
                ):
                    if found.counts[n] == 0 or thickness_m < found.thickness_m[n, 0]:
                        _write_plane(found, n, mean, axis, thickness_m, tilt)
                    if tilt < _CERTAIN_TILT:
                        continue
        unmatched[left] = n
        left += 1
    return left


@compiled_part
def _nearest(
    point: FloatArray, key: int, voxels: Voxels, around: Rows, near: NDArray[np.int64], squared: FloatArray
) -> int:  # fmt: skip
    """Write the rows of the nearest voxels to a point (3,), and their squared distances; return their number.

    `around` (27,) holds the rows of all.
    """
    find_around(key, voxels.bits, voxels.table_keys, voxels.table_rows, around)
    for row in around:
        prefetch(voxels.sums, row)
    count, most = 0, len(near)
    for row in around:
        if row == ABSENT:
            continue
        cell = voxels.sums[row]
        x, y, z = cell[1] / cell[0] - point[0], cell[2] / cell[0] - point[1], cell[3] / cell[0] - point[2]
        distance = x * x + y * y + z * z
        if count == most and distance >= squared[most - 1]:
            continue
        place = min(count, most - 1)
        while place > 0 and squared[place - 1] > distance:
            squared[place], near[place] = squared[place - 1], near[place - 1]
            place -= 1
        squared[place], near[place] = distance, row
        count = min(count + 1, most)
    return count


@compiled_part
def _moments(
    point: FloatArray, near: NDArray[np.int64], sums: FloatArray, mean: FloatArray, scatter: FloatArray
) -> float:
    """Write mean (3,) and covariance (6,) of the points in the nearest voxels (K,); return their number.

    Sums are taken about a point (3,) nearby, for the sake of rounding.
    """
    number = 0.0
    mean[:], scatter[:] = 0.0, 0.0
    for row in near:
        cell = sums[row]
        number += cell[0]
        for axis in range(3):
            mean[axis] += cell[1 + axis] - cell[0] * point[axis]
        for entry in range(6):
            i, j = SYMMETRIC[entry]
            crossed = point[i] * cell[1 + j] + point[j] * cell[1 + i]
            scatter[entry] += cell[4 + entry] - crossed + cell[0] * point[i] * point[j]
    for entry in range(6):
        i, j = SYMMETRIC[entry]
        scatter[entry] = scatter[entry] / number - mean[i] * mean[j] / (number * number)
    for axis in range(3):
        mean[axis] = point[axis] + mean[axis] / number
    return number


@compiled_part
def _turn_to(sensor: FloatArray, point: FloatArray, normal: FloatArray) -> float:
    """Turn the normal (3,) of a plane to the sensor (3,); the cosine of its angle to the beam to a point (3,)."""
    along = 0.0
    for i in range(3):
        along += (sensor[i] - point[i]) * normal[i]
    if along < 0.0:
        for i in range(3):
            normal[i] = -normal[i]
    return abs(along) / math.sqrt(max(squared_distance(sensor, point), 1e-12))


@compiled_part
def _is_surface(
    near: NDArray[np.int64], number: float, sums: FloatArray, mean: FloatArray, normal: FloatArray, most_off: float
) -> bool:  # fmt: skip
    """Whether all neighbours (K,) are so near to the plane through their mean, and were not seen from behind it."""
    seen = 0.0
    for row in near:
        distance = 0.0
        for i in range(3):
            distance += (sums[row, 1 + i] / sums[row, 0] - mean[i]) * normal[i]
            seen += sums[row, 10 + i] * normal[i]
        if abs(distance) >= most_off:
            return False
    return seen > -_SIDE_COSINE * number


@compiled_part
def _spans_rings(
    near: NDArray[np.int64], number: float, sums: FloatArray, width: float, cosine: float, sensor: FloatArray,
    mean: FloatArray,
) -> bool:  # fmt: skip
    """Whether the points of rings in neighbours (K,) are more than the relief along a single ring.

    Their plane has a mean (3,) and the variance `width` along it, and meets the beam at a cosine to its normal.
    """
    along_m = math.sqrt(squared_distance(sensor, mean) * max(1.0 - cosine * cosine, 0.0))
    least_m = min(_LEAST_WIDTH * along_m, _LEAST_WIDTH_M)
    is_wide = width > least_m * least_m
    if not is_wide or is_steep(cosine, 1.0):
        return is_wide
    elevation = squared = 0.0
    for row in near:
        elevation += sums[row, 13] / number
        squared += sums[row, 14] / number
    return math.sqrt(max(squared - elevation * elevation, 0.0)) * along_m > _LEAST_HEIGHT_M


@compiled_part
def _uncertainty(across: float, along: float, number: float, spent: float) -> tuple[float, float]:
    """Standard deviations of a line or plane across it, with that of its position, and of its direction.

    Of so many points with variances across and along it; the fit takes `spent` residuals.
    """
    noise = _COUNTED * _RANGE_NOISE_M * _RANGE_NOISE_M
    variance = (number * max(across, 0.0) + noise) / (max(number - spent, 0.0) + _COUNTED)
    thickness_m = math.sqrt(variance * (1.0 + _SHARED / number))
    return thickness_m, math.sqrt(variance / (number * max(along, 1e-12)))


@compiled_part
def _write_plane(
    found: Surfaces, n: int, mean: FloatArray, normal: FloatArray, thickness_m: float, tilt: float
) -> None:
    found.thickness_m[n, 0], found.tilt[n, 0] = thickness_m, tilt
    for i in range(3):
        found.points[n, i], found.normals[n, 0, i] = mean[i], normal[i]
    found.counts[n] = 1


@compiled_part
def _write_line(
    found: Surfaces, n: int, point: FloatArray, mean: FloatArray, along: FloatArray, thickness_m: float, tilt: float
) -> None:
    x, y, z = point[0] - mean[0], point[1] - mean[1], point[2] - mean[2]
    part = x * along[0] + y * along[1] + z * along[2]
    x, y, z = x - part * along[0], y - part * along[1], z - part * along[2]
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-9:  # on the line: any direction across it
        x, y, z = (0.0, along[2], -along[1]) if abs(along[0]) < 0.7 else (along[2], 0.0, -along[0])
        length = math.sqrt(x * x + y * y + z * z)
    first, second = found.normals[n, 0], found.normals[n, 1]
    first[0], first[1], first[2] = x / length, y / length, z / length
    second[0] = along[1] * first[2] - along[2] * first[1]
    second[1] = along[2] * first[0] - along[0] * first[2]
    second[2] = along[0] * first[1] - along[1] * first[0]
    for axis in range(3):
        found.points[n, axis] = mean[axis]
    for residual in range(2):
        found.thickness_m[n, residual], found.tilt[n, residual] = thickness_m, tilt
    found.counts[n] = 2


class VoxelGrid(Stateful):
    """Number, mean and covariance of the points in each voxel.

    A mean of the last mean and the new scan's, as of PCL's voxel grid, would halve the weight of earlier scans each
    time: the map would follow the sensor.
    """

    cell_m: float
    _keys: Annotated[NDArray[np.int64], Shape(None)]  # (M,) of the voxels, by row
    _sums: Annotated[FloatArray, Shape(None, 15)]  # (M, 15) see `Voxels`

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self._keys, self._sums = np.empty(0, dtype=np.int64), np.empty((0, 15))
        self._hash = VoxelHash()

    def __len__(self) -> int:
        return len(self._hash)

    @property
    def means(self) -> FloatArray:
        """(M, 3) in the world."""
        sums = self._sums[: len(self)]
        return np.asarray(sums[:, 1:4] / sums[:, :1], dtype=np.float64)

    def insert(self, points: FloatArray, views: NDArray[np.float32], elevations: FloatArray) -> None:
        """Insert points (N, 3) of the world, with unit views (N, 3) to the sensor, and elevations (N,), radians."""
        rows = self._rows_of(points)
        add_moments(points, views, elevations, rows, self._sums)

    def insert_means(self, other: "VoxelGrid") -> None:
        """Insert the voxels of another grid, with their numbers of points."""
        rows = self._rows_of(other.means)
        np.add.at(self._sums, rows, other._sums[: len(other)])

    def drop_beyond(self, centre: FloatArray, radius_m: float) -> None:
        """Drop the voxels farther than `radius_m` from `centre` (3,)."""
        near = np.flatnonzero(np.linalg.norm(self.means - centre, axis=1) < radius_m)
        self._keys, self._sums = self._keys[near], self._sums[near]
        self._hash.rebuild(self._keys)

    def state(self) -> State:
        """The voxels in the order of their rows."""
        self._resize(len(self))
        return super().state()

    def _rows_of(self, points: FloatArray) -> Rows:
        """Rows (N,) of the voxels of points (N, 3), which are made where there is none."""
        keys = point_keys(points, self.cell_m)
        known, rows = len(self), self._hash.insert(keys)
        if len(self) > len(self._keys):
            self._resize(2 * len(self))
        write_new_keys(keys, rows, known, self._keys)
        return rows

    def _resize(self, capacity: int) -> None:
        self._keys, self._sums = resized(self._keys, capacity), resized(self._sums, capacity)

    @property
    def voxels(self) -> Voxels:
        """The arrays for compiled loops."""
        return Voxels(self.cell_m, *self._hash.slots, self._sums)

    def _after_restore(self) -> None:
        self._hash = VoxelHash()
        self._hash.rebuild(self._keys)


class FeatureMatcher(Matcher):
    """Lines of edges and planes of other points of a sweep, through their nearest voxels in grids, the finest first.

    A point that has moved by a small part of a cell since it was matched keeps its line or plane.
    """

    def __init__(self, edges: list[VoxelGrid], planes: list[VoxelGrid], has_rings: bool, sweep: Sweep) -> None:
        self._edges, self._planes, self._has_rings = edges, planes, has_rings
        self._is_edge = _edges_of(sweep)
        self._matched = np.full((len(sweep), 3), np.inf)  # where the points were matched
        self.surfaces = Surfaces.none(len(sweep))

    def match(self, points: FloatArray, T_world_lidar: FloatArray) -> None:
        points, sensor = np.ascontiguousarray(points), np.array(T_world_lidar[:3, 3])
        moved = np.abs(points - self._matched).max(axis=1) > _SAME_CELLS * self._planes[0].cell_m
        self._matched[moved] = points[moved]
        self.surfaces.counts[moved] = 0
        for is_line, grids in ((True, self._edges), (False, self._planes)):
            unmatched = np.flatnonzero(moved & (self._is_edge == is_line))
            for grid in grids:
                if not len(unmatched):
                    break
                given = sensor, self._has_rings, self.surfaces
                left = match_features(points, unmatched, is_line, grid.voxels, *given)
                unmatched = unmatched[:left]


class FeatureMap(LocalMap):
    """Edges and planar points within a radius of the sensor."""

    _edges: list[VoxelGrid]
    _planes: list[VoxelGrid]
    _has_rings: bool

    def __init__(self, cells_m: CellSizes, radius_m: float) -> None:
        super().__init__(cells_m, radius_m)
        self._has_rings = False
        self._edges, self._planes = ([VoxelGrid(cell_m) for cell_m in cells_m[: COARSE + 1]] for _ in range(2))

    @property
    def grids(self) -> list[VoxelGrid]:
        return [*self._edges, *self._planes]

    def add(self, scan: SampledScan, points: FloatArray, sensor: FloatArray) -> None:
        self._has_rings = scan.has_rings
        views, is_edge = views_of(points, sensor), _edges_of(scan.sweep)
        for grids, is_kind in ((self._edges, is_edge), (self._planes, ~is_edge)):
            chosen = np.flatnonzero(is_kind)
            inserted = points.take(chosen, axis=0), views.take(chosen, axis=0), scan.elevations.take(chosen)
            for_each_grid(grids, len(chosen), VoxelGrid.insert, *inserted)
        self._count(sensor)

    def matcher(self, sweep: Sweep, level: int = 0, is_inertial: bool = False) -> FeatureMatcher:  # noqa: ARG002
        return FeatureMatcher(self._edges[level:], self._planes[level:], self._has_rings, sweep)

    def resample(self, other: "FeatureMap") -> None:
        self._has_rings = other._has_rings
        for grids, finest in ((self._edges, other._edges[0]), (self._planes, other._planes[0])):
            for grid in grids:
                grid.insert_means(finest)

    def means(self) -> FloatArray:
        return np.concatenate([self._edges[1].means, self._planes[1].means])

    def vertical(self) -> FloatArray:
        sensor = np.zeros(3) if self._centre is None else self._centre
        normals, spread_m = self.coarse_planes(self._planes[-1].means, sensor)
        return vertical_of(normals[np.isfinite(spread_m)])

    def coarse_planes(self, points: FloatArray, sensor: FloatArray) -> tuple[FloatArray, FloatArray]:
        found, unmatched = Surfaces.none(len(points)), np.arange(len(points))
        voxels = self._planes[-1].voxels
        given = np.array(sensor), self._has_rings, found
        match_features(np.ascontiguousarray(points), unmatched, False, voxels, *given)
        return found.normals[:, 0], np.where(found.counts > 0, found.thickness_m[:, 0], np.inf)


def _edges_of(sweep: Sweep) -> NDArray[np.bool_]:
    """Which points (N,) of a sweep are edges."""
    return np.zeros(len(sweep), dtype=np.bool_) if sweep.kinds is None else sweep.kinds == EDGE
