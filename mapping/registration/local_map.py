"""The local map that scans are registered to: surfels, or LOAM's edges and planes."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Stateful
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.registration.surfaces import Correspondences, Matcher

# Resolutions of a map, in cells. A point's correspondence is the plane of the finest one that has one.
LEVELS = (1, 2, 4)
# In a map of fewer scans, planes are of few points: their normals are uncertain.
_YOUNG_SCANS = 5
# Surfaces within this cosine of the z axis are floors or ceilings.
_LEVEL_COSINE = 0.7


class LocalMap(Stateful, ABC):
    """Surfaces within a radius of the sensor, in several resolutions."""

    cell_m: float  # edge of the finest cells
    scans: int  # number of inserted scans

    @abstractmethod
    def __len__(self) -> int:
        """Number of cells of all resolutions."""

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

        Args:
            sweep: which.
            level: finest resolution that is used, for points that may be off by more than a cell.
            is_inertial: whether an IMU predicts the pose.
        """

    @abstractmethod
    def resized(self, cell_m: float) -> "LocalMap":
        """The map in cells of another size; the map itself for its own size."""

    @abstractmethod
    def means(self) -> FloatArray:
        """Points (M, 3) of the map in the middle resolution, in the world."""

    @abstractmethod
    def level_normals(self) -> FloatArray:
        """Unit normals (M, 3) of the planes in the coarsest resolution."""

    @abstractmethod
    def coarse_planes(self, points: FloatArray, sensor: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Planes in the coarsest resolution at points (N, 3) of the world, seen from (3,).

        Returns:
            Unit normals (N, 3), and standard deviations (N,) along them, infinite where there is no plane.
        """

    def match(self, points: FloatArray, T_world_lidar: FloatArray, level: int = 0) -> Correspondences:
        """Correspondences of points (N, 3) of the world, seen from a pose (4, 4); `level` is as of `matcher`."""
        matcher = self.matcher(Sweep(points), level)
        matcher.match(points, T_world_lidar)
        return matcher.correspondences()

    def vertical(self) -> FloatArray:
        """Unit normal (3,) of floors and ceilings near the sensor; the world's z axis when there are none."""
        normals = self.level_normals()
        normals = normals[np.abs(normals[:, 2]) > _LEVEL_COSINE]
        mean = (normals * np.sign(normals[:, 2:])).sum(axis=0)
        length = float(np.linalg.norm(mean))
        return np.array([0.0, 0.0, 1.0]) if length == 0.0 else np.asarray(mean / length, dtype=np.float64)

    def goes_on(
        self, points: FloatArray, normals: FloatArray, sensor: FloatArray, cosine: float, thickness: float
    ) -> NDArray[np.bool_]:
        """Whether planes (N, 3) at points (N, 3) of the world, seen from (3,), extend over the coarsest cell.

        Args:
            points: in the world.
            normals: unit.
            sensor: position in the world.
            cosine: least, between the normals.
            thickness: largest standard deviation along the normal, as a share of the cell.
        """
        coarse, spread_m = self.coarse_planes(points, sensor)
        is_thin = spread_m < thickness * self.cell_m * LEVELS[-1]
        return np.asarray(is_thin & (np.abs(np.einsum("ij,ij->i", normals, coarse)) > cosine))
