"""A bare corridor without doors, boxes along its walls, that opens into a yard."""

from itertools import pairwise

import numpy as np

from lidarslam.simulation.world import HeightField, Route, World
from lidarslam.simulation.worlds import outdoor, paths
from lidarslam.simulation.worlds.building import HAIR_M, OUTER_WALL_M, Builder, Opening, Room, relief, starting
from lidarslam.simulation.worlds.houses import house
from lidarslam.simulation.worlds.outdoor import Grounds
from lidarslam.simulation.worlds.paths import Clearance

_WIDTH_M, _HEIGHT_M = 2.0, 2.6
_BOXES = 12
_DEEPEST_BOX_M = 0.45  # leaves the route's free side free
_FRONT_M = 5.5  # height of the building that the corridor leads out of
_ENTRY_M, _FROM_WALLS_M = 4.0, 5.5  # the path round the yard: distance from the mouth, and from the other sides
_CELL_M, _MARGIN_M = 0.5, 12.0


def corridor(seed: int) -> World:
    """The corridor of that seed, 24 to 40 m long, and its yard; the route leads out, round the yard and back in.

    The corridor's middle is x from -length to 0 at y = 0; there the yard begins.
    """
    rng = np.random.default_rng(seed)
    length, depth, width = rng.uniform(24.0, 40.0), rng.uniform(25.0, 40.0), rng.uniform(25.0, 40.0)
    yard = Room(np.array([0.0, -0.5 * width]), np.array([depth, 0.5 * width]))
    # Level in the corridor and along the front, a little uneven in the yard.
    low = np.floor(yard.low - [length, 0.0] - _MARGIN_M)
    nodes = paths.grid_nodes(low, yard.high + _MARGIN_M, _CELL_M)
    hills = relief(rng, nodes.shape[:2], (0.12, 8.0 / _CELL_M), (0.01, 0.7))
    ground = HeightField(low, _CELL_M, hills * np.clip((nodes[..., 0] - 1.0) / 4.0, 0.0, 1.0))
    route = _route(length, yard, ground)
    grounds = Grounds(rng, route.waypoints[:, :2], ground)
    _draw_corridor(length, grounds.solid, rng)
    _draw_yard(yard, grounds)
    _plant_yard(yard, grounds, Clearance(route))
    grounds.prune(route)
    return World("corridor", seed, route, *grounds.solid.solids, (ground,))


def _route(length: float, yard: Room, ground: HeightField) -> Route:
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
    solid.block((-length, 0.0), starting((-half - OUTER_WALL_M, half), OUTER_WALL_M), (-0.3, top))
    solid.blocks(
        (-length, 0.0, half, _HEIGHT_M, top), (-length - OUTER_WALL_M, -length, half + OUTER_WALL_M, -0.3, top)
    )
    for k in range(_BOXES):
        x = -length + (k + rng.uniform(0.25, 0.75)) * length / _BOXES
        long, deep, high = rng.uniform([0.3, 0.3, 0.3], [0.8, _DEEPEST_BOX_M, 0.8])
        y = rng.choice([-1.0, 1.0]) * (half - 0.5 * deep - HAIR_M)
        solid.box((x, y, 0.5 * high), (long, deep, high))


def _draw_yard(yard: Room, grounds: Grounds) -> None:
    """A front with windows next to the corridor's mouth, walls of different heights, a house on every other side."""
    rng, (depth, half) = grounds.rng, yard.high
    mouth = Opening((half - 0.5 * _WIDTH_M - HAIR_M, half + 0.5 * _WIDTH_M + HAIR_M), (0.0, _HEIGHT_M + HAIR_M))
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
        grounds.put(house(rng, wide, 9.0, (True, True), (2, 4)), np.array(origin), yaw)


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
