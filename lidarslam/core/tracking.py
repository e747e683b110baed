"""How well a scan was tracked: its status, and the directions of motion that it does not constrain."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from lidarslam.core.geometry import FloatArray

AXES = ("roll", "pitch", "yaw", "x", "y", "z")


class Status(StrEnum):
    """Quality of a scan's pose.

    `ok`: the scan fits the map. `degraded`: it fits badly, or only some directions are constrained. `lost`: it does not
    fit, and the pose is a prediction.
    """

    OK = "ok"
    DEGRADED = "degraded"
    LOST = "lost"


def lever_scale(lever_m: float) -> FloatArray:
    """(6,) scale of a motion, rotation first, to metres: rotations act at the end of a lever."""
    return np.array([lever_m] * 3 + [1.0] * 3)


@dataclass(frozen=True, eq=False)
class Degeneracy:
    """Directions of motion that a scan does not constrain."""

    directions: FloatArray  # (D, 6) orthonormal, rotation first, rotations scaled by `lever_m`, in the LiDAR frame
    lever_m: float  # metres that correspond to a rotation of one radian

    def __len__(self) -> int:
        return len(self.directions)

    @property
    def names(self) -> tuple[str, ...]:
        """The nearest axes of the LiDAR frame, each once (pivoted Cholesky of the projector)."""
        left = self.directions.T @ self.directions  # the same for any basis of the directions
        axes = []
        for _ in self.directions:
            axis = int(left.diagonal().argmax())
            left = left - np.outer(left[:, axis], left[axis]) / left[axis, axis]
            axes.append(axis)
        return tuple(AXES[axis] for axis in sorted(axes))

    @property
    def rows(self) -> FloatArray:
        """(D, 6): from a motion (rotation first, radians and metres) to its components along the directions, metres."""
        return np.asarray(self.directions * lever_scale(self.lever_m), dtype=np.float64)

    def projector(self) -> FloatArray:
        """(6, 6) quadratic form: the squared length, metres, of the part of a motion along the directions."""
        return np.asarray(self.rows.T @ self.rows, dtype=np.float64)

    def part_along(self) -> FloatArray:
        """(6, 6): from a motion (rotation first, radians and metres) to its part along the directions."""
        return np.asarray(self.directions.T @ self.rows / lever_scale(self.lever_m)[:, None], dtype=np.float64)
