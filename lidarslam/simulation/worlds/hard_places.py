"""Indoor places where odometry is hard: a bare corridor, a stairwell, a foyer full of people."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray, make_transform, rotation_z
from lidarslam.simulation.world import HeightField, Mover, Route, World
from lidarslam.simulation.worlds import building, interior, outdoor, paths
from lidarslam.simulation.worlds.building import OUTER_WALL_M, Builder, Opening, Room
from lidarslam.simulation.worlds.interior import Furnisher, Pieces, draw_railing
from lidarslam.simulation.worlds.office import draw_room_ceiling
from lidarslam.simulation.worlds.outdoor import Grounds
from lidarslam.simulation.worlds.paths import Clearance

_WIDTH_M, _HEIGHT_M = 2.0, 2.6
_BOXES = 12
_DEEPEST_BOX_M = 0.45  # leaves the route's free side free
_FRONT_M = 5.5  # height of the building that the corridor leads out of
_ENTRY_M, _FROM_WALLS_M = 4.0, 5.5  # the path round the yard: distance from the mouth, and from the other sides


def corridor(seed: int) -> World:
    """The corridor of that seed, 24 to 40 m long, and its yard; the route leads out, round the yard and back in.

    The corridor's middle is x from -length to 0 at y = 0; there the yard begins.
    """
    rng, cell = np.random.default_rng(seed), 0.5
    length, depth, width = rng.uniform(24.0, 40.0), rng.uniform(25.0, 40.0), rng.uniform(25.0, 40.0)
    yard = Room(np.array([0.0, -0.5 * width]), np.array([depth, 0.5 * width]))
    # Level in the corridor and along the front, a little uneven in the yard.
    low, nodes = paths.grid_around(np.array([yard.low - [length, 0.0], yard.high]), 12.0, cell)
    hills = building.relief(rng, nodes.shape[:2], (0.12, 8.0 / cell), (0.01, 0.7))
    ground = HeightField(low, cell, hills * np.clip((nodes[..., 0] - 1.0) / 4.0, 0.0, 1.0))
    route = _corridor_route(length, yard, ground)
    grounds = Grounds(rng, route.waypoints[:, :2], ground)
    _draw_corridor(length, grounds.solid, rng)
    _draw_yard(yard, grounds)
    _plant_yard(yard, grounds, Clearance(route))
    grounds.prune(route)
    return World("corridor", seed, route, *grounds.solid.solids, (ground,))


def _corridor_route(length: float, yard: Room, ground: HeightField) -> Route:
    """Its longest leg, in whose middle recordings begin, is deep in the corridor and leads out."""
    far, aside = yard.high - _FROM_WALLS_M
    corners = np.array([[_ENTRY_M, -aside], [far, -aside], [far, aside], [_ENTRY_M, aside]])
    entry, inside = np.array([[_ENTRY_M, 0.0]]), np.array([[1.2 - length, 0.0], [-0.25 * length, 0.0]])
    loop = paths.subdivide_loop(np.concatenate([entry, paths.round_corners(corners, np.full(4, 3.0), 1.0)]), 4.0)
    way = np.concatenate([inside, loop, entry, inside[1:]])
    return Route(paths.on_ground(way, ground), 0.3, 0.45, 2.2, 1.6)


def _draw_corridor(length: float, solid: Builder, rng: np.random.Generator) -> None:
    """Walls, ceiling and the closed end; boxes against the walls at uneven distances, all different."""
    half, top = 0.5 * _WIDTH_M, _HEIGHT_M + OUTER_WALL_M
    solid.block((-length, 0.0), building.starting((-half - OUTER_WALL_M, half), OUTER_WALL_M), (-0.3, top))
    solid.blocks(
        (-length, 0.0, half, _HEIGHT_M, top), (-length - OUTER_WALL_M, -length, half + OUTER_WALL_M, -0.3, top)
    )
    for k in range(_BOXES):
        x = -length + (k + rng.uniform(0.25, 0.75)) * length / _BOXES
        long, deep, high = rng.uniform([0.3, 0.3, 0.3], [0.8, _DEEPEST_BOX_M, 0.8])
        y = rng.choice([-1.0, 1.0]) * (half - 0.5 * deep - building.HAIR_M)
        solid.box((x, y, 0.5 * high), (long, deep, high))


def _draw_yard(yard: Room, grounds: Grounds) -> None:
    """A front with windows next to the corridor's mouth, walls of different heights, a house on every other side."""
    rng, (depth, half) = grounds.rng, yard.high
    mouth = Opening(
        (half - 0.5 * _WIDTH_M - building.HAIR_M, half + 0.5 * _WIDTH_M + building.HAIR_M),
        (0.0, _HEIGHT_M + building.HAIR_M),
    )
    places = [x for x in np.arange(2.0, 2.0 * half - 3.0, 3.2) if abs(x + 0.7 - half) > _WIDTH_M]
    windows = [Opening((x, x + 1.4), (1.0, 2.4)) for x in places]
    front = grounds.solid.shifted(0.0, half, yaw=-0.5 * np.pi)
    front.glazed_wall((0.0, 2.0 * half), _FRONT_M, windows, mouth)
    for a, b in pairwise(np.array([[0.0, -half], [depth, -half], [depth, half], [0.0, half]])):
        grounds.solid.wall(a, b, (-1.0, rng.uniform(1.8, 3.2)), 0.25)
    left, far, right = rng.uniform(8.0, 12.0, 3)
    x = rng.uniform(2.0, depth - 13.0, 2)
    houses = (
        ((x[0], half - 0.5), 0.0, left),
        ((depth - 0.5, rng.uniform(far - half, half)), -0.5 * np.pi, far),
        ((x[1] + right, 0.5 - half), np.pi, right),
    )
    for origin, yaw, wide in houses:
        grounds.put(outdoor.house(rng, wide, 9.0, (True, True), (2, 4)), np.array(origin), yaw)


def _plant_yard(yard: Room, grounds: Grounds, clearance: Clearance) -> None:
    rng = grounds.rng
    for k in range(14):
        where = rng.uniform(yard.low + np.array([2.0, 2.5]), yard.high - 2.5)
        if clearance.claim(np.append(where - 1.0, -1.0), np.append(where + 1.0, 2.0)):
            yaw = rng.uniform(-np.pi, np.pi)
            if k % 2:
                tree = outdoor.broadleaf(rng, rng.uniform(4.0, 8.0), rng.uniform(0.1, 0.25), 60)
                grounds.put(tree, where, yaw, is_green=True)
            else:
                grounds.put(outdoor.bench(rng) if k % 4 else outdoor.lamp_post(4.0, 0.0), where, yaw)


RISE_M, TREAD_M = 0.17, 0.28
_SLAB_M, _RAIL_ASIDE_M = 0.2, 0.06
_TURN_M = 1.3  # from the lobby's end to where the route turns


@dataclass(frozen=True)
class StairPlan:
    """Measures of a stairwell; it fills x from -landing to run + landing, y from 0 to `across`.

    half landing  x = run     ______________
                             |  A up | down B|
                  x = 0      |_______|_______|
    storey landing           |_______________|
                             |     lobby     |   ground floor only
    """

    storeys: int  # climbed
    steps: int  # of a flight
    width: float  # of a flight
    shaft: float  # between the flights
    landing: float  # depth
    lobby: float  # depth

    @property
    def run(self) -> float:
        """Length of a flight from its lowest riser to its highest."""
        return (self.steps - 1) * TREAD_M

    @property
    def climb(self) -> float:
        """Height of a flight."""
        return self.steps * RISE_M

    @property
    def across(self) -> float:
        """Width of the stairwell."""
        return 2.0 * self.width + self.shaft

    def flight(self, builder: Builder, number: int) -> Builder:
        """The frame of a flight, x up it from the middle of its lowest riser; the shaft is on its left."""
        back = bool(number % 2)
        x, y = (self.run, self.across - 0.5 * self.width) if back else (0.0, 0.5 * self.width)
        return builder.shifted(x, y, number * self.climb, yaw=np.pi * back)


def stairs(seed: int) -> World:
    """The stairwell of that seed: four to six storeys up and down again; the ground floor is at z = 0."""
    rng = np.random.default_rng(seed)
    storeys, steps = int(rng.integers(4, 7)), int(rng.integers(9, 11))
    width, shaft, landing = rng.uniform(1.25, 1.4), rng.uniform(0.2, 0.6), rng.uniform(1.35, 1.6)
    plan = StairPlan(storeys, steps, width, shaft, landing, rng.uniform(4.0, 6.0))
    builder, route = Builder(), _stairs_route(plan)
    for number in range(2 * plan.storeys):
        flight, half = plan.flight(builder, number), 0.5 * plan.width
        for k in range(1, plan.steps):
            flight.block(((k - 1) * TREAD_M, k * TREAD_M), (-half, half), ((k - 1) * RISE_M - 0.1, k * RISE_M))
        slab = (plan.climb - _SLAB_M, plan.climb)
        flight.block((plan.run, plan.run + plan.landing), (-half, plan.across - half), slab)
        rail = half - _RAIL_ASIDE_M
        draw_railing(flight.point(0.0, rail, RISE_M), flight.point(plan.run, rail, plan.climb), builder)
    top = plan.flight(builder, 2 * plan.storeys)
    draw_railing(top.point(0.0, -0.5 * plan.width), top.point(0.0, 0.5 * plan.width + plan.shaft), builder)
    _draw_stairwell(plan, builder, Clearance(route), rng)
    return World("stairs", seed, route, *builder.solids)


def _stairs_route(plan: StairPlan) -> Route:
    """From the lobby to the uppermost landing and back; on a flight along the mean line of its steps."""
    nowhere = Builder()
    near, far = 0.5 * plan.width, plan.across - 0.5 * plan.width
    start = -plan.landing - plan.lobby + _TURN_M
    up: list[FloatArray] = []
    for number in range(2 * plan.storeys):
        flight = plan.flight(nowhere, number)
        foot, head = -0.5 * TREAD_M, plan.run + 0.5 * TREAD_M
        turn = plan.run + 0.5 * plan.landing
        up += [flight.point(foot, 0.0, 0.0)]
        up += [flight.point(x, y, plan.climb) for x, y in ((head, 0.0), (turn, 0.0), (turn, far - near))]
    lobby = np.array([[-0.5 * plan.landing, near, 0.0], [-0.5 * plan.landing, far, 0.0], [start, far, 0.0]])
    waypoints = np.concatenate([[[start, near, 0.0]], up, up[-2::-1], lobby])
    return Route(waypoints, 0.3, 0.4, 2.1, 0.8)


def _draw_stairwell(plan: StairPlan, builder: Builder, clearance: Clearance, rng: np.random.Generator) -> None:
    """Walls, floor and ceilings; on every storey the same window opposite the same door, furniture in the lobby."""
    storey, low, high = 2.0 * plan.climb, -plan.landing - plan.lobby, plan.run + plan.landing
    height = (plan.storeys + 1) * storey
    lobby_end = -plan.landing - OUTER_WALL_M
    for x, z in ((high, -_SLAB_M), (high, height), (lobby_end, storey - _SLAB_M)):
        builder.block((low, x), (0.0, plan.across), (z, z + _SLAB_M))
    for y in (-OUTER_WALL_M, plan.across):
        builder.block((low, high), (y, y + OUTER_WALL_M), (-_SLAB_M, height + _SLAB_M))
    builder.block((low - OUTER_WALL_M, low), (-OUTER_WALL_M, plan.across + OUTER_WALL_M), (-_SLAB_M, storey))
    front = builder.shifted(-plan.landing, plan.across, yaw=-0.5 * np.pi)
    back = builder.shifted(high, 0.0, yaw=0.5 * np.pi)
    middle, wide = 0.5 * plan.across, (0.0, plan.across)
    window = Opening((middle - 0.7, middle + 0.7), (plan.climb + 0.9, plan.climb + 1.5))
    door = Opening((middle - 0.5, middle + 0.5), (0.0, 2.1))
    for level in range(plan.storeys + 1):
        back.shifted(0.0, 0.0, level * storey).glazed_wall(wide, storey, [window])
        if level:  # the ground floor is open to the lobby
            front.shifted(0.0, 0.0, level * storey).glazed_wall(wide, storey, [door])
    put, lobby = Furnisher(builder, clearance, rng), Room(np.array([low, 0.0]), np.array([-plan.landing, plan.across]))
    clearance.take(np.array([-plan.landing - 1.0, 0.0, 0.0]), np.array([high, plan.across, height]))
    for _ in range(2):
        put.place(lobby, put.drawn(((0.6, 1.2), (0.3, 0.5), (0.9, 1.8))), interior.cabinet)
        put.place(lobby, put.drawn(((0.6, 1.5), 0.05, 1.0)), interior.board, z=1.0)


# The route's limit: every carrier that walks or drives keeps it, and so do those who walk with it.
SPEED_MPS = 0.9
COMPANIONS, STANDING, CROSSING = 15, 8, 7
_ROUTE_FROM_WALLS_M = 5.2
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
    route = Route(corners, 0.8, 0.6, 2.2, SPEED_MPS)
    builder = Builder()
    # Floor, ceiling with lamps, and walls with windows on two sides.
    outer_low, outer_high = room.low - OUTER_WALL_M, room.high + OUTER_WALL_M
    builder.block((outer_low[0], outer_high[0]), (outer_low[1], outer_high[1]), building.starting((-0.2, height), 0.2))
    draw_room_ceiling(room, height, builder, rng)
    for side in range(4):
        wall, length = room.at_wall(side, builder)
        wide = rng.uniform(1.6, 3.0)
        places = np.arange(1.5, length - wide - 1.0, wide + 1.2)[: 20 * (side < 2)]
        windows = [Opening((float(x), float(x) + wide), (0.8, height - 0.7)) for x in places]
        wall.glazed_wall((-OUTER_WALL_M, length + OUTER_WALL_M), height, windows)
    put = Furnisher(builder, Clearance(replace(route, free_side_m=_CROWD_SIDE_M + 0.4)), rng)
    _furnish_foyer(room, height, put)
    return World("crowd", seed, route, *builder.solids, movers=draw_people(route, rng))


def _furnish_foyer(room: Room, height: float, put: Furnisher) -> None:
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
        where = loop[0] + along * ahead + outdoor.beside(rng, 2.8, _CROWD_SIDE_M) * building.left_of(ahead)
        people.append(_person(rng, where[None], 0.0, 0.0))
    for along in np.linspace(3.0, 0.4 * np.linalg.norm(loop[1] - loop[-1]), CROSSING):
        ends = loop[0] + along * ahead + np.outer(rng.permutation([-1.0, 1.0]), 3.0 * building.left_of(ahead))
        speed = rng.uniform(0.9, 1.4)
        people.append(_person(rng, ends, speed, -speed * (along + _HEAD_START_M) / SPEED_MPS))
    return tuple(people)


def _person(rng: np.random.Generator, line: FloatArray, speed_mps: float, start_m: float) -> Mover:
    """A pedestrian on a closed line (M, 2); one who stands looks anywhere."""
    part = Builder()
    yaw = 0.0 if speed_mps else rng.uniform(-np.pi, np.pi)
    part.place(outdoor.pedestrian(rng), make_transform(rotation_z(yaw), np.zeros(3)))
    return Mover(part.boxes, np.column_stack([line, np.zeros(len(line))]), speed_mps, start_m)
