"""A given path as the middle of a road: places beside it, and distances from all of it."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import left_of
from lidarslam.simulation.worlds.paths import lengths_along, points_along

STEP_M = 0.5
# The road goes on straight for this long before the path and behind it.
_BEYOND_M = 12.0
# Directions are averaged over this length: a path has jitter, and a row of houses none.
_SMOOTH_M = 3.0


@dataclass(frozen=True, eq=False)
class Course:
    """An open path, as points half a metre apart."""

    points: FloatArray  # (N, 2) or (N, 3)

    @classmethod
    def along(cls, path: FloatArray) -> "Course":
        """The course of a polyline (M, 2) or (M, 3), at least one metre long, longer than it at either end."""
        at = lengths_along(path[:, :2])
        points = points_along(path, at, np.linspace(0.0, at[-1], max(4, int(np.ceil(at[-1] / STEP_M)) + 1)))
        ahead = STEP_M * np.arange(1, int(_BEYOND_M / STEP_M) + 1)[:, None]
        first, last = (np.append(_directions(points)[end], np.zeros(path.shape[1] - 2)) for end in (0, -1))
        return cls(np.concatenate([points[0] - ahead[::-1] * first, points, points[-1] + ahead * last]))

    @property
    def length_m(self) -> float:
        """About how long it is."""
        return STEP_M * (len(self.points) - 1)

    @cached_property
    def lefts(self) -> FloatArray:
        """(N, 2) unit, to the left of the way."""
        return left_of(_directions(self.points))

    @cached_property
    def tree(self) -> "cKDTree[None]":
        """Of the points' x and y."""
        return cKDTree(self.points[:, :2])

    def sides(self) -> Iterator["Course"]:
        """The course and its reverse: what is placed along the left of each is placed on both sides."""
        yield self
        yield Course(self.points[::-1])

    def beside(self, at_m: FloatArray | float, left_m: float) -> FloatArray:
        """Places (..., 2) to the left of the course, at lengths (...) along it."""
        place = np.clip(np.asarray(at_m) / STEP_M, 0, len(self.points) - 1).round().astype(int)
        return np.asarray(self.points[place, :2] + left_m * self.lefts[place])

    def distance(self, xy: FloatArray) -> FloatArray:
        """Distance (M,) of points (M, 2) from the nearest part of the course."""
        nearest = self.tree.query(xy)[0]
        return np.asarray(np.sqrt(np.maximum(nearest**2 - (0.5 * STEP_M) ** 2, 0.0)))  # between two points it is nearer


def _directions(points: FloatArray) -> FloatArray:
    smooth = gaussian_filter1d(points[:, :2], _SMOOTH_M / STEP_M, axis=0, mode="nearest")
    ahead = np.gradient(smooth, axis=0)
    return np.asarray(ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9))
