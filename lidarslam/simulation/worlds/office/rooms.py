"""Furniture of the rooms and corridors of an office floor, by kind of room."""

from collections.abc import Callable
from functools import partial

import numpy as np

from lidarslam.simulation.worlds import interior
from lidarslam.simulation.worlds.building import Spot
from lidarslam.simulation.worlds.interior import Size
from lidarslam.simulation.worlds.office.furnisher import Furnisher
from lidarslam.simulation.worlds.office.plan import Room

_SHELF = (0.8, 1.4), (0.28, 0.42)
_CABINET = (0.5, 1.2), (0.4, 0.5)
_PLANT = 0.75, 0.75, (0.8, 1.6)


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
    put.at_wall(room, (1.7, 0.4, 0.8), _sideboard)
    put.at_wall(room, (2.0, 0.05, 1.4), interior.board, z=0.7)
    put.some(room, interior.spare_chair, 2, (0.6, 0.6, 1.1))
    put.some(room, interior.plant, 2, _PLANT)


def _storage(room: Room, put: Furnisher) -> None:
    put.some(room, interior.shelf, 6, (*_SHELF, (2.0, 2.4)))
    for _ in range(int(put.rng.integers(4, 9))):
        put.on_floor(room, put.drawn(((0.3, 0.8), (0.3, 0.8), (0.3, 0.8))), interior.crate)


def _kitchen(room: Room, put: Furnisher) -> None:
    put.at_wall(room, (0.62, 0.64, 1.9), _fridge)
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


def _sideboard(spot: Spot, size: Size, rng: np.random.Generator) -> None:
    interior.cabinet(spot, (size[0], size[1], 0.75), rng)


def _fridge(spot: Spot, size: Size, rng: np.random.Generator) -> None:
    interior.cabinet(spot, (size[0], size[1], 1.85), rng)


def _gas_bottle(spot: Spot, size: Size, rng: np.random.Generator, height: float, radius: float) -> None:  # noqa: ARG001
    spot.pillar(0.0, 0.28, (0.0, height), radius)
    spot.pillar(0.0, 0.28, (height, height + 0.1), 0.3 * radius)
