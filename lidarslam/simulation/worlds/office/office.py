"""An office floor: corridors that close a loop around sharp corners, and rooms off them."""

import numpy as np

from lidarslam.simulation.world import World
from lidarslam.simulation.worlds.building import Builder
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.interior import Spot
from lidarslam.simulation.worlds.office.doors import draw_doors
from lidarslam.simulation.worlds.office.furnisher import Furnisher
from lidarslam.simulation.worlds.office.plan import Room, draw_plan
from lidarslam.simulation.worlds.office.rooms import KINDS, furnish_corridor, furnish_room
from lidarslam.simulation.worlds.office.shell import WALL_M, draw_corridor_ceiling, draw_slabs, draw_walls


def build(seed: int) -> World:
    """The office of that seed; the floor is at z = 0, the route 40 to 90 m long and into some of the rooms."""
    rng = np.random.default_rng(seed)
    plan = draw_plan(rng)
    doors, route = draw_doors(plan, rng)
    height = rng.uniform(2.6, 3.2)
    builder, clearance = Builder(), Clearance(route)
    draw_slabs(plan, height, builder)
    draw_walls(plan, doors, height, builder, clearance)
    put = Furnisher(builder, clearance, rng)
    _keep_crossings_free(plan.corridors, height, clearance)
    for corridor in plan.corridors:
        draw_corridor_ceiling(corridor, height, builder, rng)
        furnish_corridor(corridor, height, put)
    kinds: list[str] = []
    for room in plan.rooms.values():
        # Every kind comes once before any comes again.
        kinds = kinds or list(rng.permutation(list(KINDS)))
        kind = kinds.pop()
        for _ in range(max(1, round(float((room.high - room.low).prod()) / 13.0))):
            furnish_room(room, kind, put)
        _draw_room_ceiling(room, height, builder, rng)
    return World("office", seed, route, boxes=builder.boxes, cylinders=builder.cylinders)


def _keep_crossings_free(corridors: tuple[Room, ...], height: float, clearance: Clearance) -> None:
    for k, one in enumerate(corridors):
        for other in corridors[:k]:
            low, high = np.maximum(one.low, other.low), np.minimum(one.high, other.high)
            if (low < high).all():
                clearance.take(np.array([*(low - 0.1), 0.0]), np.array([*(high + 0.1), height]))


def _draw_room_ceiling(room: Room, height: float, builder: Builder, rng: np.random.Generator) -> None:
    """Rows of lamps, and at times a beam across."""
    size = room.high - room.low
    drop = rng.choice([0.0, rng.uniform(0.12, 0.3)])
    spot = Spot(builder, np.array([*room.low, height]), 0.0)
    for x in (np.arange(max(1, size[0] // 2)) + 0.5) * size[0] / max(1, size[0] // 2):
        for y in (np.arange(max(1, size[1] // 2)) + 0.5) * size[1] / max(1, size[1] // 2):
            spot.box((x - 0.15, x + 0.15), (y - 0.55, y + 0.55), (-drop - 0.07, -drop))
            if drop > 0.0:
                spot.rod((x, y - 0.4, -drop), (x, y - 0.4, 0.0), 0.008)
                spot.rod((x, y + 0.4, -drop), (x, y + 0.4, 0.0), 0.008)
    if rng.random() < 0.5:
        x = rng.uniform(0.3, 0.7) * size[0]
        spot.box((x - 0.15, x + 0.15), (0.5 * WALL_M, size[1] - 0.5 * WALL_M), (-rng.uniform(0.2, 0.35), 0.0))
