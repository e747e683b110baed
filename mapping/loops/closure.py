"""Relative poses between keyframes, loop closures among them, and their consistency with the drift of the estimate."""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, adjoint, inverse, log
from lidarslam.core.state import TRANSFORM, Shape

# Chi-squared with six degrees of freedom: 99 % of consistent measurements are below.
CHI_SQUARED_99 = 16.8
# This many scans on either side of a scan are near it; a distance ahead would not be known before they have come.
NEAR_SCANS = 50
# However short the path, poses next to each other are no better than this; radians and metres.
_LEAST_ROTATION = np.deg2rad(0.1)
_LEAST_TRANSLATION_M = 0.02


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A measured motion between two keyframes, an edge of the pose graph."""

    # first, second: the keyframes
    first: int
    second: int
    T_first_second: Annotated[FloatArray, TRANSFORM]  # (4, 4)
    # (6, 6) of xi in `T_true = T_first_second @ exp(xi)`, rotation first, as GTSAM has it
    covariance: Annotated[FloatArray, Shape(6, 6)]


@dataclass(frozen=True, eq=False)
class LoopClosure(RelativePose):
    """A loop closure that was verified; the second keyframe is the later one."""

    overlap: float  # 0 to 1, inliers among the points that either side sees of the other; the worse side
    residual_m: float  # root mean square residual of the inliers
    inlier_ratio: float  # inliers among the second keyframe's points
    by_appearance: bool  # found by its descriptor, not near the estimate
    consistent: int  # number of other closures that agree
    reason: str  # why it was rejected; empty for one that was accepted
    given: tuple[int, int] | None = None  # the scans that it was given by; None for one that was found

    @property
    def accepted(self) -> bool:
        """Whether it became an edge of the graph."""
        return not self.reason


@dataclass(frozen=True)
class GivenLoops:
    """Pairs of scans, by their indices in the run, the earlier one first."""

    closed: tuple[tuple[int, int], ...] = ()  # which show the same place
    forbidden: tuple[tuple[int, int], ...] = ()  # near which nothing that is found is a closure

    def barred(self, scans: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(K,) which keyframes, of the scans (K,), are not to be closed with the last one."""
        barred = np.zeros(len(scans), dtype=np.bool_)
        for first, second in self.forbidden:
            if abs(scans[-1] - second) <= NEAR_SCANS:
                barred |= np.abs(scans - first) <= NEAR_SCANS
        return barred


@dataclass(frozen=True, eq=False)
class Track:
    """The present estimates of all keyframes, and their drift.

    Two closures between the same two segments make a cycle with the paths between them, that must close (pairwise
    consistency: Mangelson et al., ICRA 2018).
    """

    T_world_lidar: Annotated[FloatArray, Shape(None, 4, 4)]  # (K, 4, 4)
    way_m: Annotated[FloatArray, Shape(None)]  # (K,) path length from the recording's start
    # (K,) stretch of continuous tracking; the drift model holds within one
    segment: Annotated[NDArray[np.int64], Shape(None)]
    # standard deviations of attitude and position per metre travelled, radians and metres
    drift_rates: tuple[float, float]

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

    def drift(self, first: NDArray[np.intp], second: int) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (N,) of the second keyframe's attitude and position relative to others (N,).

        The lever arm of a heading error is about half the distance from the path between to the keyframe.
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
        """Standard deviations of drift that a link corrects, the worse of rotation and translation.

        0 between segments, where no drift model holds.
        """
        if self.segment[link.first] != self.segment[link.second]:
            return 0.0
        xi = log(inverse(self.between(link.first, link.second)) @ link.T_first_second)
        covariance = link.covariance + self.drift_covariance(link.first, link.second)
        parts = (slice(0, 3), slice(3, 6))
        return max(float(np.sqrt(xi[p] @ np.linalg.solve(covariance[p, p], xi[p]))) for p in parts)

    def close_cycle(self, a: RelativePose, b: RelativePose) -> tuple[float, float] | None:
        """Chi-squared and largest standard deviation, metres, of the cycle of two links with the paths between.

        None when the links do not join the same two segments.
        """
        segment = self.segment
        if segment[a.first] != segment[b.first] or segment[a.second] != segment[b.second]:
            return None
        # From the one's second keyframe to the other's, by the links and directly.
        by_links = inverse(a.T_first_second) @ self.between(a.first, b.first) @ b.T_first_second
        xi = log(inverse(self.between(a.second, b.second)) @ by_links)
        of_a, of_way = adjoint(inverse(by_links)), adjoint(inverse(b.T_first_second))
        covariance = of_a @ a.covariance @ of_a.T + b.covariance
        covariance = covariance + of_way @ self.drift_covariance(a.first, b.first) @ of_way.T
        covariance = covariance + self.drift_covariance(a.second, b.second)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
        return float(xi @ np.linalg.solve(covariance, xi)), sigma_m
