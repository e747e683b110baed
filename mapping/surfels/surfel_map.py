"""The map around the sensor that scans are registered to: planes at several sizes of cells, and lines."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved, State
from mapping.surfels.cell_kernels import write_views
from mapping.surfels.grid import SurfelGrid
from mapping.surfels.match_kernels import Bodies, Pulls, pull_to_bodies, pull_to_planes

# Sizes of the grids, in cells: the finest that shows a plane decides, the coarser reach farther.
LEVELS = (1, 2, 4)
# A patch of three cells filled evenly has a standard deviation of 0.8 cells along each axis.
_SHORT = 0.5
# Memory is bounded by forgetting what is far away, now and then rather than at every scan.
_FORGET_AFTER = 0.1
# After so many scans the grids are tidied.
_TIDIED_AFTER = 500
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


class LocalMap:
    """Planes and lines within a radius of the sensor."""

    def __init__(self, cell_m: float, radius_m: float) -> None:
        self.cell_m = cell_m
        self._radius_m = radius_m
        self._planes = [SurfelGrid(cell_m * level) for level in LEVELS]
        self._centre: FloatArray | None = None
        self._scans = 0

    def __len__(self) -> int:
        """How many cells are held, all grids together."""
        return sum(len(grid) for grid in self._planes)

    def state(self) -> State:
        """All of it."""
        return {
            "cell_m": self.cell_m,
            "radius_m": self._radius_m,
            "planes": [grid.state() for grid in self._planes],
            "centre": self._centre,
            "scans": self._scans,
        }

    @classmethod
    def restored(cls, saved: Saved) -> "LocalMap":
        """The map with a state."""
        restored = cls(saved.number("cell_m"), saved.number("radius_m"))
        restored._planes = [SurfelGrid.restored(grid) for grid in saved.parts("planes")]
        if len(restored._planes) != len(LEVELS):
            raise saved.refuse(f"{len(restored._planes)} grids of planes instead of {len(LEVELS)}")
        restored._centre = saved.optional_array("centre", (3,))
        restored._scans = saved.integer("scans")
        return restored

    def add(self, planes: FloatArray, elevations: FloatArray, sensor: FloatArray) -> None:
        """Add a scan.

        Args:
            planes: (N, 3) points, in the world.
            elevations: (N,) the angles above the sensor's equator that they were seen at, radians.
            sensor: (3,) where they were seen from.
        """
        views = _views(planes, sensor)
        for grid in self._planes:
            grid.add(planes, elevations, views)
        if self._centre is None:
            self._centre = sensor
        if float(np.linalg.norm(sensor - self._centre)) > _FORGET_AFTER * self._radius_m:
            self._centre = sensor
            for grid in self._planes:
                grid.forget_beyond(sensor, self._radius_m)
        self._scans += 1
        if self._scans % _TIDIED_AFTER == 0:
            for grid in self._planes:
                grid.tidy()

    def match_planes(self, points: FloatArray, T_world_lidar: FloatArray, first_level: int = 0) -> Matches:
        """For points (N, 3) of the world, seen from a pose (4, 4), the plane in the finest grid that shows one.

        Grids finer than `first_level` are left out, for points that are not yet where they belong.
        """
        points = np.ascontiguousarray(points)
        pulls, count = _room_for(3 * len(points)), 0
        waiting, bodies = np.arange(len(points)), None
        sensor = np.array(T_world_lidar[:3, 3])
        for grid in self._planes[first_level:]:
            rows = grid.look_up(points.take(waiting, axis=0), sensor)
            patches = grid.all_patches(rows)
            room = Bodies(np.empty(len(waiting), dtype=np.intp), np.empty(len(waiting), dtype=np.int32))
            count, left, others = pull_to_planes(points, waiting, rows, patches, sensor, pulls, count, room)
            waiting = waiting[:left]
            if bodies is None:  # what is no plane in the finest grid, and in no other
                bodies, finest = Bodies(room.number[:others], room.rows[:others]), patches
        if bodies is not None:
            waits = np.zeros(len(points), dtype=np.bool_)
            waits[waiting] = True
            T, short_m = np.ascontiguousarray(T_world_lidar), _SHORT * self._planes[first_level].cell_m
            count = pull_to_bodies(points, waits, bodies, finest, T, short_m, pulls, count)
        index, towards, normals, thickness_m, tilt = pulls
        return Matches(index[:count], towards[:count], normals[:count], thickness_m[:count], tilt[:count])

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
        other._centre, other._scans = self._centre, self._scans
        samples = self._planes[0].samples()
        for grid in other._planes:
            grid.add_samples(*samples)
        return other


def _views(points: FloatArray, sensor: FloatArray) -> NDArray[np.float32]:
    """Unit directions (N, 3) from points (N, 3) to the sensor (3,)."""
    views = np.empty((len(points), 3), dtype=np.float32)
    write_views(np.ascontiguousarray(points), np.ascontiguousarray(sensor), views)
    return views


def _room_for(count: int) -> Pulls:
    vectors = np.empty((2, count, 3))
    numbers = np.empty((2, count))
    return Pulls(np.empty(count, dtype=np.intp), *vectors, *numbers)
