"""Finds places for furniture at the walls and on the floors of rooms."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarslam.simulation.worlds.building import Builder
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.interior import HAIR_M, Spot
from lidarslam.simulation.worlds.office.plan import Room
from lidarslam.simulation.worlds.office.shell import WALL_M

Draw = Callable[[Spot], None]


@dataclass(frozen=True)
class Furnisher:
    """Puts furniture where there is room for it.

    Attributes:
        builder: what is drawn into.
        clearance: what is taken.
        rng: where it goes.
    """

    builder: Builder
    clearance: Clearance
    rng: np.random.Generator

    def at_wall(
        self, room: Room, size: tuple[float, float, float], draw: Draw, z: float = 0.0, tries: int = 12
    ) -> bool:
        """Draw a piece of that width, depth and height at some wall, its bottom at z; whether there was room."""
        inner = 0.5 * WALL_M + HAIR_M
        for _ in range(tries):
            side = int(self.rng.integers(4))
            spans = (room.high - room.low)[[0, 1, 0, 1]]
            free = float(spans[side]) - 2.0 * inner - size[0]
            if free < 0.0:
                continue
            along = inner + 0.5 * size[0] + free * float(self.rng.choice([0.0, 1.0, self.rng.random()]))
            corner = [(0, 0), (1, 0), (1, 1), (0, 1)][side]
            origin = np.array([(room.low, room.high)[corner[k]][k] for k in range(2)] + [0.0])
            spot = Spot(self.builder, origin, 0.5 * np.pi * side).shifted(along, inner)
            if self._claim(spot, (-0.5 * size[0], 0.5 * size[0]), (0.0, size[1]), (z, z + size[2])):
                draw(spot)
                return True
        return False

    def on_floor(self, room: Room, size: tuple[float, float, float], draw: Draw, tries: int = 12) -> bool:
        """Draw a piece that fills that width, depth and height around its middle; whether there was room."""
        for _ in range(tries):
            turned = bool(self.rng.random() < 0.5)
            half = 0.5 * np.array([size[1], size[0]] if turned else [size[0], size[1]])
            low, high = room.low + WALL_M + half, room.high - WALL_M - half
            if (low > high).any():
                continue
            spot = Spot(self.builder, np.array([*self.rng.uniform(low, high), 0.0]), 0.5 * np.pi * turned)
            a, b = 0.5 * size[0], 0.5 * size[1]
            if self._claim(spot, (-a, a), (-b, b), (0.0, size[2])):
                draw(spot)
                return True
        return False

    def _claim(self, spot: Spot, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> bool:
        a, b = spot.point(x[0], y[0], z[0]), spot.point(x[1], y[1], z[1])
        return self.clearance.claim(np.minimum(a, b), np.maximum(a, b))
