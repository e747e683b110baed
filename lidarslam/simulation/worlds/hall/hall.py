"""A large industrial hall: machines and racks below, decks above, and ramps that lead up to them and down again."""

from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Boxes, Cylinders, World
from lidarslam.simulation.worlds.building import Builder
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.hall.decks import draw_decks
from lidarslam.simulation.worlds.hall.floor import Yard, fill_floors
from lidarslam.simulation.worlds.hall.plan import draw_hall
from lidarslam.simulation.worlds.hall.shell import draw_shell


def build(seed: int) -> World:
    """The hall of that seed; the ground floor is at z = 0, the route climbs two decks and is 230 to 300 m long."""
    rng = np.random.default_rng(seed)
    plan = draw_hall(rng)
    builder, clearance = Builder(), Clearance(plan.route)
    draw_decks(plan, builder, clearance)
    draw_shell(plan, builder, clearance, rng)
    movers = fill_floors(plan, Yard(builder, clearance, rng))
    world = World("hall", seed, plan.route, *builder.solids, movers=movers)
    return _mirrored(world, rng.choice([-1.0, 1.0], 2))


def _mirrored(world: World, signs: FloatArray) -> World:
    """The world with x, y or both turned to the other side: four halls from one plan."""
    mirror = np.append(signs, 1.0)
    boxes, cylinders = world.boxes, world.cylinders
    return replace(
        world,
        route=replace(world.route, waypoints=world.route.waypoints * mirror),
        # A box is its own mirror image; turning both of its sides keeps the rotation right-handed.
        boxes=Boxes(boxes.centres * mirror, boxes.half_sizes, boxes.R_world_box * np.outer(mirror, mirror)),
        cylinders=Cylinders(cylinders.starts * mirror, cylinders.ends * mirror, cylinders.radii),
        movers=tuple(replace(mover, waypoints=mover.waypoints * mirror) for mover in world.movers),
    )
