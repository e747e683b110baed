"""The local map that scans are registered to: surfels, or LOAM's edges and planes; and the surfaces found in it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Shape, Stateful
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.sampled_scan import CellSizes, SampledScan

Grid = TypeVar("Grid")

# The resolution that registrations of uncertain predictions begin with. A coarser one only has the surfaces of points
# without any other.
COARSE = 2
# In a map of fewer scans, planes are of few points: their normals are uncertain.
_YOUNG_SCANS = 5
# Surfaces within this cosine of the z axis are floors or ceilings.
_LEVEL_COSINE = 0.7
# Cells beyond the radius are dropped each time the sensor has moved by this share of it.
_FORGET_AFTER = 0.2
# Points or cells from which a second thread gains more time than it takes to begin.
_WORTH_A_THREAD = 10_000


class Surfaces(NamedTuple):
    """The surfaces that N points correspond to, a row for each point."""

    # (N,) residuals of the point: 1 with a plane, 2 with a line, up to 3 with a compact object; 0 without a surface
    counts: NDArray[np.int32]
    points: FloatArray  # (N, 3) on the surface, in the world
    normals: FloatArray  # (N, 3, 3) unit, in the world, one for each residual
    thickness_m: FloatArray  # (N, 3) standard deviation of the surface along each, with that of its plane
    tilt: FloatArray  # (N, 3) standard deviation of each normal, radians

    @classmethod
    def none(cls, count: int) -> "Surfaces":
        """No surface for any point."""
        shape = (count, 3)
        return cls(
            np.zeros(count, dtype=np.int32), np.empty(shape), np.empty((*shape, 3)), np.empty(shape), np.empty(shape)
        )


@dataclass(frozen=True, eq=False)
class Correspondences:
    """M residuals of points with surfaces, each along one direction."""

    index: NDArray[np.intp]  # (M,) of the point
    points: FloatArray  # (M, 3) on the surface, in the world
    normals: FloatArray  # (M, 3) unit, in the world
    thickness_m: FloatArray  # (M,) standard deviation of the surface along the normal
    tilt: FloatArray  # (M,) standard deviation of the normal, radians

    def __len__(self) -> int:
        return len(self.index)

    def residuals(self, world: FloatArray) -> FloatArray:
        """Signed distances (M,) of the matched points, at (M, 3) of the world, from their surfaces."""
        return np.asarray(np.einsum("ij,ij->i", world - self.points, self.normals), dtype=np.float64)


@compiled
def _gather(found: Surfaces) -> tuple[NDArray[np.intp], FloatArray, FloatArray, FloatArray, FloatArray]:
    """The residuals of surfaces, in the order of the fields of `Correspondences`."""
    count, m = found.counts.sum(), 0
    index, points, normals = np.empty(count, dtype=np.intp), np.empty((count, 3)), np.empty((count, 3))
    thickness_m, tilt = np.empty(count), np.empty(count)
    for n in range(len(found.counts)):
        for k in range(found.counts[n]):
            index[m], thickness_m[m], tilt[m] = n, found.thickness_m[n, k], found.tilt[n, k]
            for i in range(3):
                points[m, i], normals[m, i] = found.points[n, i], found.normals[n, k, i]
            m += 1
    return index, points, normals, thickness_m, tilt


class Matcher(ABC):
    """Finds the surfaces that N points correspond to, at one pose after another; valid until the map changes."""

    surfaces: Surfaces

    @abstractmethod
    def match(self, points: FloatArray, T_world_lidar: FloatArray) -> None:
        """Update the surfaces for points (N, 3) of the world, seen from a pose (4, 4)."""

    def correspondences(self) -> Correspondences:
        """A residual per row, in the order of the points; of each point first the one across it."""
        return Correspondences(*_gather(self.surfaces))


class LocalMap(Stateful, ABC):
    """Surfaces within a radius of the sensor, in several resolutions.

    A point's correspondence is the surface of the finest one that has one.
    """

    cells_m: CellSizes
    scans: int  # number of inserted scans
    _radius_m: float
    _centre: Annotated[FloatArray, Shape(3)] | None

    def __init__(self, cells_m: CellSizes, radius_m: float) -> None:
        self.cells_m, self.scans, self._radius_m, self._centre = cells_m, 0, radius_m, None

    def __len__(self) -> int:
        """Number of cells of all resolutions."""
        return sum(map(len, self.grids))

    @property
    def cell_m(self) -> float:
        """Edge of the finest cells."""
        return self.cells_m[0]

    @property
    @abstractmethod
    def grids(self) -> Sequence[Any]:
        """Its cells of all resolutions, each with `__len__` and `drop_beyond`."""

    @property
    def is_young(self) -> bool:
        """Whether so few scans were inserted that normals are uncertain; a map that was given has none."""
        return 0 < self.scans < _YOUNG_SCANS

    @abstractmethod
    def add(self, scan: SampledScan, points: FloatArray, sensor: FloatArray) -> None:
        """Insert the points of a scan, at (N, 3) of the world, seen from a position (3,)."""

    @abstractmethod
    def matcher(self, sweep: Sweep, level: int = 0, is_inertial: bool = False) -> Matcher:
        """Finds correspondences of the points of a sweep; valid until the map changes.

        The level is the finest resolution that is used, for points that may be off by more than a cell.
        """

    @abstractmethod
    def resample(self, other: Self) -> None:
        """Fill an empty map with what another one, of other cells, holds."""

    def resized(self, cells_m: CellSizes) -> Self:
        """The map in cells of other sizes; the map itself for its own sizes."""
        if cells_m == self.cells_m:
            return self
        other = type(self)(cells_m, self._radius_m)
        other._centre, other.scans = self._centre, self.scans
        other.resample(self)
        return other

    @abstractmethod
    def means(self) -> FloatArray:
        """Points (M, 3) of the map in the middle resolution, in the world."""

    @abstractmethod
    def vertical(self) -> FloatArray:
        """Unit normal (3,) of floors and ceilings near the sensor, by `vertical_of` the coarsest planes."""

    @abstractmethod
    def coarse_planes(self, points: FloatArray, sensor: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Planes in the coarse resolution at points (N, 3) of the world, seen from (3,).

        Unit normals (N, 3), and standard deviations (N,) along them, infinite where there is no plane.
        """

    def match(self, points: FloatArray, T_world_lidar: FloatArray, level: int = 0) -> Correspondences:
        """Correspondences of points (N, 3) of the world, seen from a pose (4, 4); `level` is as of `matcher`."""
        matcher = self.matcher(Sweep(points), level)
        matcher.match(points, T_world_lidar)
        return matcher.correspondences()

    def _count(self, sensor: FloatArray) -> None:
        """Count a scan that was inserted, seen from a position (3,), and drop the cells that are too far by now."""
        self._centre = sensor if self._centre is None else self._centre
        if float(np.linalg.norm(sensor - self._centre)) > _FORGET_AFTER * self._radius_m:
            self._centre = sensor
            for_each_grid(self.grids, len(self), type(self.grids[0]).drop_beyond, sensor, self._radius_m)
        self.scans += 1


def for_each_grid(grids: Sequence[Grid], amount: int, change: Callable[..., None], *arguments: object) -> None:
    """Change all grids of a map, which share nothing, by an amount of points or cells.

    The first, which has the most cells, on a second thread if the amount is large.
    """
    if amount < _WORTH_A_THREAD:
        for grid in grids:
            change(grid, *arguments)
        return
    with ThreadPoolExecutor(1, "grid") as pool:  # kept for longer, it would not survive a fork
        first = pool.submit(change, grids[0], *arguments)
        for grid in grids[1:]:
            change(grid, *arguments)
        first.result()


def vertical_of(normals: FloatArray) -> FloatArray:
    """Mean unit normal (3,) of the floors and ceilings among surfaces with normals (M, 3); the z axis without any."""
    normals = normals[np.abs(normals[:, 2]) > _LEVEL_COSINE]
    mean = (normals * np.sign(normals[:, 2:])).sum(axis=0)
    length = float(np.linalg.norm(mean))
    return np.array([0.0, 0.0, 1.0]) if length == 0.0 else np.asarray(mean / length, dtype=np.float64)
