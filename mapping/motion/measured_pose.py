"""The pose that correspondences alone measure, without the prediction."""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, exp

# Directions with larger standard deviations are not measured: rotation, radians, and translation, metres.
_LARGEST = np.array([0.1] * 3 + [1.0] * 3)


@dataclass(frozen=True, eq=False)
class MeasuredPose:
    """A pose, and the information of its error `xi` in `T_true = T_world_lidar @ exp(xi)`, rotation first."""

    T_world_lidar: FloatArray  # (4, 4); arbitrary along directions that are not measured
    information: FloatArray  # (6, 6), zero along directions that are not measured

    @classmethod
    def minimum(cls, T_world_lidar: FloatArray, hessian: FloatArray, gradient: FloatArray) -> "MeasuredPose":
        """The minimum of a cost with Hessian (6, 6) and gradient (6,) at a pose (4, 4)."""
        values, vectors = np.linalg.eigh(hessian * np.outer(_LARGEST, _LARGEST))
        axes, values = vectors[:, values > 1.0], values[values > 1.0]
        step = -_LARGEST * (axes @ ((axes.T @ (_LARGEST * gradient)) / values))
        rows = axes / _LARGEST[:, None]
        return cls(T_world_lidar @ exp(step), np.asarray((rows * values) @ rows.T, dtype=np.float64))

    def without(self, direction: FloatArray) -> "MeasuredPose":
        """The measurement, marginalised over a direction (6,) of the error."""
        along = self.information @ direction
        total = float(direction @ along)
        return self if total <= 0.0 else replace(self, information=self.information - np.outer(along, along) / total)
