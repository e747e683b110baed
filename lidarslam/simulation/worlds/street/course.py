"""A given path as the middle of a road: how far things are from all of it, and what stands where along its sides."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray

STEP_M = 0.5
# The road goes on straight for this long before the path and behind it.
_BEYOND_M = 12.0
# Directions are averaged over this length: a path has jitter, and a row of houses none.
_SMOOTH_M = 3.0


@dataclass(frozen=True, eq=False)
class Course:
    """An open path, as points half a metre apart.

    Attributes:
        points: (N, 2) or (N, 3).
    """

    points: FloatArray

    @classmethod
    def along(cls, path: FloatArray) -> "Course":
        """The course of a polyline (M, 2) or (M, 3), at least one metre long, longer than it at either end."""
        at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
        wanted = np.linspace(0.0, at[-1], max(4, int(np.ceil(at[-1] / STEP_M)) + 1))
        points = np.stack([np.interp(wanted, at, column) for column in path.T], axis=1)
        ahead = STEP_M * np.arange(1, int(_BEYOND_M / STEP_M) + 1)[:, None]
        directions = _directions(points)
        level = np.zeros(path.shape[1] - 2)
        before = points[0] - ahead[::-1] * np.append(directions[0], level)
        return cls(np.concatenate([before, points, points[-1] + ahead * np.append(directions[-1], level)]))

    @property
    def length_m(self) -> float:
        """About how long it is."""
        return STEP_M * (len(self.points) - 1)

    @cached_property
    def lefts(self) -> FloatArray:
        """(N, 2) unit, to the left of the way."""
        ahead = _directions(self.points)
        return np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)

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


@dataclass
class Land:
    """Cells of one metre that something stands in already."""

    _taken: set[tuple[int, int]] = field(default_factory=set)

    def is_free(self, footprint: FloatArray) -> bool:
        """Whether all points (M, 2) of a footprint are on free cells."""
        return self._taken.isdisjoint(_cells(footprint))

    def take(self, footprint: FloatArray) -> None:
        """Keep others out of the cells of points (M, 2)."""
        self._taken.update(_cells(footprint))


def rectangle(origin: FloatArray, along: FloatArray, width: float, depth: float) -> FloatArray:
    """Points (M, 2) all over a rectangle, less than a cell apart, from its corner (2,) along (2,) and to its left."""
    x = np.linspace(0.0, width, int(np.ceil(width / 0.7)) + 1)
    y = np.linspace(0.0, depth, int(np.ceil(depth / 0.7)) + 1)
    left = np.array([-along[1], along[0]])
    return np.asarray((origin + x[:, None, None] * along + y[:, None] * left).reshape(-1, 2))


def _cells(points: FloatArray) -> list[tuple[int, int]]:
    cells: NDArray[np.int64] = np.floor(points).astype(np.int64)
    return list(map(tuple, cells.tolist()))


def _directions(points: FloatArray) -> FloatArray:
    smooth = gaussian_filter1d(points[:, :2], _SMOOTH_M / STEP_M, axis=0, mode="nearest")
    ahead = np.gradient(smooth, axis=0)
    return np.asarray(ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9))
