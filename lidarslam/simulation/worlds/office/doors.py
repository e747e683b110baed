"""Doors of an office floor, and the way that leads through some of them into rooms and out again."""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Route
from lidarslam.simulation.worlds.office.plan import CORRIDOR, Plan, Room, WallLine
from lidarslam.simulation.worlds.paths import loop_length

# How long the route may get, drawn between these.
_ROUTE_LENGTHS_M = (76.0, 89.0)
_FREE_SIDE_M = 0.4
DOOR_HEIGHT_M = 2.12
# From a wall's middle line to where a walker would turn.
_TURN_M = 1.0


@dataclass(frozen=True)
class Door:
    """A door from a corridor into a room."""

    wall: int  # index of the wall that it is in
    along: float  # of its middle, from the wall's start
    width: float  # clear
    room: int  # label
    opened: float  # angle of the leaf, 0 when closed
    hinge: float  # +1 or -1, the side that it hangs on, along the wall


@dataclass(frozen=True)
class _Visit:
    """A way (K, 2) from a leg of the loop into a room, around in it, and back to the same point."""

    door: Door
    leg: int
    along: float
    path: FloatArray

    @property
    def length(self) -> float:
        return loop_length(self.path)

    def excludes(self, other: "_Visit") -> bool:
        """Whether two visits are to the same room, or branch off the loop too close to one another."""
        is_close = self.leg == other.leg and abs(self.along - other.along) < 1.0
        return self.door.room == other.door.room or is_close


def into_room(wall: WallLine) -> FloatArray:
    """(2,) unit vector from the corridor into the room at a wall that has one to each side."""
    return wall.to_left if wall.right == CORRIDOR else -wall.to_left


def draw_doors(plan: Plan, rng: np.random.Generator) -> tuple[list[Door], Route]:
    """A door or two for every room, and the route, which goes through open ones as long as it does not get too long."""
    candidates: list[Door] = []
    for label in plan.rooms:
        walls = [k for k, w in enumerate(plan.walls) if {w.left, w.right} == {CORRIDOR, label} and w.length > 1.75]
        if not walls:
            continue
        for k in rng.permutation(walls)[: 2 if rng.random() < 0.25 else 1]:
            along = rng.uniform(0.85, plan.walls[k].length - 0.85)
            opened = rng.choice([0.0, rng.uniform(0.3, 1.1), rng.uniform(1.6, 1.8)], p=[0.45, 0.25, 0.3])
            candidates.append(Door(int(k), along, rng.uniform(0.85, 1.1), label, opened, rng.choice([-1.0, 1.0])))
    visits = _choose_visits(plan, candidates, rng)
    # A second door into a visited room is shut: its leaf would stand in the way.
    visited = {visit.door.room for visit in visits.values()}
    others = [replace(door, opened=0.0) if door.room in visited else door for door in candidates]
    doors = [visits[k].door if k in visits else door for k, door in enumerate(others)]
    parts: list[FloatArray] = []
    for leg, corner in enumerate(plan.loop):
        visited_here = sorted((v for v in visits.values() if v.leg == leg), key=lambda v: v.along)
        parts += [corner[None], *(visit.path for visit in visited_here)]
    way = np.concatenate(parts)
    waypoints = np.column_stack([way, np.zeros(len(way))])
    return doors, Route(waypoints, 0.3, _FREE_SIDE_M, DOOR_HEIGHT_M - 0.07, 1.2)


def _choose_visits(plan: Plan, doors: list[Door], rng: np.random.Generator) -> dict[int, _Visit]:
    """Visits by the index of their door: in random order while the route has length to spare."""
    length = loop_length(plan.loop)
    longest = rng.uniform(*_ROUTE_LENGTHS_M)
    chosen: dict[int, _Visit] = {}
    for k in rng.permutation(len(doors)):
        visit = _visit(plan, doors[k], rng)
        if visit is None or length + visit.length > longest or any(map(visit.excludes, chosen.values())):
            continue
        chosen[int(k)] = visit
        length += visit.length
    return chosen


def _visit(plan: Plan, door: Door, rng: np.random.Generator) -> _Visit | None:
    """The way in through a door and around a rectangle, or None where room or loop does not allow it."""
    wall, room = plan.walls[door.wall], plan.rooms[door.room]
    threshold, inwards = wall.a + door.along * wall.direction, into_room(wall)
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
    # The leaf hangs on the side that the way does not turn to, and lies back against the wall.
    open_door = Door(door.wall, door.along, rng.uniform(1.1, 1.2), door.room, rng.uniform(1.65, 1.8), -side)
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
