"""A foyer full of people: some walk with the carrier, others stand or cross its path."""

from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.simulation.world import Mover, Route, World
from lidarslam.simulation.worlds import interior, outdoor, paths
from lidarslam.simulation.worlds.building import OUTER_WALL_M, Builder, Opening, Room, left_of, rotation_z, starting
from lidarslam.simulation.worlds.interior import Furnisher, Pieces
from lidarslam.simulation.worlds.office import draw_room_ceiling
from lidarslam.simulation.worlds.paths import Clearance

# The route's limit: every carrier that walks or drives keeps it, and so do those who walk with it.
SPEED_MPS = 0.9
COMPANIONS, STANDING, CROSSING = 15, 8, 7
_ROUTE_FROM_WALLS_M, _FREE_SIDE_M, _FREE_HEIGHT_M = 5.2, 0.6, 2.2
_CROWD_SIDE_M = 3.4  # how far from the route the people are; furniture is farther
_LANES_M = (-2.1, -1.15, 1.15, 2.1)
_SLOTS_M = np.arange(-6.0, 6.5, 1.6)  # ahead of the carrier
_JITTER_M = 0.15
# A carrier rests and then accelerates, while those who walk with it already move: by this much they are ahead then.
_HEAD_START_M = 1.9


def crowd(seed: int) -> World:
    """The foyer of that seed; the floor is at z = 0, and at the start of the first lap thirty people are near."""
    rng = np.random.default_rng(seed)
    room, height = Room(np.zeros(2), rng.uniform([26.0, 20.0], [32.0, 24.0])), rng.uniform(3.6, 5.0)
    low, high = room.low + _ROUTE_FROM_WALLS_M, room.high - _ROUTE_FROM_WALLS_M
    corners = np.array([[low[0], low[1], 0.0], [high[0], low[1], 0.0], [*high, 0.0], [low[0], high[1], 0.0]])
    route = Route(corners, 0.8, _FREE_SIDE_M, _FREE_HEIGHT_M, SPEED_MPS)
    builder = Builder()
    # Floor, ceiling with lamps, and walls with windows on two sides.
    outer_low, outer_high = room.low - OUTER_WALL_M, room.high + OUTER_WALL_M
    builder.block((outer_low[0], outer_high[0]), (outer_low[1], outer_high[1]), starting((-0.2, height), 0.2))
    draw_room_ceiling(room, height, builder, rng)
    for side in range(4):
        wall, length = room.at_wall(side, builder)
        wide = rng.uniform(1.6, 3.0)
        places = np.arange(1.5, length - wide - 1.0, wide + 1.2)[: 20 * (side < 2)]
        windows = [Opening((float(x), float(x) + wide), (0.8, height - 0.7)) for x in places]
        wall.glazed_wall((-OUTER_WALL_M, length + OUTER_WALL_M), height, windows)
    put = Furnisher(builder, Clearance(replace(route, free_side_m=_CROWD_SIDE_M + 0.4)), rng)
    _furnish(room, height, put)
    return World("crowd", seed, route, *builder.solids, movers=draw_people(route, rng))


def _furnish(room: Room, height: float, put: Furnisher) -> None:
    pillar = Pieces(interior.crate, 1, (0.5, 0.5, height), tries=60, is_on_floor=True)
    table = Pieces(interior.round_table, 1, (0.9, 0.9, 0.8), tries=60, is_on_floor=True)
    for pieces in (
        Pieces(interior.pilaster, 10, (0.4, (0.15, 0.3), height)),
        Pieces(interior.counter, 1, (4.0, 0.7, 2.2)),
        *[pillar, table] * 4,
        Pieces(interior.sofa, (3, 6), ((1.3, 2.3), 0.9, 0.9)),
        Pieces(interior.cabinet, (4, 8), ((0.6, 1.8), (0.3, 0.5), (0.8, 2.0))),
        Pieces(interior.plant, (4, 8), (0.75, 0.75, (0.8, 1.6))),
        Pieces(interior.board, 8, ((0.6, 1.8), 0.04, 1.0), z=1.0),
    ):
        put.some(room, pieces)


def draw_people(route: Route, rng: np.random.Generator) -> tuple[Mover, ...]:
    """Those who walk along, those who stand and those who cross, in this order.

    Those who walk along stay at a distance from the route. Those who cross it to and fro are at one end of their path
    when the carrier passes on its first lap.
    """
    xy = route.waypoints[:, :2]
    loop = np.concatenate([[0.5 * (xy[0] + xy[1])], xy[1:], xy[:1]])  # from where a lap begins
    ahead = (loop[1] - loop[0]) / np.linalg.norm(loop[1] - loop[0])
    slots = [(lane, slot) for lane in _LANES_M for slot in _SLOTS_M]
    people = []
    for k in rng.permutation(len(slots))[:COMPANIONS]:
        lane, slot = np.array(slots[int(k)]) + rng.uniform(-_JITTER_M, _JITTER_M, 2)
        line = paths.offset_loop(loop, lane)
        people.append(_person(rng, line, SPEED_MPS, slot - _HEAD_START_M))
    for along in np.linspace(-6.0, 6.0, STANDING) + rng.uniform(-0.5, 0.5, STANDING):
        where = loop[0] + along * ahead + rng.choice([-1.0, 1.0]) * rng.uniform(2.8, _CROWD_SIDE_M) * left_of(ahead)
        people.append(_person(rng, where[None], 0.0, 0.0))
    for along in np.linspace(3.0, 0.4 * np.linalg.norm(loop[1] - loop[-1]), CROSSING):
        ends = loop[0] + along * ahead + np.outer(rng.permutation([-1.0, 1.0]), 3.0 * left_of(ahead))
        speed = rng.uniform(0.9, 1.4)
        people.append(_person(rng, ends, speed, -speed * (along + _HEAD_START_M) / SPEED_MPS))
    return tuple(people)


def _person(rng: np.random.Generator, line: FloatArray, speed_mps: float, start_m: float) -> Mover:
    """A pedestrian on a closed line (M, 2); one who stands looks anywhere."""
    part = Builder()
    yaw = 0.0 if speed_mps else rng.uniform(-np.pi, np.pi)
    part.place(outdoor.pedestrian(rng), make_transform(rotation_z(yaw), np.zeros(3)))
    return Mover(part.boxes, np.column_stack([line, np.zeros(len(line))]), speed_mps, start_m)
