"""An office floor: corridors that close a loop around sharp corners, and rooms off them."""

from itertools import combinations

import numpy as np

from lidarslam.simulation.world import World
from lidarslam.simulation.worlds.building import Builder
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.office import shell
from lidarslam.simulation.worlds.office.doors import draw_doors
from lidarslam.simulation.worlds.office.plan import draw_plan
from lidarslam.simulation.worlds.office.rooms import KINDS, Furnisher, furnish_corridor, furnish_room


def build(seed: int) -> World:
    """The office of that seed; the floor is at z = 0, the route 40 to 90 m long and into some of the rooms."""
    rng = np.random.default_rng(seed)
    plan = draw_plan(rng)
    doors, route = draw_doors(plan, rng)
    height = rng.uniform(2.6, 3.2)
    builder, clearance = Builder(), Clearance(route)
    shell.draw_slabs(plan, height, builder)
    shell.draw_walls(plan, doors, height, builder, clearance)
    put = Furnisher(builder, clearance, rng)
    for one, other in combinations(plan.corridors, 2):  # where they cross, there is only floor
        low, high = np.maximum(one.low, other.low), np.minimum(one.high, other.high)
        if (low < high).all():
            clearance.take(np.append(low - 0.1, 0.0), np.append(high + 0.1, height))
    for corridor in plan.corridors:
        shell.draw_corridor_ceiling(corridor, height, builder, rng)
        furnish_corridor(corridor, height, put)
    kinds: list[str] = []
    for room in plan.rooms.values():
        # Every kind comes once before any comes again.
        kinds = kinds or list(rng.permutation(list(KINDS)))
        kind = kinds.pop()
        for _ in range(max(1, round(float((room.high - room.low).prod()) / 13.0))):
            furnish_room(room, kind, put)
        shell.draw_room_ceiling(room, height, builder, rng)
    return World("office", seed, route, *builder.solids)
