"""Furniture, and its placement in the rooms of a floor.

Each piece fills a width, depth and height in a spot's frame, x along its width, z up from the floor. Pieces for walls
have their back at y = 0 and reach to y = depth; the others have their middle at the spot.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import HAIR_M, UP, Builder, Room, around, row, starting
from lidarslam.simulation.worlds.paths import Clearance

Size = tuple[float, float, float]  # width, depth, height
Piece = Callable[[Builder, Size, np.random.Generator], None]
WALL_M = 0.12  # between rooms

# --- at walls


def desk(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A desk with legs, a drawer unit, and a screen or two."""
    top, half, depth = rng.uniform(0.70, 0.76), 0.5 * size[0], size[1]
    spot.block((-half, half), (0.0, depth), (top, top + 0.035))
    spot.block(around((-half + 0.04, half - 0.04), 0.025), (0.06, depth - 0.06), (0.0, top))
    side = rng.choice([-1.0, 1.0])
    spot.block((side * (half - 0.5), side * (half - 0.08)), (0.08, depth - 0.1), (0.0, 0.58))
    for k in range(int(rng.integers(1, 3))):
        x = (k - 0.5) * 0.58 + rng.uniform(-0.05, 0.05)
        spot.blocks(
            (x - 0.27, x + 0.27, 0.16, 0.19, top + 0.14, top + 0.48),
            (x - 0.1, x + 0.1, 0.12, 0.28, top + 0.035, top + 0.05),
            (x - 0.03, x + 0.03, 0.19, 0.21, top + 0.05, top + 0.2),
        )
    spot.block((-0.22, 0.22), (0.42, 0.56), (top + 0.035, top + 0.06))


def workplace(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A desk and a chair before it."""
    depth = size[1] - 0.75
    desk(spot, (size[0], depth, size[2]), rng)
    chair(spot.shifted(rng.uniform(-0.2, 0.2), depth + 0.35, yaw=rng.uniform(-0.25, 0.25)), rng)


def spare_chair(spot: Builder, size: Size, rng: np.random.Generator) -> None:  # noqa: ARG001
    """A chair with its back to the wall."""
    chair(spot.shifted(0.0, 0.3, yaw=np.pi), rng)


def shelf(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """An open shelf with a back, boards, and rows of books and boxes."""
    half, depth, height = 0.5 * size[0], size[1], size[2]
    spot.block((-half, half), (0.0, 0.02), (0.0, height))
    spot.block(starting((-half, half - 0.03), 0.03), (0.02, depth), (0.0, height))
    boards = np.linspace(0.06, height - 0.03, max(2, round(height / 0.38) + 1))
    for z, above in pairwise(boards):
        spot.block((-half + 0.03, half - 0.03), (0.02, depth - 0.01), (z, z + 0.025))
        at, low = -half + 0.05, z + 0.025
        while at < half - 0.05 - 0.15:
            length = min(rng.uniform(0.15, 0.5), half - 0.05 - at)
            if rng.random() < 0.75:
                y = (0.03, depth * rng.uniform(0.55, 0.95))
                spot.block((at, at + length), y, (low, low + (above - 0.03 - low) * rng.uniform(0.5, 0.95)))
            at += length + rng.choice([0.01, 0.12])
    spot.block((-half + 0.03, half - 0.03), (0.02, depth - 0.01), (boards[-1], boards[-1] + 0.025))


def cabinet(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A closed cabinet on a plinth, with doors or drawers that protrude a little."""
    (width, depth, height), half = size, 0.5 * size[0]
    spot.block((-half + 0.02, half - 0.02), (0.0, depth - 0.05), (0.0, 0.08))
    spot.block((-half, half), (0.0, depth - 0.02), (0.08, height))
    columns = max(1, round(width / 0.45))
    rows = 1 if rng.random() < 0.5 else max(2, round(height / 0.4))
    spot.block(row(-half, half, columns, 0.01), (depth - 0.02, depth), row(0.08, height, rows, 0.01))


def counter(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A kitchen counter 0.6 m deep with cupboards over it, a sink's tap and a machine on it."""
    width, half = size[0], 0.5 * size[0]
    cabinet(spot, (width, 0.58, 0.86), rng)
    spot.block((-half, half), (0.0, 0.62), (0.86, 0.9))
    cabinet(spot.shifted(0.0, 0.0, 1.4), (width, 0.34, 0.7), rng)
    spot.pole((-0.3 * width, 0.12), (0.9, 1.18), 0.015)
    spot.cylinder((-0.3 * width, 0.12, 1.17), (-0.3 * width, 0.3, 1.15), 0.012)
    x = rng.uniform(0.0, 0.25 * width)
    spot.block((x, x + 0.3), (0.1, 0.45), (0.9, rng.uniform(1.15, 1.3)))


def sofa(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A sofa, 0.85 m deep."""
    half, seat = 0.5 * size[0], rng.uniform(0.38, 0.44)
    spot.blocks((-half, half, 0.04, 0.85, 0.06, seat - 0.1), (-half, half, 0.0, 0.22, 0.06, seat + 0.4))
    spot.block(starting((-half, half - 0.16), 0.16), (0.1, 0.83), (0.06, seat + 0.18))
    cushions = max(1, round((size[0] - 0.32) / 0.65))
    spot.block(row(-half + 0.16, half - 0.16, cushions, 0.01), (0.2, 0.84), (seat - 0.1, seat))


def plant(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A pot with leaves to all sides, about 0.35 m around its middle."""
    spot = spot.shifted(0.0, 0.5 * size[1] - 0.005)
    pot, high = rng.uniform(0.28, 0.42), size[2]
    spot.poles((0.0, 0.0, 0.0, pot, rng.uniform(0.14, 0.19)), (0.0, 0.0, pot, 0.75 * high, 0.02))
    for _ in range(int(rng.integers(9, 15))):
        angle, rise = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.3, 1.2)
        direction = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
        side = np.array([-np.sin(angle), np.cos(angle), 0.0])
        length, root = rng.uniform(0.22, 0.34), np.array([0.0, 0.0, rng.uniform(pot, 0.78 * high)])
        leaf = (length, rng.uniform(0.06, 0.14), 0.012)
        R = np.stack([direction, side, np.cross(direction, side)], axis=1)
        spot.box(root + 0.5 * length * direction, leaf, R=R)


def board(spot: Builder, size: Size, rng: np.random.Generator, low: float = 0.1) -> None:  # noqa: ARG001
    """A white board, notice board or picture with a frame, 0.2 m less high than its space."""
    half, high = 0.5 * size[0], low + size[2] - 0.2
    spot.block((-half, half), (0.0, 0.02), (low, high))
    spot.block((-half, half), (0.02, 0.035), starting((low, high - 0.03), 0.03))


def pilaster(spot: Builder, size: Size, rng: np.random.Generator) -> None:  # noqa: ARG001
    """A pillar that stands out of the wall."""
    spot.block((-0.5 * size[0], 0.5 * size[0]), (-HAIR_M, size[1]), (0.0, size[2]))


def extinguisher(spot: Builder, size: Size, rng: np.random.Generator) -> None:  # noqa: ARG001
    """A fire extinguisher on its bracket."""
    spot.pole((0.0, 0.1), (0.05, 0.6), 0.075)
    spot.block((-0.04, 0.04), (0.0, 0.1), (0.3, 0.36))


def radiator(spot: Builder, width: float) -> None:
    """A ribbed radiator a hand's breadth above the floor, 0.12 m deep."""
    ribs = starting(np.arange(-0.5 * width, 0.5 * width - 0.05, 0.12), 0.09)
    spot.block(ribs, (0.04, 0.12), (0.12, 0.68))
    for z in (0.17, 0.62):
        spot.cylinder((-0.5 * width, 0.07, z), (0.5 * width, 0.07, z), 0.02)


# --- on floors


def chair(spot: Builder, rng: np.random.Generator) -> None:
    """A chair on five castors or four legs, its back towards +y of the spot."""
    seat = rng.uniform(0.43, 0.5)
    spot.blocks(
        (0.23, 0.23, seat, seat + 0.06), (-0.21, 0.21, 0.2, 0.26, seat + 0.12, seat + 0.52),
        (-0.03, 0.03, 0.2, 0.24, seat - 0.02, seat + 0.3),
    )  # fmt: skip
    if rng.random() < 0.6:
        spot.pole((0.0, 0.0), (0.08, seat), 0.03)
        for angle in np.arange(5) * 0.4 * np.pi:
            spot.cylinder((0.0, 0.0, 0.09), (0.29 * np.cos(angle), 0.29 * np.sin(angle), 0.04), 0.022)
    else:
        spot.poles(*((x, y, 0.0, seat, 0.017) for y in (-0.2, 0.2) for x in (-0.2, 0.2)))


def table(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A long table on two trestles, with a few things on it."""
    a, b = 0.5 * size[0], 0.5 * size[1]
    spot.block((-a, a), (-b, b), (0.72, 0.76))
    spot.block(around((-a + 0.3, a - 0.3), 0.04), (-b + 0.15, b - 0.15), (0.0, 0.72))
    for _ in range(int(rng.integers(0, 4))):
        x, y = rng.uniform(-a + 0.2, a - 0.2), rng.uniform(-b + 0.2, b - 0.2)
        thing = spot.shifted(x, y, 0.76, yaw=rng.uniform(0.0, 3.0))
        thing.block((-0.15, 0.15), (-0.11, 0.11), (0.0, rng.uniform(0.02, 0.25)))


def conference(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A long table with chairs along both sides."""
    width, depth = size[0], size[1] - 1.1
    table(spot, (width, depth, size[2]), rng)
    for x in np.arange(-0.5 * width + 0.35, 0.5 * width - 0.2, 0.68):
        for side in (0.0, np.pi):
            if rng.random() < 0.85:
                turned = spot.shifted(0.0, 0.0, yaw=side)
                chair(turned.shifted(x, 0.5 * depth + 0.22, yaw=rng.uniform(-0.2, 0.2)), rng)


def round_table(spot: Builder, size: Size, rng: np.random.Generator) -> None:  # noqa: ARG001
    """A round table on one foot, with a margin of 5 cm."""
    radius = 0.5 * size[0] - 0.05
    spot.poles((0.0, 0.0, 0.72, 0.75, radius), (0.0, 0.0, 0.02, 0.72, 0.045), (0.0, 0.0, 0.0, 0.02, 0.55 * radius))


def round_table_with_chairs(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A round table and three chairs."""
    radius = 0.5 * size[0] - 0.45
    round_table(spot, (2.0 * radius + 0.1, 2.0 * radius + 0.1, size[2]), rng)
    for angle in np.arange(3) * 2.1 + rng.uniform(0.0, 2.0):
        chair(spot.shifted(0.0, 0.0, yaw=angle).shifted(0.0, radius + 0.12), rng)


def screened_workplace(spot: Builder, size: Size, rng: np.random.Generator) -> None:  # noqa: ARG001
    """A workplace behind a free-standing screen with feet."""
    screen, height = spot.shifted(0.0, -0.77), rng.uniform(1.2, 1.5)
    screen.block((-0.75, 0.75), (-0.025, 0.025), (0.04, height))
    screen.block(around((-0.6, 0.6), 0.03), (-0.2, 0.2), (0.0, 0.04))
    workplace(spot.shifted(0.0, -0.72), (1.4, 1.5, 1.3), rng)


def crate(spot: Builder, size: Size, rng: np.random.Generator) -> None:  # noqa: ARG001
    """A closed box."""
    spot.blocks((0.5 * size[0], 0.5 * size[1], 0.0, size[2]))


def draw_railing(a: FloatArray, b: FloatArray, builder: Builder) -> None:
    """Posts every 1.5 m or so, a hand rail and a knee rail, from a to b (3,)."""
    length = float(np.linalg.norm(b - a))
    for t in np.linspace(0.0, 1.0, max(2, round(length / 1.6) + 1)):
        foot = a + t * (b - a)
        builder.cylinder(foot, foot + 1.1 * UP, 0.025)
    for z in (0.55, 1.1):
        builder.cylinder(a + z * UP, b + z * UP, 0.025)


Measure = float | tuple[float, float]  # a length, or the limits it is drawn between
Measures = tuple[Measure, Measure | None, Measure]  # a depth of None is the width


@dataclass(frozen=True)
class Pieces:
    """Pieces of one kind at the walls of a room or on its floor; number and size, or the limits they are drawn in."""

    piece: Piece
    count: int | tuple[int, int]
    size: Measures
    z: float = 0.0
    tries: int = 12
    is_on_floor: bool = False


@dataclass(frozen=True)
class Furnisher:
    """Places furniture where there is room for it."""

    builder: Builder
    clearance: Clearance
    rng: np.random.Generator

    def at(self, middle: FloatArray, size: Size, turned: bool, piece: Piece, gap_m: float) -> bool:
        """Draw a piece of that length, width and height with its middle at (3,); whether there was room for it."""
        reach = 0.5 * np.array([size[1], size[0]] if turned else [size[0], size[1]])
        low = np.append(middle[:2] - reach, middle[2] + 0.01)
        if not self.clearance.claim(low, np.append(middle[:2] + reach, middle[2] + size[2]), gap_m):
            return False
        yaw = 0.5 * np.pi * turned + np.pi * float(self.rng.integers(2))
        piece(self.builder.shifted(*middle, yaw=yaw), size, self.rng)
        return True

    def place(
        self, room: Room, size: Size, piece: Piece, z: float = 0.0, tries: int = 12, is_on_floor: bool = False
    ) -> bool:
        """Draw a piece of that width, depth and height at a wall from z up, or on the floor; whether there was room."""
        half, y = 0.5 * size[0], (-0.5 * size[1], 0.5 * size[1]) if is_on_floor else (0.0, size[1])
        for _ in range(tries):
            spot = self._on_floor(room, size) if is_on_floor else self._at_wall(room, size[0], z)
            if spot and self.clearance.claim(*spot.bounds((-half, half), y, (0.0, size[2]))):
                piece(spot, size, self.rng)
                return True
        return False

    def _at_wall(self, room: Room, width: float, z: float) -> Builder | None:
        inner = 0.5 * WALL_M + HAIR_M
        wall, length = room.at_wall(int(self.rng.integers(4)), self.builder)
        free = length - 2.0 * inner - width
        if free < 0.0:
            return None
        along = inner + 0.5 * width + free * float(self.rng.choice([0.0, 1.0, self.rng.random()]))
        return wall.shifted(along, inner, z)

    def _on_floor(self, room: Room, size: Size) -> Builder | None:
        turned = bool(self.rng.random() < 0.5)
        half = 0.5 * np.array(size[:2])[:: -1 if turned else 1]
        low, high = room.low + WALL_M + half, room.high - WALL_M - half
        if (low > high).any():
            return None
        return self.builder.shifted(*self.rng.uniform(low, high), yaw=0.5 * np.pi * turned)

    def some(self, room: Room, pieces: Pieces) -> None:
        """A number of pieces, each of its own size."""
        for _ in self.number(pieces.count):
            self.place(room, self.drawn(pieces.size), pieces.piece, pieces.z, pieces.tries, pieces.is_on_floor)

    def number(self, count: int | tuple[int, int]) -> range:
        """A range of that length, or of one within limits."""
        return range(count if isinstance(count, int) else int(self.rng.integers(*count)))

    def drawn(self, size: Measures) -> Size:
        """A size within limits."""
        width, depth, height = (self.rng.uniform(*one) if isinstance(one, tuple) else one or 0.0 for one in size)
        return width, depth or width, height


def furnish_room(room: Room, kind: str, put: Furnisher) -> None:
    """Fill a room after its kind, then hang a few boards or pictures."""
    for pieces in KINDS[kind]:
        if isinstance(pieces, Pieces):
            put.some(room, pieces)
        else:
            pieces(room, put)
    for _ in put.number((1, 4)):
        width, low = put.rng.uniform(0.6, 1.8), put.rng.uniform(0.95, 1.3)
        put.place(room, (width, 0.04, 1.0), board, z=low - 0.1)


def furnish_corridor(corridor: Room, height: float, put: Furnisher) -> None:
    """Pillars, lockers, plants, extinguishers and notice boards, as far as the route allows."""
    area = float((corridor.high - corridor.low).prod())
    put.some(corridor, Pieces(pilaster, int(area / 6.0), (0.35, (0.12, 0.2), height), tries=6))
    for _ in range(int(area / 6.0)):
        depth, width, tall = put.drawn(((0.25, 0.45), (0.6, 1.8), (0.8, 2.0)))
        put.place(corridor, (width, depth, tall), cabinet, tries=8)
    for _ in range(int(area / 9.0)):
        put.place(corridor, (0.2, 0.2, 0.7), extinguisher, z=0.3, tries=6)
        put.place(corridor, put.drawn(((0.5, 1.6), 0.05, 1.0)), partial(board, low=0.05), z=1.0, tries=6)
        put.place(corridor, (0.5, 0.5, 1.2), lambda spot, _, rng: plant(spot, (0.5, 0.45, 1.1), rng), tries=6)


def _conference(room: Room, put: Furnisher) -> None:
    longest = max(1.5, float((room.high - room.low).max()) - 2.4)
    any(put.place(room, put.drawn(((1.4, longest), (2.0, 2.4), 1.0)), conference, is_on_floor=True) for _ in range(3))


def _gas_bottles(room: Room, put: Furnisher) -> None:
    for _ in put.number((1, 4)):
        height, radius = put.rng.uniform(0.7, 1.6), put.rng.uniform(0.12, 0.25)
        rows = (0.0, 0.28, 0.0, height, radius), (0.0, 0.28, height, height + 0.1, 0.3 * radius)
        put.place(room, (0.55, 0.55, 1.7), lambda spot, _, __, rows=rows: spot.poles(*rows))  # type: ignore[misc]


_SHELF = (0.8, 1.4), (0.28, 0.42)
_CABINET = (0.5, 1.2), (0.4, 0.5)
_PLANT = 0.75, 0.75, (0.8, 1.6)
# What stands in a room of each kind, in the order of placing.
KINDS: dict[str, tuple[Pieces | Callable[[Room, Furnisher], None], ...]] = {
    "office": (
        Pieces(workplace, (2, 5), ((1.3, 1.8), (1.45, 1.6), 1.3)),
        Pieces(shelf, (1, 3), (*_SHELF, (1.7, 2.2))),
        Pieces(cabinet, (1, 3), (*_CABINET, (0.7, 1.5))),
        Pieces(plant, (0, 3), _PLANT),
    ),
    "meeting": (
        _conference,
        Pieces(cabinet, 1, (1.7, 0.4, 0.75)),
        Pieces(board, 1, (2.0, 0.05, 1.4), z=0.7),
        Pieces(spare_chair, 2, (0.6, 0.6, 1.1)),
        Pieces(plant, 2, _PLANT),
    ),
    "storage": (
        Pieces(shelf, 6, (*_SHELF, (2.0, 2.4))),
        Pieces(crate, (4, 9), ((0.3, 0.8), (0.3, 0.8), (0.3, 0.8)), is_on_floor=True),
    ),
    "kitchen": (
        Pieces(cabinet, 1, (0.62, 0.64, 1.85)),
        Pieces(counter, 1, ((1.6, 2.6), 0.64, 2.2), tries=30),
        Pieces(round_table_with_chairs, (1, 4), ((1.6, 2.0), None, 1.0), is_on_floor=True),
        Pieces(plant, 1, _PLANT),
    ),
    "laboratory": (
        Pieces(counter, 3, ((1.4, 2.4), 0.64, 2.2)),
        Pieces(table, 1, (1.8, 0.9, 1.1), is_on_floor=True),
        _gas_bottles,
        Pieces(cabinet, 2, (*_CABINET, (1.8, 2.1))),
    ),
    "lounge": (
        Pieces(sofa, (1, 4), ((1.3, 2.3), 0.9, 0.9)),
        Pieces(round_table, 1, (0.9, 0.9, 0.8), is_on_floor=True),
        Pieces(shelf, 1, (*_SHELF, (1.2, 1.9))),
        Pieces(plant, 4, _PLANT),
    ),
    "open_plan": (
        Pieces(screened_workplace, (2, 5), (1.5, 1.6, 1.5), tries=25, is_on_floor=True),
        Pieces(workplace, 2, (1.5, 1.5, 1.3)),
        Pieces(cabinet, 3, (*_CABINET, (0.9, 1.4))),
        Pieces(plant, 1, _PLANT),
    ),
}
