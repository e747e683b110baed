"""Drift of the estimated trajectory, and the consistency of loop closures with it and with one another.

Two closures between the same two segments make a cycle with the ways between them, that must close (pairwise
consistency: Mangelson et al., ICRA 2018).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, adjoint, inverse, log
from lidarslam.core.state import Shape
from lidarslam.mapping.loops.closure import RelativePose

# However short the way, poses next to each other are no better than this; radians and metres.
_LEAST_ROTATION = np.deg2rad(0.1)
_LEAST_TRANSLATION_M = 0.02


@dataclass(frozen=True, eq=False)
class Track:
    """The present estimates of all keyframes."""

    T_world_lidar: Annotated[FloatArray, Shape(None, 4, 4)]  # (K, 4, 4)
    way_m: Annotated[FloatArray, Shape(None)]  # (K,) path length from the recording's start
    # (K,) stretch of continuous tracking; the drift model holds within one
    segment: Annotated[NDArray[np.int64], Shape(None)]
    # standard deviations of attitude and position for each metre of the way, radians and metres
    drift_rates: tuple[float, float]

    def __post_init__(self) -> None:
        count = len(self.way_m)
        if self.T_world_lidar.shape != (count, 4, 4) or self.segment.shape != (count,):
            raise ValueError(f"expected {count} poses and segments, got {len(self.T_world_lidar)}, {len(self.segment)}")

    @cached_property
    def _sums(self) -> tuple[FloatArray, FloatArray]:
        """Positions (K + 1, 3) and their squared lengths (K + 1,), summed up from the start."""
        position = self.T_world_lidar[:, :3, 3]
        squares = np.einsum("ij,ij->i", position, position)
        zero = np.zeros((1, 3))
        return np.concatenate([zero, np.cumsum(position, axis=0)]), np.concatenate([zero[0, :1], np.cumsum(squares)])

    def between(self, first: int, second: int) -> FloatArray:
        """`T_first_second` (4, 4)."""
        return np.asarray(inverse(self.T_world_lidar[first]) @ self.T_world_lidar[second], dtype=np.float64)

    def joins_segments(self, link: RelativePose) -> bool:
        """Whether the two keyframes are of different segments."""
        return bool(self.segment[link.first] != self.segment[link.second])

    def drift(self, first: NDArray[np.intp], second: int) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (N,) of the second keyframe's attitude and position relative to others (N,).

        A heading error grows along the way; its lever arm is about half the distance from the way between to the
        keyframe.
        """
        way = np.abs(self.way_m[first] - self.way_m[second])
        sums, squares = self._sums
        low, high = np.minimum(first, second), np.maximum(first, second) + 1
        count = high - low
        mean, square = (sums[high] - sums[low]) / count[:, None], (squares[high] - squares[low]) / count
        here = self.T_world_lidar[second, :3, 3]
        distance = np.sqrt(np.maximum(square - 2.0 * mean @ here + here @ here, 0.0))
        turned, shifted = self.drift_rates
        rotation, translation = _LEAST_ROTATION + turned * way, _LEAST_TRANSLATION_M + shifted * way
        return rotation, np.hypot(translation, 0.5 * rotation * distance)

    def drift_m(self, first: int, second: int) -> float:
        """Standard deviation of the second keyframe's position relative to the first."""
        return float(self.drift(np.array([first]), second)[1][0])

    def drift_covariance(self, first: int, second: int) -> FloatArray:
        """(6, 6) of xi in `T_true = T_first_second @ exp(xi)`, rotation first."""
        rotation, translation = self.drift(np.array([first]), second)
        return np.diag(np.repeat([rotation[0] ** 2, translation[0] ** 2], 3))

    def correction_sigmas(self, link: RelativePose) -> float:
        """Standard deviations of drift that a link corrects; the worse of rotation and translation.

        0 between segments, where no drift model holds.
        """
        if self.joins_segments(link):
            return 0.0
        xi = log(inverse(self.between(link.first, link.second)) @ link.T_first_second)
        covariance = link.covariance + self.drift_covariance(link.first, link.second)
        parts = (slice(0, 3), slice(3, 6))
        return max(float(np.sqrt(xi[p] @ np.linalg.solve(covariance[p, p], xi[p]))) for p in parts)

    def close_cycle(self, a: RelativePose, b: RelativePose) -> tuple[float, float] | None:
        """Chi-squared of the cycle of two links and the ways between them, and its largest standard deviation, metres.

        None when the links do not join the same two segments.
        """
        segment = self.segment
        if segment[a.first] != segment[b.first] or segment[a.second] != segment[b.second]:
            return None
        # From the one's second keyframe to the other's, by the links and directly.
        by_links = inverse(a.T_first_second) @ self.between(a.first, b.first) @ b.T_first_second
        xi = log(inverse(self.between(a.second, b.second)) @ by_links)
        of_a, of_way = adjoint(inverse(by_links)), adjoint(inverse(b.T_first_second))
        covariance = (
            of_a @ a.covariance @ of_a.T
            + b.covariance
            + of_way @ self.drift_covariance(a.first, b.first) @ of_way.T
            + self.drift_covariance(a.second, b.second)
        )
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
        return float(xi @ np.linalg.solve(covariance, xi)), sigma_m
