"""Who stands where: nothing on the route, nothing inside something else."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Route

SAMPLE_SPACING_M = 0.1


def sample_route(route: Route, spacing_m: float = SAMPLE_SPACING_M) -> FloatArray:
    """Points (N, 3) along the closed polyline of a route, at most `spacing_m` apart, corners included."""
    corners = np.concatenate([route.waypoints, route.waypoints[:1]])
    legs = []
    for a, b in pairwise(corners):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing_m)))
        legs.append(a + (b - a) * (np.arange(n) / n)[:, None])
    return np.concatenate(legs)


@dataclass
class Clearance:
    """Upright blocks of space that are taken, beside the free space along a route.

    Attributes:
        route: whose free space stays free, with `margin_m` around it.
    """

    route: Route
    margin_m: float = 0.08
    _path: FloatArray = field(init=False)
    _lows: FloatArray = field(init=False)
    _highs: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self._path = sample_route(self.route)
        self._lows, self._highs = np.empty((0, 3)), np.empty((0, 3))

    def is_free(self, low: FloatArray, high: FloatArray, gap_m: float = 0.0) -> bool:
        """Whether the block between corners low and high (3,) keeps off the route, and `gap_m` beside what is taken."""
        if self.on_route(low, high):
            return False
        gap = np.array([gap_m, gap_m, 0.0])
        overlaps = ((low < self._highs + gap) & (self._lows < high + gap)).all(axis=1)
        return not bool(overlaps.any())

    def on_route(self, low: FloatArray, high: FloatArray) -> bool:
        """Whether the block between corners low and high (3,) reaches into the route's free space."""
        reach = self.route.free_side_m + self.margin_m
        apart = np.maximum(np.maximum(low[:2] - self._path[:, :2], self._path[:, :2] - high[:2]), 0.0)
        beside = np.hypot(apart[:, 0], apart[:, 1]) < reach
        level = (self._path[:, 2] < high[2]) & (self._path[:, 2] + self.route.free_height_m + self.margin_m > low[2])
        return bool((beside & level).any())

    def claim(self, low: FloatArray, high: FloatArray, gap_m: float = 0.0) -> bool:
        """Take the block between corners low and high (3,) if it is free; whether it was."""
        if not self.is_free(low, high, gap_m):
            return False
        self.take(low, high)
        return True

    def take(self, low: FloatArray, high: FloatArray) -> None:
        """Keep others out of the block between corners low and high (3,)."""
        self._lows, self._highs = np.vstack([self._lows, low]), np.vstack([self._highs, high])
