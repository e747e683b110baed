"""Surfaces that points correspond to, each with up to three residuals across it."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray


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


class Matcher(ABC):
    """Finds the surfaces that N points correspond to, at one pose after another; valid until the map changes."""

    surfaces: Surfaces

    @abstractmethod
    def match(self, points: FloatArray, T_world_lidar: FloatArray) -> None:
        """Update the surfaces for points (N, 3) of the world, seen from a pose (4, 4)."""

    def correspondences(self, most: int = 3) -> Correspondences:
        """A residual per row, in the order of the points; of each point at most so many, first the one across it."""
        found = self.surfaces
        index, _ = chosen = np.nonzero(np.arange(most) < found.counts[:, None])
        return Correspondences(
            index, found.points[index], found.normals[chosen], found.thickness_m[chosen], found.tilt[chosen]
        )
