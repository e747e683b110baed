"""An office floor: corridors that close a loop around sharp corners, and rooms off them."""

from dataclasses import dataclass
from itertools import combinations, groupby, product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Route, World
from lidarslam.simulation.worlds.building import HAIR_M, UP, Builder, Opening, Room, heading, left_of
from lidarslam.simulation.worlds.interior import KINDS, WALL_M, Furnisher, furnish_corridor, furnish_room, radiator
from lidarslam.simulation.worlds.paths import Clearance, loop_length

_CORRIDOR, _OUTSIDE, _UNKNOWN = 0, -1, -2
# The grid's columns and rows that can be corridors; the others are rooms. Nodes are where two of them cross.
_COLUMNS, _ROWS = (1, 4, 7), (1, 3, 5)
_LOOPS: tuple[tuple[tuple[int, int], ...], ...] = (
    ((0, 0), (2, 0), (2, 2), (0, 2)),
    ((0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)),
    ((0, 0), (1, 0), (1, 2), (2, 2), (2, 1), (0, 1)),
    ((0, 0), (2, 0), (2, 2), (1, 2), (1, 1), (0, 1)),
)

Labels = npt.NDArray[np.int64]
Span = tuple[int, int]


@dataclass(frozen=True)
class WallLine:
    """A straight wall's middle line from a to b (2,), and the labels to its left and right, seen from a to b."""

    a: FloatArray
    b: FloatArray
    left: int
    right: int

    @property
    def length(self) -> float:
        """Distance from a to b."""
        return float(np.linalg.norm(self.b - self.a))

    @property
    def direction(self) -> FloatArray:
        """(2,) unit vector from a to b."""
        return np.asarray((self.b - self.a) / self.length)

    @property
    def inwards(self) -> float:
        """On which side of a wall between a corridor and a room the room is: 1 to the left, -1 to the right."""
        return 1.0 if self.right == _CORRIDOR else -1.0


class Plan(NamedTuple):
    """A floor plan."""

    loop: FloatArray  # (M, 2) corners of the closed path along the middle of the corridors
    corridors: tuple[Room, ...]  # overlapping where they cross
    rooms: dict[int, Room]  # by label
    walls: tuple[WallLine, ...]  # every wall once
    extent: Room


def draw_plan(rng: np.random.Generator) -> Plan:
    """A plan that is different for each seed."""
    xs = _grid_lines(rng, "rcrrcrrcr", (2.7, 3.6))
    ys = _grid_lines(rng, "rcrcrcr", (3.3, 4.3))
    nodes = list(_LOOPS[int(rng.integers(len(_LOOPS)))])
    mirror_i, mirror_j, backwards = rng.random(3) < 0.5
    nodes = [(2 - i if mirror_i else i, 2 - j if mirror_j else j) for i, j in nodes][:: -1 if backwards else 1]
    labels = np.full((9, 7), _UNKNOWN)
    spans = _corridor_spans(nodes, rng)
    for (i0, i1), (j0, j1) in spans:
        labels[i0:i1, j0:j1] = _CORRIDOR
    _label_rooms(labels, rng)

    def between(columns: Span, rows: Span) -> Room:
        return Room(np.array([xs[columns[0]], ys[rows[0]]]), np.array([xs[columns[1]], ys[rows[1]]]))

    cells = [between((_COLUMNS[i], _COLUMNS[i] + 1), (_ROWS[j], _ROWS[j] + 1)) for i, j in nodes]
    rooms = {}
    for label in np.unique(labels[labels > _CORRIDOR]).tolist():
        i, j = np.nonzero(labels == label)
        rooms[label] = between((i.min(), i.max() + 1), (j.min(), j.max() + 1))
    loop = np.array([0.5 * (cell.low + cell.high) for cell in cells])
    corridors = tuple(between(*span) for span in spans)
    return Plan(loop, corridors, rooms, _walls(xs, ys, labels), between((0, -1), (0, -1)))


def _grid_lines(rng: np.random.Generator, kinds: str, block_m: tuple[float, float]) -> FloatArray:
    """Grid lines from the kinds of space between them: (r)oom or (c)orridor; the outer rooms are deeper."""
    sizes = [rng.uniform(1.6, 2.4) if kind == "c" else rng.uniform(*block_m) for kind in kinds]
    sizes[0], sizes[-1] = rng.uniform(3.6, 5.2, 2)
    return np.concatenate([[0.0], np.cumsum(sizes)])


def _corridor_spans(nodes: list[tuple[int, int]], rng: np.random.Generator) -> list[tuple[Span, Span]]:
    """Cell ranges ((i0, i1), (j0, j1)) of the loop's corridors, and of side corridors that branch off."""
    legs = list(zip(nodes, nodes[1:] + nodes[:1], strict=True))
    for i, j in nodes:
        legs += [((i, j), other) for other in ((1, j), (i, 1)) if other != (i, j) and rng.random() < 0.25]
    spans = set()
    for (i0, j0), (i1, j1) in legs:
        columns, rows = (_COLUMNS[i0], _COLUMNS[i1]), (_ROWS[j0], _ROWS[j1])
        spans.add(((min(columns), max(columns) + 1), (min(rows), max(rows) + 1)))
    return sorted(spans)


def _label_rooms(labels: Labels, rng: np.random.Generator) -> None:
    """Give every cell that is not corridor to a rectangular room; a room that touches no corridor lies outside.

    A cell in a corridor's column that is none always joins the one before, others do at times.
    """
    label, always = 0, (_COLUMNS[0], _COLUMNS[1], _COLUMNS[2] + 1)
    for j in range(labels.shape[1]):
        for i in np.flatnonzero(labels[:, j] == _UNKNOWN):
            has_room_before = i > 0 and labels[i - 1, j] > _CORRIDOR
            joins = has_room_before and (i in always or (i - 1 not in _COLUMNS and rng.random() < 0.45))
            label += not joins
            labels[i, j] = label
    padded = np.pad(labels, 1, constant_values=_OUTSIDE) == _CORRIDOR
    touches = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    labels[(labels > _CORRIDOR) & ~np.isin(labels, labels[touches])] = _OUTSIDE


def _walls(xs: FloatArray, ys: FloatArray, labels: Labels) -> tuple[WallLine, ...]:
    """A wall wherever two labels meet, as long as the two stay the same."""
    padded = np.pad(labels, 1, constant_values=_OUTSIDE)
    walls: list[WallLine] = []
    along_y = (xs, ys, padded[:-1, 1:-1], padded[1:, 1:-1])
    along_x = (ys, xs, padded[1:-1, 1:].T, padded[1:-1, :-1].T)
    for order, (lines, ends, lefts, rights) in ((1, along_y), (-1, along_x)):
        for at, left, right in zip(lines, lefts, rights, strict=True):
            start = 0
            for pair, members in groupby(zip(left.tolist(), right.tolist(), strict=True)):
                stop = start + len(list(members))
                if pair[0] != pair[1]:
                    a, b = (np.array([at, end][::order]) for end in (ends[start], ends[stop]))
                    walls.append(WallLine(a, b, *pair))
                start = stop
    return tuple(walls)


# Limits between which the largest length of the route is drawn.
_ROUTE_LENGTHS_M = (76.0, 89.0)
_DOOR_HEIGHT_M = 2.12
# From a wall's middle line to where a walker would turn.
_TURN_M = 1.0


class Door(NamedTuple):
    """A door from a corridor into a room."""

    wall: WallLine
    along: float  # of its middle, from the wall's start
    width: float  # clear
    room: int  # label
    opened: float  # angle of the leaf, 0 when closed
    hinge: float  # +1 or -1, the side that it hangs on, along the wall


class _Visit(NamedTuple):
    """A path (K, 2) from a leg of the loop into a room, around in it, and back to the same point."""

    door: Door
    leg: int
    along: float
    path: FloatArray


def draw_doors(plan: Plan, rng: np.random.Generator) -> tuple[list[Door], Route]:
    """A door or two for every room, and the route, which leads through open ones up to its largest length."""
    doors: list[Door] = []
    for label in plan.rooms:
        walls = [k for k, w in enumerate(plan.walls) if {w.left, w.right} == {_CORRIDOR, label} and w.length > 1.75]
        if not walls:
            continue
        for wall in (plan.walls[k] for k in rng.permutation(walls)[: 2 if rng.random() < 0.25 else 1]):
            along = rng.uniform(0.85, wall.length - 0.85)
            opened = rng.choice([0.0, rng.uniform(0.3, 1.1), rng.uniform(1.6, 1.8)], p=[0.45, 0.25, 0.3])
            doors.append(Door(wall, along, rng.uniform(0.85, 1.1), label, opened, rng.choice([-1.0, 1.0])))
    # Visits by the index of their door: in random order up to the route's largest length, one to a room, and none too
    # close on the loop to another.
    length, longest = loop_length(plan.loop), rng.uniform(*_ROUTE_LENGTHS_M)
    visits: dict[int, _Visit] = {}
    for k in rng.permutation(len(doors)).tolist():
        visit = _visit(plan, doors[k], rng)
        if visit is None or any(
            visit.door.room == other.door.room or (visit.leg == other.leg and abs(visit.along - other.along) < 1.0)
            for other in visits.values()
        ):
            continue
        if length + loop_length(visit.path) <= longest:
            visits[k] = visit
            length += loop_length(visit.path)
    # A second door into a visited room is shut: its leaf would obstruct the route.
    visited = {visit.door.room for visit in visits.values()}
    doors = [door._replace(opened=0.0) if door.room in visited else door for door in doors]
    doors = [visits[k].door if k in visits else door for k, door in enumerate(doors)]
    parts: list[FloatArray] = []
    for leg, corner in enumerate(plan.loop):
        visited_here = sorted((v for v in visits.values() if v.leg == leg), key=lambda v: v.along)
        parts += [corner[None], *(visit.path for visit in visited_here)]
    way = np.concatenate(parts)
    return doors, Route(np.column_stack([way, np.zeros(len(way))]), 0.3, 0.4, _DOOR_HEIGHT_M - 0.07, 1.2)


def _visit(plan: Plan, door: Door, rng: np.random.Generator) -> _Visit | None:
    """The path in through a door and around a rectangle, or None where room or loop does not allow it."""
    wall, room = door.wall, plan.rooms[door.room]
    threshold, inwards = wall.a + door.along * wall.direction, wall.inwards * left_of(wall.direction)
    leg = _leg_at(plan.loop, threshold, inwards)
    sides = _extent(room, threshold, wall.direction)
    side = 1.0 if sides[1] > -sides[0] else -1.0
    across = max(sides[1], -sides[0]) - _TURN_M
    depth = _extent(room, threshold, inwards)[1] - _TURN_M
    if leg is None or across < 1.2 or depth < _TURN_M + 0.9:
        return None
    index, start, along = leg
    across, depth = min(across, rng.uniform(1.6, 2.6)), min(depth, rng.uniform(2.4, 3.4))
    near, far, aside = threshold + _TURN_M * inwards, threshold + depth * inwards, across * (side * wall.direction)
    path = np.stack([start, near, near + aside, far + aside, far, start])
    # The leaf hangs on the side that the path does not turn to, and opens back to the wall.
    open_door = door._replace(width=rng.uniform(1.1, 1.2), opened=rng.uniform(1.65, 1.8), hinge=-side)
    return _Visit(open_door, index, along, path)


def _leg_at(loop: FloatArray, threshold: FloatArray, inwards: FloatArray) -> tuple[int, FloatArray, float] | None:
    """(leg, point on it, distance along it) of the loop's leg that runs past a door, well away from its ends."""
    for leg, (a, b) in enumerate(zip(loop, np.roll(loop, -1, axis=0), strict=True)):
        direction = (b - a) / np.linalg.norm(b - a)
        along = float((threshold - a) @ direction)
        aside = float((threshold - a - along * direction) @ inwards)
        if abs(direction @ inwards) < 0.5 and 0.6 < aside < 1.5 and 0.9 < along < np.linalg.norm(b - a) - 0.9:
            return leg, a + along * direction, along
    return None


def _extent(room: Room, origin: FloatArray, direction: FloatArray) -> tuple[float, float]:
    """How far the room reaches from the origin against and along an axis-parallel direction."""
    ends = sorted(((room.low - origin) @ direction, (room.high - origin) @ direction))
    return float(ends[0]), float(ends[1])


_FACADE_M = 0.36
_FRAME_M = 0.06
_SILL_M, _LINTEL_M = 0.92, 2.2


def office(seed: int) -> World:
    """The office of that seed; the floor is at z = 0, the route 40 to 90 m long and into some of the rooms."""
    rng = np.random.default_rng(seed)
    plan = draw_plan(rng)
    doors, route = draw_doors(plan, rng)
    height = rng.uniform(2.6, 3.2)
    builder, clearance = Builder(), Clearance(route)
    for z in (-0.15, height + 0.15):
        low, high = plan.extent.low - 1.0, plan.extent.high + 1.0
        builder.box((*(0.5 * (low + high)), z), (*(high - low), 0.3))
    for wall in plan.walls:
        _draw_wall(wall, [door for door in doors if door.wall is wall], height, builder, clearance)
    put = Furnisher(builder, clearance, rng)
    for one, other in combinations(plan.corridors, 2):  # where they cross, there is only floor
        low, high = np.maximum(one.low, other.low), np.minimum(one.high, other.high)
        if (low < high).all():
            clearance.take(np.append(low - 0.1, 0.0), np.append(high + 0.1, height))
    for corridor in plan.corridors:
        _draw_corridor_ceiling(corridor, height, builder, rng)
        furnish_corridor(corridor, height, put)
    kinds: list[str] = []
    for room in plan.rooms.values():
        # Every kind occurs once before any occurs again.
        kinds = kinds or list(rng.permutation(list(KINDS)))
        kind = kinds.pop()
        for _ in range(max(1, round(float((room.high - room.low).prod()) / 13.0))):
            furnish_room(room, kind, put)
        draw_room_ceiling(room, height, builder, rng)
    return World("office", seed, route, *builder.solids)


def _draw_wall(wall: WallLine, doors: list[Door], height: float, builder: Builder, clearance: Clearance) -> None:
    spot = builder.shifted(*wall.a, yaw=heading(wall.direction))  # y to the wall's left
    if _OUTSIDE in (wall.left, wall.right):
        _draw_facade(spot, wall, height, clearance)
        return
    clear = [(door.along, 0.5 * door.width + _FRAME_M) for door in doors]
    openings = [Opening((along - half, along + half), (0.0, _DOOR_HEIGHT_M + _FRAME_M)) for along, half in clear]
    half = 0.5 * WALL_M
    spot.pierced_wall((-half + HAIR_M, wall.length + half - HAIR_M), (-half, half), height, openings)
    for door in doors:
        _draw_door(spot, door, clearance)


def _draw_door(spot: Builder, door: Door, clearance: Clearance) -> None:
    """Frame and leaf; the swing and the entrance are kept free of furniture."""
    inwards = door.wall.inwards
    half, reach, top = 0.5 * door.width, 0.5 * WALL_M + 0.02, _DOOR_HEIGHT_M + _FRAME_M + 0.03
    for side in (-1.0, 1.0):
        jamb = (door.along + side * half, door.along + side * (half + _FRAME_M + 0.03))
        spot.block(jamb, (-reach, reach), (0.0, top))
    spot.block((door.along - half, door.along + half), (-reach, reach), (_DOOR_HEIGHT_M, top))
    # The leaf's frame: x from the hinge to the other jamb, y towards the room when closed.
    yaw = (np.pi if door.hinge > 0.0 else 0.0) - door.hinge * inwards * door.opened
    leaf = spot.shifted(door.along + door.hinge * half, inwards * (0.5 * WALL_M - 0.03), yaw=yaw)
    leaf.block((0.005, door.width - 0.005), (-0.022, 0.022), (0.01, _DOOR_HEIGHT_M - 0.01))
    leaf.block((door.width - 0.12, door.width - 0.07), (-0.07, 0.07), (1.0, 1.03))
    before, behind = spot.point(door.along - half, -0.6 * inwards, 0.0), spot.point(door.along + half, inwards, 0.0)
    for a, b in ((before, behind), (leaf.origin, leaf.point(door.width, 0.0, 0.0))):
        around = np.array([0.05, 0.05, 0.0])
        clearance.take(np.minimum(a, b) - around, np.maximum(a, b) + around + _DOOR_HEIGHT_M * UP)


def _draw_facade(spot: Builder, wall: WallLine, height: float, clearance: Clearance) -> None:
    """An outer wall: windows in recesses with a bar down their middle, a radiator below each."""
    inwards = -1.0 if wall.left == _OUTSIDE else 1.0
    inner, outer = inwards * 0.5 * WALL_M, inwards * (0.5 * WALL_M - _FACADE_M)
    count = int(wall.length // 2.1)
    half = 0.5 * (0.62 * wall.length / max(count, 1))
    middles = (np.arange(count) + 0.5) * wall.length / max(count, 1)
    holes = [Opening((m - half, m + half), (_SILL_M, _LINTEL_M)) for m in middles]
    # Outer corners are closed by both walls reaching past the grid point.
    spot.pierced_wall((-0.4 * _FACADE_M, wall.length + 0.4 * _FACADE_M), (inner, outer), height, holes)
    for m, hole in zip(middles, holes, strict=True):
        spot.block(hole.x, (outer + 0.06 * inwards, outer + 0.09 * inwards), hole.z)
        spot.block((m - 0.035, m + 0.035), (outer + 0.04 * inwards, outer + 0.13 * inwards), hole.z)
        spot.block((m - half - 0.05, m + half + 0.05), (outer, inner + 0.09 * inwards), (_SILL_M - 0.03, _SILL_M))
        foot = spot.shifted(m, inner, yaw=0.0 if inwards > 0.0 else np.pi)
        if clearance.claim(*foot.bounds((-half, half), (0.0, 0.14), (0.0, 0.75))):
            radiator(foot, 2.0 * half)


def _draw_corridor_ceiling(corridor: Room, height: float, builder: Builder, rng: np.random.Generator) -> None:
    """Beams across a corridor, lamps between them, and a duct or a cable tray along it."""
    size = corridor.high - corridor.low
    spot, length = corridor.at_wall(int(size[1] > size[0]), builder)
    width = float(size.min())
    inner = (0.5 * WALL_M, width - 0.5 * WALL_M)
    spacing, depth = rng.uniform(2.2, 3.4), rng.uniform(0.12, 0.28)
    for x in np.arange(0.5 * spacing, length, spacing):
        spot.block((x - 0.1, x + 0.1), inner, (height - depth, height))
        lamp = x + 0.5 * spacing
        if lamp + 0.6 < length:
            spot.block((lamp - 0.6, lamp + 0.6), (0.5 * width - 0.09, 0.5 * width + 0.09), (height - 0.09, height))
    side = inner[0] + 0.2 if rng.random() < 0.5 else inner[1] - 0.2
    if rng.random() < 0.6:
        z = height - depth - 0.13
        spot.cylinder((0.3, side, z), (length - 0.3, side, z), 0.12)
    else:
        spot.block((0.3, length - 0.3), (side - 0.12, side + 0.12), (height - depth - 0.07, height - depth - 0.01))


def draw_room_ceiling(room: Room, height: float, builder: Builder, rng: np.random.Generator) -> None:
    """Rows of lamps, and at times a beam across."""
    size = room.high - room.low
    drop = rng.choice([0.0, rng.uniform(0.12, 0.3)])
    spot = builder.shifted(*room.low, height)
    xs, ys = ((np.arange(max(1, span // 2)) + 0.5) * span / max(1, span // 2) for span in size)
    for x, y in product(xs, ys):
        spot.block((x - 0.15, x + 0.15), (y - 0.55, y + 0.55), (-drop - 0.07, -drop))
        for hanger in (y - 0.4, y + 0.4) if drop > 0.0 else ():
            spot.pole((x, hanger), (-drop, 0.0), 0.008)
    if rng.random() < 0.5:
        x = rng.uniform(0.3, 0.7) * size[0]
        spot.block((x - 0.15, x + 0.15), (0.5 * WALL_M, size[1] - 0.5 * WALL_M), (-rng.uniform(0.2, 0.35), 0.0))
