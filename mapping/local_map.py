"""The map around the sensor that scans are registered to: planes at several sizes of cells, and lines."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from mapping.patches import FEWEST_POINTS, PatchTable
from mapping.surfel_grid import SurfelGrid
from mapping.voxel_table import ABSENT

# Sizes of the grids, in cells: the finest that shows a plane decides, the coarser reach farther.
LEVELS = (1, 2, 4)
# A single ring bent around a corner spans a plane too, the one of its own rays. A plane that holds the rays it was seen
# by, being seen at a flatter angle than asin of the first, counts only when the rays differ in height by the second.
_LEAST_SINE = 0.17
_LEAST_HEIGHT_M = 0.05
# A patch of three cells filled evenly has a standard deviation of 0.8 cells along each axis.
_SHORT = 0.5
_MOST_ACROSS = 0.5
# Memory is bounded by forgetting what is far away, now and then rather than at every scan.
_FORGET_AFTER = 0.1
# A sensor is tilted by less than this from the vertical, as a cosine, when it first looks.
_LEAST_COSINE_UP = 0.7


@dataclass(frozen=True, eq=False)
class Matches:
    """M pulls, each of one point towards a surface along one direction; a line pulls its point along two.

    Attributes:
        index: (M,) which point.
        points: (M, 3) on the surface, in the world.
        normals: (M, 3) unit, the direction.
        thickness_m: (M,) standard deviation of the surface along it.
        tilt: (M,) standard deviation of the direction itself, radians.
    """

    index: NDArray[np.intp]
    points: FloatArray
    normals: FloatArray
    thickness_m: FloatArray
    tilt: FloatArray

    def __len__(self) -> int:
        return len(self.index)

    def residuals(self, world: FloatArray) -> FloatArray:
        """How far (M,) the matched points, at (M, 3) of the world, lie off their surfaces, signed."""
        return np.asarray(np.einsum("ij,ij->i", world - self.points, self.normals), dtype=np.float64)

    def one_each(self) -> "Matches":
        """The first pull of every point, that across its surface."""
        index, first = np.unique(self.index, return_index=True)
        return Matches(index, self.points[first], self.normals[first], self.thickness_m[first], self.tilt[first])

    @classmethod
    def join(cls, parts: Sequence["Matches"]) -> "Matches":
        """All of them after one another."""
        return cls(
            np.concatenate([part.index for part in parts]),
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate([part.thickness_m for part in parts]),
            np.concatenate([part.tilt for part in parts]),
        )


class LocalMap:
    """Planes and lines within a radius of the sensor."""

    def __init__(self, cell_m: float, radius_m: float) -> None:
        self.cell_m = cell_m
        self._radius_m = radius_m
        self._planes = [SurfelGrid(cell_m * level) for level in LEVELS]
        self._lines = SurfelGrid(cell_m * LEVELS[1])
        self._centre: FloatArray | None = None

    def __len__(self) -> int:
        """How many cells are held, all grids together."""
        return sum(len(grid) for grid in (*self._planes, self._lines))

    def add(self, planes: FloatArray, elevations: FloatArray, edges: FloatArray, sensor: FloatArray) -> None:
        """Add a scan.

        Args:
            planes: (N, 3) points, in the world.
            elevations: (N,) the angles above the sensor's equator that they were seen at, radians.
            edges: (E, 3) points on edges, in the world.
            sensor: (3,) where they were seen from.
        """
        for grid in self._planes:
            grid.add(planes, elevations)
        self._lines.add(edges, np.zeros(len(edges)))
        if self._centre is None:
            self._centre = sensor
        if float(np.linalg.norm(sensor - self._centre)) > _FORGET_AFTER * self._radius_m:
            self._centre = sensor
            for grid in (*self._planes, self._lines):
                grid.forget_beyond(sensor, self._radius_m)

    def match_planes(self, points: FloatArray, T_world_lidar: FloatArray, first_level: int = 0) -> Matches:
        """For points (N, 3) of the world, seen from a pose (4, 4), the plane in the finest grid that shows one.

        Grids finer than `first_level` are left out, for points that are not yet where they belong.
        """
        sensor, spin_axis = T_world_lidar[:3, 3], T_world_lidar[:3, 2]
        waiting = np.arange(len(points))
        parts = []
        bodies: tuple[NDArray[np.intp], PatchTable, FloatArray] | None = None
        for grid in self._planes[first_level:]:
            there = points.take(waiting, axis=0)
            rows = grid.look_up(there)
            occupied = np.flatnonzero(rows != ABSENT)
            patches = grid.patches(rows[occupied])
            views = there.take(occupied, axis=0) - sensor
            ranges = np.sqrt(np.einsum("ij,ij->i", views, views))
            several_rings = patches.elevation_spreads * ranges > _LEAST_HEIGHT_M
            chosen = np.flatnonzero(patches.is_plane & (several_rings | _are_faced(patches, views, ranges)))
            parts.append(_pull_to_planes(waiting[occupied[chosen]], patches.select(chosen)))
            if bodies is None:
                body = np.flatnonzero(~patches.is_plane & several_rings & (patches.counts >= FEWEST_POINTS))
                bodies = waiting[occupied[body]], patches.select(body), views.take(body, axis=0)
            still = np.ones(len(waiting), dtype=np.bool_)
            still[occupied[chosen]] = False
            waiting = waiting[still]
        if bodies is not None:
            left = np.flatnonzero(np.isin(bodies[0], waiting, assume_unique=True))
            across_rings = _across_rings(bodies[2].take(left, axis=0), spin_axis)
            short_m = _SHORT * self._planes[first_level].cell_m
            parts.append(_pull_to_bodies(bodies[0][left], bodies[1].select(left), across_rings, short_m))
        return Matches.join(parts)

    def match_lines(self, points: FloatArray) -> Matches:
        """For edge points (N, 3) of the world the lines they lie on."""
        rows = self._lines.look_up(points)
        occupied = np.flatnonzero(rows != ABSENT)
        patches = self._lines.patches(rows[occupied])
        chosen = np.flatnonzero(patches.is_line)
        return _pull_to_lines(occupied[chosen], patches.select(chosen))

    def vertical(self) -> FloatArray:
        """The direction (3,) that floors and ceilings near the sensor face; the world's z axis when there are none."""
        grid = self._planes[-1]
        patches = grid.patches(np.arange(len(grid), dtype=np.int32))
        normals = patches.normals[patches.is_plane & (np.abs(patches.normals[:, 2]) > _LEAST_COSINE_UP)]
        mean = (normals * np.sign(normals[:, 2:])).sum(axis=0)
        length = float(np.linalg.norm(mean))
        return np.array([0.0, 0.0, 1.0]) if length == 0.0 else np.asarray(mean / length, dtype=np.float64)

    def surface(self) -> FloatArray:
        """Points (M, 3) of the world on what is held, one in each of the cells of the middle size."""
        return self._planes[1].means()

    def resized(self, cell_m: float) -> "LocalMap":
        """The same map in cells of another size, made of the surfaces in the finest of these."""
        other = LocalMap(cell_m, self._radius_m)
        other._centre = self._centre
        points, elevations = self._planes[0].samples()
        for grid in other._planes:
            grid.add(points, elevations)
        other._lines.add(*self._lines.samples())
        return other


def _are_faced(patches: PatchTable, views: FloatArray, ranges: FloatArray) -> NDArray[np.bool_]:
    """Which patches (N,), seen along `views` (N, 3) of lengths `ranges` (N,), do not hold the rays they are seen by."""
    facing = np.abs(np.einsum("ij,ij->i", views, patches.normals))
    return np.asarray(facing > _LEAST_SINE * ranges, dtype=np.bool_)


def _across_rings(views: FloatArray, spin_axis: FloatArray) -> FloatArray:
    """Unit directions (N, 3) from one ring to the next at points seen along `views` (N, 3)."""
    u = views / np.maximum(np.sqrt(np.einsum("ij,ij->i", views, views)), 1e-9)[:, None]
    across = spin_axis - (u @ spin_axis)[:, None] * u
    return np.asarray(across / np.maximum(np.linalg.norm(across, axis=1), 1e-9)[:, None], dtype=np.float64)


def _pull_to_bodies(index: NDArray[np.intp], patches: PatchTable, across_rings: FloatArray, short_m: float) -> Matches:
    """Towards the middle of the patch along those of its axes that it is short along.

    Where the surface goes on beyond the patch, as grass does, the patch's middle is no place on it. Across the rings,
    a patch is as short as the few rings on it are close, wherever the sensor is: the map would follow the sensor.
    """
    spreads = patches.spreads_m
    axes = (patches.normals, np.cross(patches.directions, patches.normals), patches.directions)
    parts = []
    for column, axis in enumerate(axes):
        along_rings = np.abs(np.einsum("ij,ij->i", axis, across_rings)) < _MOST_ACROSS
        short = np.flatnonzero((spreads[:, column] < short_m) & along_rings)
        thickness_m = spreads[short, column]
        parts.append(Matches(index[short], patches.points[short], axis[short], thickness_m, np.zeros(len(short))))
    return Matches.join(parts)


def _pull_to_planes(index: NDArray[np.intp], patches: PatchTable) -> Matches:
    spreads = patches.spreads_m
    tilt = spreads[:, 0] / (np.maximum(spreads[:, 1], 1e-9) * np.sqrt(patches.counts))
    return Matches(index, patches.points, patches.normals, spreads[:, 0], tilt)


def _pull_to_lines(index: NDArray[np.intp], patches: PatchTable) -> Matches:
    """Two directions across each line: the one it is thinnest in, and the other."""
    spreads = patches.spreads_m
    tilt = spreads[:, 1] / (np.maximum(spreads[:, 2], 1e-9) * np.sqrt(patches.counts))
    across = np.cross(patches.directions, patches.normals)
    return Matches(
        np.concatenate([index, index]),
        np.concatenate([patches.points, patches.points]),
        np.concatenate([patches.normals, across]),
        np.concatenate([spreads[:, 0], spreads[:, 1]]),
        np.concatenate([tilt, tilt]),
    )
