"""Free space: along the route, and between the things that stand beside it."""

from dataclasses import dataclass, field

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Route
from lidarslam.simulation.worlds.paths import subdivide_loop

_SPACING_M = 0.1


@dataclass
class Clearance:
    """Upright blocks of space that are taken, beside the free space along a route."""

    route: Route
    margin_m: float = 0.08  # around the route's free space
    _path: FloatArray = field(init=False)
    _lows: FloatArray = field(init=False)
    _highs: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self._path = subdivide_loop(self.route.waypoints, _SPACING_M)
        self._lows, self._highs = np.empty((0, 3)), np.empty((0, 3))

    def on_route(self, low: FloatArray, high: FloatArray) -> bool:
        """Whether the block between corners low and high (3,) reaches into the route's free space."""
        reach = self.route.free_side_m + self.margin_m
        apart = np.maximum(np.maximum(low[:2] - self._path[:, :2], self._path[:, :2] - high[:2]), 0.0)
        beside = np.hypot(apart[:, 0], apart[:, 1]) < reach
        level = (self._path[:, 2] < high[2]) & (self._path[:, 2] + self.route.free_height_m + self.margin_m > low[2])
        return bool((beside & level).any())

    def claim(self, low: FloatArray, high: FloatArray, gap_m: float = 0.0) -> bool:
        """Take the block if it keeps off the route, and `gap_m` beside all blocks that are taken; whether it did."""
        gap = np.array([gap_m, gap_m, 0.0])
        if self.on_route(low, high) or ((low < self._highs + gap) & (self._lows < high + gap)).all(axis=1).any():
            return False
        self.take(low, high)
        return True

    def take(self, low: FloatArray, high: FloatArray) -> None:
        """Take the block between corners low and high (3,) without a check."""
        self._lows, self._highs = np.vstack([self._lows, low]), np.vstack([self._highs, high])
