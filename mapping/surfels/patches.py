"""What cells of the map show of a surface: a plane, or none."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

PATCH_COLUMNS = 15
_POINT, _NORMAL, _DIRECTION, _SPREADS = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_ELEVATION, _COUNT, _IS_PLANE = 12, 13, 14


@dataclass(frozen=True, eq=False)
class PatchTable:
    """N patches, the columns of one array so that one lookup fetches them.

    Attributes:
        values: (N, 15).
    """

    values: FloatArray

    def __len__(self) -> int:
        return len(self.values)

    def select(self, chosen: NDArray[np.intp]) -> "PatchTable":
        """Some of the patches."""
        return PatchTable(self.values.take(chosen, axis=0))

    @property
    def points(self) -> FloatArray:
        """(N, 3) in the middle of each patch, in the world."""
        return self.values[:, _POINT]

    @property
    def normals(self) -> FloatArray:
        """(N, 3) unit."""
        return self.values[:, _NORMAL]

    @property
    def directions(self) -> FloatArray:
        """(N, 3) unit."""
        return self.values[:, _DIRECTION]

    @property
    def spreads_m(self) -> FloatArray:
        """(N, 3) standard deviations along the principal axes, ascending."""
        return self.values[:, _SPREADS]

    @property
    def elevation_spreads(self) -> FloatArray:
        """(N,) standard deviation of the angle above the sensor's equator that it was seen at, radians."""
        return self.values[:, _ELEVATION]

    @property
    def counts(self) -> FloatArray:
        """(N,) points it rests on."""
        return self.values[:, _COUNT]

    @property
    def is_plane(self) -> NDArray[np.bool_]:
        """(N,) whether it is a plane."""
        return np.asarray(self.values[:, _IS_PLANE] > 0.0)
