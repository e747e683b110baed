"""What stands in the rooms and corridors of an office floor; each kind of room has its own furniture."""

from collections.abc import Callable
from functools import partial

import numpy as np

from lidarslam.simulation.worlds import interior
from lidarslam.simulation.worlds.interior import HAIR_M, Spot
from lidarslam.simulation.worlds.office.furnisher import Furnisher
from lidarslam.simulation.worlds.office.plan import Room


def furnish_room(room: Room, kind: str, put: Furnisher) -> None:
    """Fill a room after its kind, then hang what every room has."""
    KINDS[kind](room, put)
    for _ in range(int(put.rng.integers(1, 4))):
        width, low = put.rng.uniform(0.6, 1.8), put.rng.uniform(0.95, 1.3)
        hang = partial(interior.board, width=width, low=low, high=low + 0.8)
        put.at_wall(room, (width, 0.04, 1.0), hang, z=low - 0.1)


def furnish_corridor(corridor: Room, height: float, put: Furnisher) -> None:
    """Pillars, lockers, plants, extinguishers and notice boards, as far as the way allows."""
    rng = put.rng
    area = float((corridor.high - corridor.low).prod())
    for _ in range(int(area / 6.0)):
        proud = rng.uniform(0.12, 0.2)
        put.at_wall(corridor, (0.35, proud, height), partial(_block, x=0.35, y=(-HAIR_M, proud), z=height), tries=6)
    for _ in range(int(area / 6.0)):
        depth, width, tall = rng.uniform(0.25, 0.45), rng.uniform(0.6, 1.8), rng.uniform(0.8, 2.0)
        draw = partial(interior.cabinet, width=width, depth=depth, height=tall, rng=rng)
        put.at_wall(corridor, (width, depth, tall), draw, tries=8)
    for _ in range(int(area / 9.0)):
        put.at_wall(corridor, (0.2, 0.2, 0.7), _extinguisher, z=0.3, tries=6)
        width = rng.uniform(0.5, 1.6)
        hang = partial(interior.board, width=width, low=1.05, high=1.85)
        put.at_wall(corridor, (width, 0.05, 1.0), hang, z=1.0, tries=6)
        put.at_wall(corridor, (0.5, 0.5, 1.2), partial(_plant, away=0.22, height=1.1, rng=rng), tries=6)


def _office(room: Room, put: Furnisher) -> None:
    rng = put.rng
    for _ in range(int(rng.integers(2, 5))):
        width, depth = rng.uniform(1.3, 1.8), rng.uniform(0.7, 0.85)
        put.at_wall(room, (width, depth + 0.75, 1.3), partial(_workplace, width=width, depth=depth, rng=rng))
    _shelves(room, put, int(rng.integers(1, 3)), (1.7, 2.2))
    _cabinets(room, put, int(rng.integers(1, 3)), (0.7, 1.5))
    _plants(room, put, int(rng.integers(0, 3)))


def _meeting(room: Room, put: Furnisher) -> None:
    rng = put.rng
    longest = max(1.5, float((room.high - room.low).max()) - 2.4)
    for _ in range(3):
        width, depth = rng.uniform(1.4, longest), rng.uniform(0.9, 1.3)
        if put.on_floor(room, (width, depth + 1.1, 1.0), partial(_conference, width=width, depth=depth, rng=rng)):
            break
    put.at_wall(room, (1.7, 0.4, 0.8), partial(interior.cabinet, width=1.7, depth=0.4, height=0.75, rng=rng))
    put.at_wall(room, (2.0, 0.05, 1.4), partial(interior.board, width=2.0, low=0.8, high=2.0), z=0.7)
    for _ in range(2):
        put.at_wall(room, (0.6, 0.6, 1.1), partial(_spare_chair, rng=rng))
    _plants(room, put, 2)


def _storage(room: Room, put: Furnisher) -> None:
    _shelves(room, put, 6, (2.0, 2.4))
    for _ in range(int(put.rng.integers(4, 9))):
        x, y, z = put.rng.uniform(0.3, 0.8, 3)
        put.on_floor(room, (x, y, z), partial(_block, x=x, y=(-0.5 * y, 0.5 * y), z=z))


def _kitchen(room: Room, put: Furnisher) -> None:
    rng = put.rng
    put.at_wall(room, (0.62, 0.64, 1.9), partial(interior.cabinet, width=0.62, depth=0.64, height=1.85, rng=rng))
    width = rng.uniform(1.6, 2.6)
    put.at_wall(room, (width, 0.64, 2.2), partial(interior.counter, width=width, rng=rng), tries=30)
    for _ in range(int(rng.integers(1, 4))):
        radius = rng.uniform(0.35, 0.55)
        span = 2.0 * radius + 0.9
        put.on_floor(room, (span, span, 1.0), partial(_round_with_chairs, radius=radius, rng=rng))
    _plants(room, put, 1)


def _laboratory(room: Room, put: Furnisher) -> None:
    rng = put.rng
    for _ in range(3):
        width = rng.uniform(1.4, 2.4)
        put.at_wall(room, (width, 0.64, 2.2), partial(interior.counter, width=width, rng=rng))
    put.on_floor(room, (1.8, 0.9, 1.1), partial(interior.table, width=1.8, depth=0.9, rng=rng))
    for _ in range(int(rng.integers(1, 4))):
        draw = partial(_gas_bottle, height=rng.uniform(0.7, 1.6), radius=rng.uniform(0.12, 0.25))
        put.at_wall(room, (0.55, 0.55, 1.7), draw)
    _cabinets(room, put, 2, (1.8, 2.1))


def _lounge(room: Room, put: Furnisher) -> None:
    for _ in range(int(put.rng.integers(1, 4))):
        width = put.rng.uniform(1.3, 2.3)
        put.at_wall(room, (width, 0.9, 0.9), partial(interior.sofa, width=width, rng=put.rng))
    put.on_floor(room, (0.9, 0.9, 0.8), partial(interior.round_table, radius=0.4))
    _shelves(room, put, 1, (1.2, 1.9))
    _plants(room, put, 4)


def _open_plan(room: Room, put: Furnisher) -> None:
    for _ in range(int(put.rng.integers(2, 5))):
        put.on_floor(room, (1.5, 1.6, 1.5), partial(_screened_workplace, rng=put.rng), tries=25)
    for _ in range(2):
        put.at_wall(room, (1.5, 1.5, 1.3), partial(_workplace, width=1.5, depth=0.75, rng=put.rng))
    _cabinets(room, put, 3, (0.9, 1.4))
    _plants(room, put, 1)


KINDS: dict[str, Callable[[Room, Furnisher], None]] = {
    "office": _office,
    "meeting": _meeting,
    "storage": _storage,
    "kitchen": _kitchen,
    "laboratory": _laboratory,
    "lounge": _lounge,
    "open_plan": _open_plan,
}


def _shelves(room: Room, put: Furnisher, count: int, heights: tuple[float, float]) -> None:
    for _ in range(count):
        width, depth, height = put.rng.uniform(0.8, 1.4), put.rng.uniform(0.28, 0.42), put.rng.uniform(*heights)
        draw = partial(interior.shelf, width=width, depth=depth, height=height, rng=put.rng)
        put.at_wall(room, (width, depth, height), draw)


def _cabinets(room: Room, put: Furnisher, count: int, heights: tuple[float, float]) -> None:
    for _ in range(count):
        width, depth, height = put.rng.uniform(0.5, 1.2), put.rng.uniform(0.4, 0.5), put.rng.uniform(*heights)
        draw = partial(interior.cabinet, width=width, depth=depth, height=height, rng=put.rng)
        put.at_wall(room, (width, depth, height), draw)


def _plants(room: Room, put: Furnisher, count: int) -> None:
    for _ in range(count):
        height = put.rng.uniform(0.8, 1.6)
        put.at_wall(room, (0.75, 0.75, height), partial(_plant, away=0.37, height=height, rng=put.rng))


def _block(spot: Spot, x: float, y: tuple[float, float], z: float) -> None:
    spot.box((-0.5 * x, 0.5 * x), y, (0.0, z))


def _extinguisher(spot: Spot) -> None:
    spot.rod((0.0, 0.1, 0.35), (0.0, 0.1, 0.9), 0.075)
    spot.box((-0.04, 0.04), (0.0, 0.1), (0.6, 0.66))


def _gas_bottle(spot: Spot, height: float, radius: float) -> None:
    spot.rod((0.0, 0.28, 0.0), (0.0, 0.28, height), radius)
    spot.rod((0.0, 0.28, height), (0.0, 0.28, height + 0.1), 0.3 * radius)


def _plant(spot: Spot, away: float, height: float, rng: np.random.Generator) -> None:
    interior.plant(spot.shifted(0.0, away), height, rng)


def _spare_chair(spot: Spot, rng: np.random.Generator) -> None:
    interior.chair(spot.shifted(0.0, 0.3, yaw=np.pi), rng)


def _workplace(spot: Spot, width: float, depth: float, rng: np.random.Generator) -> None:
    interior.desk(spot, width, depth, rng)
    interior.chair(spot.shifted(rng.uniform(-0.2, 0.2), depth + 0.35, yaw=rng.uniform(-0.25, 0.25)), rng)


def _screened_workplace(spot: Spot, rng: np.random.Generator) -> None:
    interior.partition(spot.shifted(0.0, -0.77), 1.5, rng.uniform(1.2, 1.5))
    _workplace(spot.shifted(0.0, -0.72), 1.4, 0.75, rng)


def _conference(spot: Spot, width: float, depth: float, rng: np.random.Generator) -> None:
    interior.table(spot, width, depth, rng)
    for x in np.arange(-0.5 * width + 0.35, 0.5 * width - 0.2, 0.68):
        for side in (0.0, np.pi):
            if rng.random() < 0.85:
                y = 0.5 * depth + 0.22
                interior.chair(spot.shifted(0.0, 0.0, yaw=side).shifted(x, y, yaw=rng.uniform(-0.2, 0.2)), rng)


def _round_with_chairs(spot: Spot, radius: float, rng: np.random.Generator) -> None:
    interior.round_table(spot, radius)
    for angle in np.arange(3) * 2.1 + rng.uniform(0.0, 2.0):
        interior.chair(spot.shifted(0.0, 0.0, yaw=angle).shifted(0.0, radius + 0.12), rng)
