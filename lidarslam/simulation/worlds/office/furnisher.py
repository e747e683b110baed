"""Places for furniture at the walls and on the floors of rooms."""

from dataclasses import dataclass

import numpy as np

from lidarslam.simulation.worlds.building import HAIR_M, Builder, Spot
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.interior import Piece, Size
from lidarslam.simulation.worlds.office.plan import WALL_M, Room

Measure = float | tuple[float, float]  # a length, or the limits it is drawn between


@dataclass(frozen=True)
class Furnisher:
    """Puts furniture where there is room for it."""

    builder: Builder
    clearance: Clearance
    rng: np.random.Generator

    def at_wall(self, room: Room, size: Size, piece: Piece, z: float = 0.0, tries: int = 12) -> bool:
        """Draw a piece of that width, depth and height at some wall, its bottom at z; whether there was room."""
        inner = 0.5 * WALL_M + HAIR_M
        for _ in range(tries):
            side = int(self.rng.integers(4))
            free = float((room.high - room.low)[side % 2]) - 2.0 * inner - size[0]
            if free < 0.0:
                continue
            along = inner + 0.5 * size[0] + free * float(self.rng.choice([0.0, 1.0, self.rng.random()]))
            corner = np.where([side in (1, 2), side in (2, 3)], room.high, room.low)
            spot = Spot(self.builder, np.append(corner, 0.0), 0.5 * np.pi * side).shifted(along, inner, z)
            if self.clearance.claim(*spot.bounds((-0.5 * size[0], 0.5 * size[0]), (0.0, size[1]), (0.0, size[2]))):
                piece(spot, size, self.rng)
                return True
        return False

    def on_floor(self, room: Room, size: Size, piece: Piece, tries: int = 12) -> bool:
        """Draw a piece that fills that width, depth and height around its middle; whether there was room."""
        a, b = 0.5 * size[0], 0.5 * size[1]
        for _ in range(tries):
            turned = bool(self.rng.random() < 0.5)
            half = np.array([b, a] if turned else [a, b])
            low, high = room.low + WALL_M + half, room.high - WALL_M - half
            if (low > high).any():
                continue
            spot = Spot(self.builder, np.append(self.rng.uniform(low, high), 0.0), 0.5 * np.pi * turned)
            if self.clearance.claim(*spot.bounds((-a, a), (-b, b), (0.0, size[2]))):
                piece(spot, size, self.rng)
                return True
        return False

    def some(
        self, room: Room, piece: Piece, count: int | tuple[int, int], size: tuple[Measure, Measure, Measure]
    ) -> None:
        """So many pieces at the walls, each of its own size."""
        for _ in range(count if isinstance(count, int) else int(self.rng.integers(*count))):
            self.at_wall(room, self.drawn(size), piece)

    def drawn(self, size: tuple[Measure, Measure, Measure]) -> Size:
        """A size within limits."""
        width, depth, height = (self.rng.uniform(*one) if isinstance(one, tuple) else one for one in size)
        return width, depth, height
