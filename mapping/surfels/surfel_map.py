"""Local map of surfels in several sizes of cells, and the point-to-plane correspondences of a scan with it.

The columns of surfels (M, 15) are as in `mapping.surfels.grid`.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import lever_scale
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.gauss_newton import point_to_plane_jacobian
from lidarslam.mapping.registration.local_map import (
    COARSE,
    LocalMap,
    Matcher,
    Surfaces,
    for_each_grid,
    vertical_of,
)
from lidarslam.mapping.registration.sampled_scan import MOST_LEVELS, CellSizes, SampledScan, sizes_of_cells
from lidarslam.mapping.surfels.grid import IS_PLANE, NORMAL, SurfelGrid
from lidarslam.mapping.surfels.surfel_kernels import Arrays, is_steep, look_up, refresh, turn_to_sensor, views_of
from lidarslam.mapping.surfels.voxel_hash import key_at, require_reach

# A single ring bent around a corner spans a plane too, that of its own rays. A plane seen at a grazing angle counts
# only when its points differ so much in height across the rings.
_LEAST_HEIGHT_M = 0.05
# A plane swept by a single ring as the sensor moves is tilted by attitude errors between scans, which it then confirms.
# It counts up to this distance along the plane, in standard deviations of its width: 0.1 degrees tilt it by 0.2 rad.
_RING_WIDTHS = 114.0
_FEWEST_POINTS = 6
# The plane of a surfel is as uncertain as if this many of its points counted as one: neighbours share their errors.
_SHARED = 120.0
# Largest cosine between the axis of a compact object and the direction from ring to ring.
_MOST_ACROSS = 0.5
# Largest extent of a compact object along an axis, in cells: evenly filled, a surfel has a standard deviation of 0.8.
_COMPACT = 0.5
# Standard deviation of a normal from which a coarser plane is asked for: in grass, the finest cells have normals of any
# direction.
_CERTAIN_TILT = 0.02
# Columns of surfels: where the normal begins, and the least standard deviation.
_NORMAL, _SPREAD = 3, 9
# No cell has this key.
_NOWHERE = -1
# Scans between two removals of stray cells.
_TIDIED_AFTER = 500
# Spread of the elevations of points that were seen from many places.
_ANY_HEIGHT_RAD = 0.2
# Cells of a single scan's surfels, in cells of the map; points whose leverage exceeds the mean by the factor constrain
# a direction that few others do.
_SCAN_CELLS, _MANY_TIMES, _RIDGE = 2.0, 10.0, 1e-4
# A direction that few walls are parallel to.
_UNEVEN = np.array([0.46, 0.29, 0.84])


@compiled
def match_planes(
    points: FloatArray, unmatched: NDArray[np.intp], rows: NDArray[np.int32], surfels: FloatArray, sensor: FloatArray,
    spread_m: FloatArray, certain_tilt: float, found: Surfaces,
) -> int:  # fmt: skip
    """Write the surface of every unmatched point (N, 3) whose cell has a plane, unless it has a better one already.

    A better one is known better and its points are spread less: across steps, a coarse plane's are spread more.
    `unmatched` (W,) has the indices of the points, `rows` (N,) those of their cells in `surfels` (M, 15), or -1. Points
    without a plane, or with one whose normal has a standard deviation of `certain_tilt` and more, are moved to the
    beginning of `unmatched`; their number is returned. `spread_m` (N,), of each plane's points across it, is written.
    """
    left = 0
    for w in range(len(unmatched)):
        n = unmatched[w]
        row = rows[n]
        if row >= 0:
            p = surfels[row]
            x, y, z = points[n, 0] - sensor[0], points[n, 1] - sensor[1], points[n, 2] - sensor[2]
            distance = math.sqrt(x * x + y * y + z * z)
            along = x * p[3] + y * p[4] + z * p[5]
            is_near = p[12] < 0.0 or distance * distance - along * along < (_RING_WIDTHS * p[10]) ** 2
            faced, behind = is_near and is_steep(-along, distance), is_steep(along, distance)
            if p[14] > 0.0 and not behind and (p[12] * distance > _LEAST_HEIGHT_M or faced):
                tilt = p[9] / (max(p[10], 1e-9) * math.sqrt(p[13]))
                spread = p[9] * math.sqrt(p[13] / (p[13] - 3.0))  # three points make the plane
                if found.counts[n] == 0 or (spread < spread_m[n] and _thickness_m(p, 0) < found.thickness_m[n, 0]):
                    found.counts[n], spread_m[n] = 0, spread
                    _write(found, n, p, 0, p[3], p[4], p[5], tilt)
                if tilt < certain_tilt:
                    continue
        unmatched[left] = n
        left += 1
    return left


@compiled_part
def match_compact(
    points: FloatArray, unmatched: NDArray[np.intp], rows: NDArray[np.int32], surfels: FloatArray,
    T_world_lidar: FloatArray, largest_m: float, found: Surfaces,
) -> None:  # fmt: skip
    """Write the surfaces of unmatched points whose surfel is no plane: across its short axes, through its mean.

    The mean of a surfel is a point on the object only where the object ends within it, not in grass. Across the rings a
    surfel is as short as its rings are close: these axes are left out, or the map would follow the sensor.

    `unmatched` (W,) has the indices of the points (N, 3), `rows` (N,) the cells of all points, or -1. Axes are short
    below a standard deviation of `largest_m`.
    """
    sensor = T_world_lidar[:3, 3]
    ax, ay, az = T_world_lidar[0, 2], T_world_lidar[1, 2], T_world_lidar[2, 2]
    for n in unmatched:
        if rows[n] < 0 or found.counts[n]:
            continue
        p = surfels[rows[n]]
        x, y, z = points[n, 0] - sensor[0], points[n, 1] - sensor[1], points[n, 2] - sensor[2]
        distance = math.sqrt(x * x + y * y + z * z)
        if p[14] > 0.0 or p[13] < _FEWEST_POINTS or not p[12] * distance > _LEAST_HEIGHT_M:
            continue
        distance = max(distance, 1e-9)
        x, y, z = x / distance, y / distance, z / distance
        # From one ring to the next: the axis of rotation, less its part along the ray.
        along = x * ax + y * ay + z * az
        rx, ry, rz = ax - along * x, ay - along * y, az - along * z
        length = max(math.sqrt(rx * rx + ry * ry + rz * rz), 1e-9)
        for axis in range(3):
            u, v, w = _axis(p, axis)
            across_rings = abs(u * rx + v * ry + w * rz) / length
            if p[9 + axis] < largest_m and across_rings < _MOST_ACROSS:
                _write(found, n, p, axis, u, v, w, 0.0)


@compiled_part
def _axis(p: FloatArray, axis: int) -> tuple[float, float, float]:
    """A principal axis of a surfel (15,), by ascending extent."""
    if axis == 0:
        return p[3], p[4], p[5]
    if axis == 1:
        return p[7] * p[5] - p[8] * p[4], p[8] * p[3] - p[6] * p[5], p[6] * p[4] - p[7] * p[3]
    return p[6], p[7], p[8]


@compiled_part
def _thickness_m(surfel: FloatArray, axis: int) -> float:
    """Standard deviation of a surfel (15,) along a principal axis, with that of its position."""
    return float(surfel[9 + axis] * math.sqrt(1.0 + _SHARED / surfel[13]))


@compiled_part
def _write(found: Surfaces, n: int, surfel: FloatArray, axis: int, u: float, v: float, w: float, tilt: float) -> None:
    residual = found.counts[n]
    for i in range(3):
        found.points[n, i] = surfel[i]
    normal = found.normals[n, residual]
    normal[0], normal[1], normal[2] = u, v, w
    found.thickness_m[n, residual], found.tilt[n, residual] = _thickness_m(surfel, axis), tilt
    found.counts[n] += 1


@compiled
def match_surfels(
    points: FloatArray, T_world_lidar: FloatArray, grids: tuple[Arrays, ...], count: int, keys: NDArray[np.int64],
    spread_m: FloatArray, certain_tilt: float, found: Surfaces,
) -> None:  # fmt: skip
    """Write the surfaces of those of the points (N, 3) that have left their cells in the first of `count` grids.

    `keys` (N,) of these cells are written. Planes as of `match_planes`, of the sides that face the sensor, from one
    grid after another; where none has one, the compact object in the first.
    """
    sensor, unmatched, left = T_world_lidar[:3, 3].copy(), np.empty(len(points), dtype=np.intp), 0
    scale = 1.0 / grids[0][0].cell_m
    for n in range(len(points)):
        key = key_at(points[n], scale)
        if key != keys[n]:
            keys[n], found.counts[n], unmatched[left] = key, 0, n
            left += 1
    rows, first = np.empty(len(points), dtype=np.int32), np.empty(len(points), dtype=np.int32)
    for g in range(count):
        cells, surfels, counts = grids[g]
        looked_up, at = points[unmatched[:left]], np.empty(left, dtype=np.int32)
        look_up(looked_up, cells, at)
        turn_to_sensor(looked_up, sensor, cells, surfels, counts, at)
        refresh(at, cells, surfels, counts)
        for w in range(left):
            rows[unmatched[w]] = at[w]
        if g == 0:
            first[:] = rows
        left = match_planes(points, unmatched[:left], rows, surfels, sensor, spread_m, certain_tilt, found)
    largest_m = _COMPACT * grids[0][0].cell_m
    match_compact(points, unmatched[:left], first, grids[0][1], T_world_lidar, largest_m, found)


@compiled
def planes_in(rows: NDArray[np.int32], surfels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals (N, 3), and standard deviations (N,) along them, of the planes in cells; infinite where there is none."""
    normals, spread_m = np.zeros((len(rows), 3)), np.full(len(rows), np.inf)
    for n in range(len(rows)):
        if rows[n] >= 0 and surfels[rows[n], IS_PLANE] > 0.0:
            spread_m[n] = surfels[rows[n], _SPREAD]
            for i in range(3):
                normals[n, i] = surfels[rows[n], _NORMAL + i]
    return normals, spread_m


class SurfelMatcher(Matcher):
    """Surfels of the cells that N points lie in, of grids that do not change meanwhile, the finest first.

    A point that has stayed in its cell keeps its surface: once an iteration moves by a small part of a cell, few are
    looked up again. With `keeps_finest`, planes of uncertain normals are kept: in a young map, coarser ones are of a
    few rings, and contradict an IMU's prediction.
    """

    def __init__(self, grids: Sequence[SurfelGrid], count: int, keeps_finest: bool = False) -> None:
        self._grids, self._certain_tilt = grids, np.inf if keeps_finest else _CERTAIN_TILT
        arrays = [grid.arrays for grid in grids]
        self._arrays = (*arrays, *arrays[-1:] * (MOST_LEVELS - len(grids)))  # of one type, to be compiled once
        self._keys = np.full(count, _NOWHERE, dtype=np.int64)  # of the points' cells
        self._spread_m = np.empty(count)  # standard deviation of the points of each plane from it
        self.surfaces = Surfaces.none(count)

    def match(self, points: FloatArray, T_world_lidar: FloatArray) -> None:
        points, T = np.ascontiguousarray(points), np.ascontiguousarray(T_world_lidar)
        found = self._keys, self._spread_m, self._certain_tilt, self.surfaces
        match_surfels(points, T, self._arrays, len(self._grids), *found)


class SurfelMap(LocalMap):
    """Surfels within a radius of the sensor.

    A point corresponds to the plane of the finest grid that has one in its cell; where none has, to the middle of a
    compact object in the finest grid, along the axes of small extent.
    """

    _grids: list[SurfelGrid]

    def __init__(self, cells_m: CellSizes, radius_m: float) -> None:
        super().__init__(cells_m, radius_m)
        self._grids = [SurfelGrid(cell_m) for cell_m in cells_m]

    @property
    def grids(self) -> list[SurfelGrid]:
        return self._grids

    @classmethod
    def of_cloud(cls, points: FloatArray, normals: FloatArray, cell_m: float, radius_m: float) -> "SurfelMap":
        """The surfels of points (N, 3) of the world whose normals (N, 3) face the side that was seen.

        InputError where points lie beyond the reach of the cells.
        """
        require_reach(points, cell_m)
        surfel_map = cls(sizes_of_cells(cell_m), radius_m)
        # No plane of a merged map is that of a single ring.
        elevations = np.where(np.arange(len(points)) % 2, _ANY_HEIGHT_RAD, -_ANY_HEIGHT_RAD)
        # The two sides of a thin wall after one another: the second is known by its view then.
        faces_up = normals @ _UNEVEN > 0.0
        for side in (faces_up, ~faces_up):
            surfel_map.insert_seen(points[side], elevations[side], normals[side])
        return surfel_map

    def add(self, scan: SampledScan, points: FloatArray, sensor: FloatArray) -> None:
        self.insert(points, scan.elevations, sensor)

    def insert(self, points: FloatArray, elevations: FloatArray, sensor: FloatArray) -> None:
        """Insert a scan: points (N, 3) of the world with elevations (N,), radians, seen from a position (3,)."""
        self.insert_seen(points, elevations, views_of(points, sensor))
        self._count(sensor)
        if self.scans % _TIDIED_AFTER == 0:
            for grid in self._grids:
                grid.tidy()

    def insert_seen(
        self, points: FloatArray, elevations: FloatArray, views: NDArray[np.floating[Any]], weight: float = 1.0
    ) -> None:
        """Insert points (N, 3) of the world, with elevations (N,), seen from along views (N, 3), unit length.

        Each point counts `weight` times.
        """
        for_each_grid(self._grids, len(points), SurfelGrid.insert, points, elevations, views, weight)

    def matcher(self, sweep: Sweep, level: int = 0, is_inertial: bool = False) -> SurfelMatcher:
        return SurfelMatcher(self._grids[level:], len(sweep), is_inertial and self.is_young)

    def vertical(self) -> FloatArray:
        surfels = self._grids[-1].surfels(np.arange(len(self._grids[-1]), dtype=np.int32))
        return vertical_of(surfels[surfels[:, IS_PLANE] > 0.0, NORMAL])

    def coarse_planes(self, points: FloatArray, sensor: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = self._grids[COARSE].find(points, np.array(sensor))
        return planes_in(rows, self._grids[COARSE].refreshed(rows))

    def means(self) -> FloatArray:
        return self._grids[1].means()

    def resample(self, other: "SurfelMap") -> None:
        samples = other.grids[0].samples()
        for grid in self._grids:
            grid.insert_samples(*samples)


def constraining_points(points: FloatArray, elevations: FloatArray, cell_m: float, most: int) -> NDArray[np.intp]:
    """Indices of the at most `most` points (N, 3) with by far the most leverage on a scan's registration, ascending.

    The few points on the faces of boxes along a corridor determine its length, and an even sample has hardly any of
    them. After Gelfand et al., "Geometrically Stable Sampling for the ICP Algorithm" (3DIM 2003), which sorts points by
    each eigenvector of the information matrix; here by their statistical leverage, the same for all directions at once.
    The points, in the LiDAR frame, have elevations (N,) above the sensor's equator, radians.
    """
    points, origin = np.ascontiguousarray(points), np.zeros(3)
    grid = SurfelGrid(_SCAN_CELLS * cell_m)
    grid.insert(points, elevations, views_of(points, origin))
    rows, surfaces = grid.find(points), Surfaces.none(len(points))
    spread_m = np.empty(len(points))
    match_planes(points, np.arange(len(points)), rows, grid.refreshed(rows), origin, spread_m, np.inf, surfaces)
    planar = np.flatnonzero(surfaces.counts)
    if not len(planar):
        return planar
    on_planes, normals = points.take(planar, axis=0), surfaces.normals[planar, 0]
    lever_m = float(np.sqrt(np.einsum("ij,ij->i", on_planes, on_planes).mean()))
    jacobian = point_to_plane_jacobian(on_planes, normals) / lever_scale(lever_m)
    information = jacobian.T @ jacobian / len(planar) + _RIDGE * np.eye(6)
    leverage = np.einsum("ij,ij->i", jacobian @ np.linalg.inv(information), jacobian)
    eligible = np.flatnonzero(leverage > _MANY_TIMES * 6.0)
    chosen = eligible[np.argsort(leverage[eligible])[::-1][:most]]
    return np.sort(planar[chosen])
