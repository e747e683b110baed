"""Sweeps as images, and pairs of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SweepImages:
    """A sweep as images, with what alignment needs of it; float32.

    Attributes:
        points: (3, H, W) metres in the LiDAR frame at the time of each point; zero where empty.
        normals: (3, H, W) unit, zero where there is none.
        offsets: (H, W) seconds from the middle of the sweep; all zero where unknown or already compensated.
        low, high: elevation of the centres of the first and the last row, radians.
    """

    points: Floats
    normals: Floats
    offsets: Floats
    low: float
    high: float

    def median_range_m(self) -> float:
        """Of all points; 0 when there are none."""
        x, y, z = self.points
        squares = x * x + y * y + z * z
        seen = squares[squares > 0.0]
        # The lower of the two in the middle, when there are two.
        return float(np.sqrt(np.partition(seen, (len(seen) - 1) // 2)[(len(seen) - 1) // 2])) if len(seen) else 0.0

    def share_with_normal(self) -> float:
        """Of the pixels that have a point; 0 when there are none."""
        points, normals = (int(np.count_nonzero((part != 0.0).any(axis=0))) for part in (self.points, self.normals))
        return normals / max(points, 1)


@dataclass(frozen=True, eq=False)
class LastMotion:
    """How the sensor moved before.

    Attributes:
        velocity: (6,) mean between the middles of two sweeps, the later of which is the previous one now; rotation
            first, in radians and metres a second.
        interval_s: from one of these middles to the other.
    """

    velocity: FloatArray
    interval_s: float


@dataclass(frozen=True, eq=False)
class SweepPair:
    """A sweep with the one before it.

    Attributes:
        current, previous: the sweeps; their images may differ in size.
        interval_s: from the middle of the previous one to that of the current one.
        last: the motion before; None where it is not known.
    """

    current: SweepImages
    previous: SweepImages
    interval_s: float
    last: LastMotion | None = None
