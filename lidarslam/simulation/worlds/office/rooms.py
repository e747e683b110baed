"""Furniture of the rooms and corridors of an office floor, by kind of room."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from lidarslam.simulation.worlds import interior
from lidarslam.simulation.worlds.building import HAIR_M, Builder, Spot
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.interior import Piece, Size
from lidarslam.simulation.worlds.office.plan import WALL_M, Room

Measure = float | tuple[float, float]  # a length, or the limits it is drawn between
_SHELF = (0.8, 1.4), (0.28, 0.42)
_CABINET = (0.5, 1.2), (0.4, 0.5)
_PLANT = 0.75, 0.75, (0.8, 1.6)


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


def furnish_room(room: Room, kind: str, put: Furnisher) -> None:
    """Fill a room after its kind, then hang a few boards or pictures."""
    KINDS[kind](room, put)
    for _ in range(int(put.rng.integers(1, 4))):
        width, low = put.rng.uniform(0.6, 1.8), put.rng.uniform(0.95, 1.3)
        put.at_wall(room, (width, 0.04, 1.0), interior.board, z=low - 0.1)


def furnish_corridor(corridor: Room, height: float, put: Furnisher) -> None:
    """Pillars, lockers, plants, extinguishers and notice boards, as far as the way allows."""
    area = float((corridor.high - corridor.low).prod())
    for _ in range(int(area / 6.0)):
        put.at_wall(corridor, put.drawn((0.35, (0.12, 0.2), height)), interior.pilaster, tries=6)
    for _ in range(int(area / 6.0)):
        depth, width, tall = put.rng.uniform(0.25, 0.45), put.rng.uniform(0.6, 1.8), put.rng.uniform(0.8, 2.0)
        put.at_wall(corridor, (width, depth, tall), interior.cabinet, tries=8)
    for _ in range(int(area / 9.0)):
        put.at_wall(corridor, (0.2, 0.2, 0.7), interior.extinguisher, z=0.3, tries=6)
        size = put.drawn(((0.5, 1.6), 0.05, 1.0))
        put.at_wall(corridor, size, partial(interior.board, low=0.05), z=1.0, tries=6)
        put.at_wall(corridor, (0.5, 0.5, 1.2), _corridor_plant, tries=6)


def _office(room: Room, put: Furnisher) -> None:
    put.some(room, interior.workplace, (2, 5), ((1.3, 1.8), (1.45, 1.6), 1.3))
    put.some(room, interior.shelf, (1, 3), (*_SHELF, (1.7, 2.2)))
    put.some(room, interior.cabinet, (1, 3), (*_CABINET, (0.7, 1.5)))
    put.some(room, interior.plant, (0, 3), _PLANT)


def _meeting(room: Room, put: Furnisher) -> None:
    longest = max(1.5, float((room.high - room.low).max()) - 2.4)
    for _ in range(3):
        if put.on_floor(room, put.drawn(((1.4, longest), (2.0, 2.4), 1.0)), interior.conference):
            break
    put.at_wall(room, (1.7, 0.4, 0.75), interior.cabinet)
    put.at_wall(room, (2.0, 0.05, 1.4), interior.board, z=0.7)
    put.some(room, interior.spare_chair, 2, (0.6, 0.6, 1.1))
    put.some(room, interior.plant, 2, _PLANT)


def _storage(room: Room, put: Furnisher) -> None:
    put.some(room, interior.shelf, 6, (*_SHELF, (2.0, 2.4)))
    for _ in range(int(put.rng.integers(4, 9))):
        put.on_floor(room, put.drawn(((0.3, 0.8), (0.3, 0.8), (0.3, 0.8))), interior.crate)


def _kitchen(room: Room, put: Furnisher) -> None:
    put.at_wall(room, (0.62, 0.64, 1.85), interior.cabinet)
    put.at_wall(room, put.drawn(((1.6, 2.6), 0.64, 2.2)), interior.counter, tries=30)
    for _ in range(int(put.rng.integers(1, 4))):
        span = put.rng.uniform(1.6, 2.0)
        put.on_floor(room, (span, span, 1.0), interior.round_table_with_chairs)
    put.some(room, interior.plant, 1, _PLANT)


def _laboratory(room: Room, put: Furnisher) -> None:
    put.some(room, interior.counter, 3, ((1.4, 2.4), 0.64, 2.2))
    put.on_floor(room, (1.8, 0.9, 1.1), interior.table)
    for _ in range(int(put.rng.integers(1, 4))):
        bottle = partial(_gas_bottle, height=put.rng.uniform(0.7, 1.6), radius=put.rng.uniform(0.12, 0.25))
        put.at_wall(room, (0.55, 0.55, 1.7), bottle)
    put.some(room, interior.cabinet, 2, (*_CABINET, (1.8, 2.1)))


def _lounge(room: Room, put: Furnisher) -> None:
    put.some(room, interior.sofa, (1, 4), ((1.3, 2.3), 0.9, 0.9))
    put.on_floor(room, (0.9, 0.9, 0.8), interior.round_table)
    put.some(room, interior.shelf, 1, (*_SHELF, (1.2, 1.9)))
    put.some(room, interior.plant, 4, _PLANT)


def _open_plan(room: Room, put: Furnisher) -> None:
    for _ in range(int(put.rng.integers(2, 5))):
        put.on_floor(room, (1.5, 1.6, 1.5), interior.screened_workplace, tries=25)
    put.some(room, interior.workplace, 2, (1.5, 1.5, 1.3))
    put.some(room, interior.cabinet, 3, (*_CABINET, (0.9, 1.4)))
    put.some(room, interior.plant, 1, _PLANT)


KINDS: dict[str, Callable[[Room, Furnisher], None]] = {
    "office": _office,
    "meeting": _meeting,
    "storage": _storage,
    "kitchen": _kitchen,
    "laboratory": _laboratory,
    "lounge": _lounge,
    "open_plan": _open_plan,
}


def _corridor_plant(spot: Spot, size: Size, rng: np.random.Generator) -> None:
    interior.plant(spot, (size[0], 0.45, 1.1), rng)


def _gas_bottle(spot: Spot, size: Size, rng: np.random.Generator, height: float, radius: float) -> None:  # noqa: ARG001
    spot.pillar(0.0, 0.28, (0.0, height), radius)
    spot.pillar(0.0, 0.28, (height, height + 0.1), 0.3 * radius)
