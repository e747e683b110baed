"""How far estimates may have drifted, and whether two closures tell the same story.

Two closures between the same two stretches of way make a circle with the ways between them, that must lead back to
where it began (pairwise consistency: Mangelson et al., ICRA 2018).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, adjoint, inverse, log
from mapping.loops.loop_config import LoopConfig

# Of six degrees of freedom, 99 % are less.
_MOST_SQUARED = 16.8
# However short the way, poses next to each other are no better than this; radians and metres.
_LEAST_ROTATION = np.deg2rad(0.1)
_LEAST_TRANSLATION_M = 0.02


@dataclass(frozen=True, eq=False)
class Track:
    """The present estimates of all keyframes.

    Attributes:
        T_world_lidar: (K, 4, 4).
        way_m: (K,) path length from the session's start.
        session: (K,).
    """

    T_world_lidar: FloatArray
    way_m: FloatArray
    session: NDArray[np.int64]

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

    def drift(self, first: NDArray[np.intp], second: int, config: LoopConfig) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (N,) of the second keyframe's attitude and position as seen from others (N,).

        An error of heading grows along with the way, and swings the way that lies between: on average about half of
        it, over as far as the keyframe lies from that way.
        """
        way = np.abs(self.way_m[first] - self.way_m[second])
        sums, squares = self._sums
        low, high = np.minimum(first, second), np.maximum(first, second) + 1
        count = high - low
        mean, square = (sums[high] - sums[low]) / count[:, None], (squares[high] - squares[low]) / count
        here = self.T_world_lidar[second, :3, 3]
        distance = np.sqrt(np.maximum(square - 2.0 * mean @ here + here @ here, 0.0))
        turned, shifted = config.drift_rates
        rotation, translation = _LEAST_ROTATION + turned * way, _LEAST_TRANSLATION_M + shifted * way
        return rotation, np.hypot(translation, 0.5 * rotation * distance)

    def drift_covariance(self, first: int, second: int, config: LoopConfig) -> FloatArray:
        """(6, 6) of xi in `T_true = T_first_second @ exp(xi)`, rotation first."""
        rotation, translation = self.drift(np.array([first]), second, config)
        return np.diag(np.repeat([rotation[0] ** 2, translation[0] ** 2], 3))


@dataclass(frozen=True, eq=False)
class Link:
    """A closure as consistency sees it: `T_first_second` (4, 4) with the covariance (6, 6) of xi in `T @ exp(xi)`."""

    first: int
    second: int
    T_first_second: FloatArray
    covariance: FloatArray


def correction_sigmas(link: Link, track: Track, config: LoopConfig) -> float:
    """How many standard deviations of drift a link corrects within a session; the worse of rotation and translation."""
    xi = log(inverse(track.between(link.first, link.second)) @ link.T_first_second)
    covariance = link.covariance + track.drift_covariance(link.first, link.second, config)
    parts = (slice(0, 3), slice(3, 6))
    return max(float(np.sqrt(xi[p] @ np.linalg.solve(covariance[p, p], xi[p]))) for p in parts)


def beyond_drift(link: Link, track: Track, most_sigmas: float, config: LoopConfig) -> str:
    """Why drift does not explain a link within a session; empty when it does, and between sessions."""
    if track.session[link.first] != track.session[link.second]:
        return ""
    sigmas = correction_sigmas(link, track, config)
    if sigmas <= most_sigmas:
        return ""
    way_m = track.way_m[link.second] - track.way_m[link.first]
    return f"corrects {sigmas:.1f} standard deviations of the drift over {way_m:.0f} m"


@dataclass(frozen=True)
class Circle:
    """Two links and the ways between them: whether they lead back, and how far off they may be, in metres."""

    closes: bool
    sigma_m: float


def close_circle(a: Link, b: Link, track: Track, config: LoopConfig) -> Circle | None:
    """Go round two links; None when they do not join the same two sessions."""
    session = track.session
    if session[a.first] != session[b.first] or session[a.second] != session[b.second]:
        return None
    # From the one's second keyframe to the other's, by the links and directly.
    by_links = inverse(a.T_first_second) @ track.between(a.first, b.first) @ b.T_first_second
    xi = log(inverse(track.between(a.second, b.second)) @ by_links)
    of_a, of_way = adjoint(inverse(by_links)), adjoint(inverse(b.T_first_second))
    covariance = (
        of_a @ a.covariance @ of_a.T
        + b.covariance
        + of_way @ track.drift_covariance(a.first, b.first, config) @ of_way.T
        + track.drift_covariance(a.second, b.second, config)
    )
    squared = float(xi @ np.linalg.solve(covariance, xi))
    return Circle(squared < _MOST_SQUARED, float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])))
