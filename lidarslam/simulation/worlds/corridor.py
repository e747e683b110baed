"""A bare corridor without doors, boxes along its walls, that opens into a yard."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lidarslam.simulation.world import HeightField, Route, World
from lidarslam.simulation.worlds import outdoor, paths
from lidarslam.simulation.worlds.building import HAIR_M, OUTER_WALL_M, Builder, Opening, Spot, glazed_wall, smooth_noise
from lidarslam.simulation.worlds.houses import house
from lidarslam.simulation.worlds.outdoor import upright
from lidarslam.simulation.worlds.paths import Clearance

WIDTH_M, HEIGHT_M = 2.0, 2.6
_BOXES = 12
_DEEPEST_BOX_M = 0.45  # leaves the route's free side free
_FREE_SIDE_M, _FREE_HEIGHT_M, _SPEED_LIMIT_MPS = 0.45, 2.2, 1.6
_FRONT_M = 5.5  # height of the building that the corridor leads out of
_ENTRY_M, _FROM_WALLS_M = 4.0, 5.5  # the path round the yard: distance from the mouth, and from the other sides
_CELL_M, _MARGIN_M = 0.5, 12.0


@dataclass(frozen=True)
class CorridorPlan:
    """The corridor's middle is x from -length to 0 at y = 0; there the yard begins, `depth` long and `width` wide."""

    length: float
    depth: float
    width: float


def build(seed: int) -> World:
    """The corridor of that seed, 24 to 40 m long, and its yard; the route leads out, round the yard and back in."""
    rng = np.random.default_rng(seed)
    plan = CorridorPlan(rng.uniform(24.0, 40.0), rng.uniform(25.0, 40.0), rng.uniform(25.0, 40.0))
    ground = _ground(plan, rng)
    route = _route(plan, ground)
    solid, green = Builder(), Builder()
    _draw_corridor(plan, solid, rng)
    _draw_yard(plan, solid, ground, rng)
    _plant_yard(plan, solid, green, ground, Clearance(route), rng)
    solid.place(paths.prune(green, route), np.eye(4))
    return World("corridor", seed, route, *solid.solids, (ground,))


def _route(plan: CorridorPlan, ground: HeightField) -> Route:
    """Its longest leg, in whose middle recordings begin, is deep in the corridor and leads out."""
    far, aside = plan.depth - _FROM_WALLS_M, 0.5 * plan.width - _FROM_WALLS_M
    corners = np.array([[_ENTRY_M, -aside], [far, -aside], [far, aside], [_ENTRY_M, aside]])
    entry, inside = np.array([[_ENTRY_M, 0.0]]), np.array([[1.2 - plan.length, 0.0], [-0.25 * plan.length, 0.0]])
    loop = paths.subdivide_loop(np.concatenate([entry, paths.round_corners(corners, np.full(4, 3.0), 1.0)]), 4.0)
    way = np.concatenate([inside, loop, entry, inside[1:]])
    return Route(paths.on_ground(way, ground), 0.3, _FREE_SIDE_M, _FREE_HEIGHT_M, _SPEED_LIMIT_MPS)


def _ground(plan: CorridorPlan, rng: np.random.Generator) -> HeightField:
    """Level in the corridor and along the front, a little uneven in the yard."""
    low = np.floor(np.array([-plan.length, -0.5 * plan.width]) - _MARGIN_M)
    nodes = paths.grid_nodes(low, np.array([plan.depth, 0.5 * plan.width]) + _MARGIN_M, _CELL_M)
    shape = nodes.shape[:2]
    hills = 0.12 * smooth_noise(rng, shape, 8.0 / _CELL_M) + 0.01 * smooth_noise(rng, shape, 0.7)
    return HeightField(low, _CELL_M, hills * np.clip((nodes[..., 0] - 1.0) / 4.0, 0.0, 1.0))


def _draw_corridor(plan: CorridorPlan, builder: Builder, rng: np.random.Generator) -> None:
    """Walls, ceiling and the closed end; boxes against the walls at uneven distances, all different."""
    start, half, top = -plan.length, 0.5 * WIDTH_M, HEIGHT_M + OUTER_WALL_M
    for y in (-half - OUTER_WALL_M, half):
        builder.block((start, y, -0.3), (0.0, y + OUTER_WALL_M, top))
    builder.block((start, -half, HEIGHT_M), (0.0, half, top))
    builder.block((start - OUTER_WALL_M, -half - OUTER_WALL_M, -0.3), (start, half + OUTER_WALL_M, top))
    for k in range(_BOXES):
        x = start + (k + rng.uniform(0.25, 0.75)) * plan.length / _BOXES
        long, deep, high = rng.uniform([0.3, 0.3, 0.3], [0.8, _DEEPEST_BOX_M, 0.8])
        y = rng.choice([-1.0, 1.0]) * (half - 0.5 * deep - HAIR_M)
        builder.box((x, y, 0.5 * high), (long, deep, high))


def _draw_yard(plan: CorridorPlan, builder: Builder, ground: HeightField, rng: np.random.Generator) -> None:
    """A front with windows next to the corridor's mouth, walls of different heights, a house on every other side."""
    half, depth = 0.5 * plan.width, plan.depth
    front = Spot(builder, np.array([0.0, half, 0.0]), -0.5 * np.pi)
    mouth = Opening((half - 0.5 * WIDTH_M - HAIR_M, half + 0.5 * WIDTH_M + HAIR_M), (0.0, HEIGHT_M + HAIR_M))
    places = [x for x in np.arange(2.0, plan.width - 3.0, 3.2) if abs(x + 0.7 - half) > WIDTH_M]
    windows = [Opening((x, x + 1.4), (1.0, 2.4)) for x in places]
    glazed_wall(front, (0.0, plan.width), _FRONT_M, windows, (mouth,))
    for a, b in pairwise(np.array([[0.0, -half], [depth, -half], [depth, half], [0.0, half]])):
        builder.wall(a, b, (-1.0, rng.uniform(1.8, 3.2)), 0.25)
    left, far, right = rng.uniform(8.0, 12.0, 3)
    x = rng.uniform(2.0, depth - 13.0, 2)
    houses = (
        ((x[0], half - 0.5), 0.0, left),
        ((depth - 0.5, rng.uniform(far - half, half)), -0.5 * np.pi, far),
        ((x[1] + right, 0.5 - half), np.pi, right),
    )
    for origin, yaw, wide in houses:
        builder.place(house(rng, wide, 9.0, (True, True), (2, 4)), upright(ground, np.array(origin), yaw))


def _plant_yard(
    plan: CorridorPlan, solid: Builder, green: Builder, ground: HeightField, clearance: Clearance,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Trees, lamp posts and benches off the path."""
    low, high = np.array([2.0, 2.5 - 0.5 * plan.width]), np.array([plan.depth - 2.5, 0.5 * plan.width - 2.5])
    for k in range(14):
        where = rng.uniform(low, high)
        if clearance.claim(np.append(where - 1.0, -1.0), np.append(where + 1.0, 2.0)):
            pose = upright(ground, where, rng.uniform(-np.pi, np.pi))
            if k % 2:
                green.place(outdoor.broadleaf(rng, rng.uniform(4.0, 8.0), rng.uniform(0.1, 0.25), 60), pose)
            else:
                solid.place(outdoor.bench(rng) if k % 4 else outdoor.lamp_post(4.0, 0.0), pose)
