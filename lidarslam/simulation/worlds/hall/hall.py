"""A large industrial hall: machines and racks below, decks above, and ramps that lead up to them and down again."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Boxes, Cylinders, World
from lidarslam.simulation.worlds.building import Builder, Opening, Spot
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.hall.decks import draw_decks
from lidarslam.simulation.worlds.hall.floor import Yard, fill_floors
from lidarslam.simulation.worlds.hall.plan import HallPlan, draw_hall

_WALL_M = 0.4
_TRUSS_M = 1.6


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


def draw_shell(plan: HallPlan, builder: Builder, clearance: Clearance, rng: np.random.Generator) -> None:
    """Everything that carries or closes the hall, and what is fastened to it."""
    middle = (0.5 * plan.width, 0.5 * plan.depth)
    size = (plan.width + 2.0 * _WALL_M, plan.depth + 2.0 * _WALL_M)
    builder.box((*middle, -0.2), (*size, 0.4))
    builder.box((*middle, plan.height + 0.2), (*size, 0.4))
    frames = np.linspace(0.0, plan.width, round(plan.width / rng.uniform(5.5, 7.0)) + 1)
    _draw_walls(plan, builder, rng)
    for x in frames[1:-1]:
        _draw_truss(plan, x, builder)
    for y in np.linspace(0.0, plan.depth, 10)[1:-1]:
        builder.box((middle[0], y, plan.height - 0.1), (plan.width, 0.14, 0.2))
    rows = (plan.aisle_y[0] - rng.uniform(4.0, 6.0), 0.5 * sum(plan.aisle_y) + rng.uniform(-1.5, 1.5))
    _draw_columns(plan, frames, rows, builder, clearance)
    _draw_crane(plan, rows, builder, rng)
    _draw_ducts(plan, builder, rng)
    _draw_pipes(plan, builder, clearance, rng)


def _draw_walls(plan: HallPlan, builder: Builder, rng: np.random.Generator) -> None:
    """Four walls: roller gates where no ramp is, a band of windows high up, pilasters between."""
    for side in range(4):
        along = (plan.width, plan.depth)[side % 2]
        corner = [(0.0, 0.0), (plan.width, 0.0), (plan.width, plan.depth), (0.0, plan.depth)][side]
        spot = Spot(builder, np.array([*corner, 0.0]), 0.5 * np.pi * side)
        bays = round(along / 6.0)
        bay, top = along / bays, plan.height - 1.9
        windows = [Opening(((k + 0.15) * bay, (k + 0.85) * bay), (top - 1.5, top)) for k in range(bays)]
        # Gates only where the wall is not along a ramp: the far end of the near wall, the middle of the right one.
        places = {0: (along - 9.0, along - 3.0), 1: (7.0, 20.0)}.get(side)
        gates = []
        if places is not None:
            at, width = rng.uniform(places[0], places[1] - 4.5), rng.uniform(3.6, 4.4)
            gates = [Opening((at, at + width), (0.0, rng.uniform(4.0, 4.6)))]
        upper = 0.5 * plan.height
        reach = (-_WALL_M, along + _WALL_M)
        spot.pierced_wall(reach, (-_WALL_M, 0.0), upper, gates)
        lowered = [Opening(window.x, (window.z[0] - upper, window.z[1] - upper)) for window in windows]
        spot.shifted(0.0, 0.0, upper).pierced_wall(reach, (-_WALL_M, 0.0), plan.height - upper, lowered)
        for window in windows:
            spot.box(window.x, (-_WALL_M, -_WALL_M + 0.05), window.z)
            for x in np.linspace(*window.x, 4)[1:-1]:
                spot.box((x - 0.03, x + 0.03), (-_WALL_M, -_WALL_M + 0.12), window.z)
        for gate in gates:
            _draw_gate(spot, gate)
        for k in range(bays + 1):
            spot.box((k * bay - 0.2, k * bay + 0.2), (0.0, 0.3), (0.0, plan.height))


def _draw_gate(spot: Spot, gate: Opening) -> None:
    """A roller shutter of broad slats, set back, with guides and its box above."""
    for z in np.arange(0.0, gate.z[1], 0.4):
        spot.box(gate.x, (-_WALL_M, -_WALL_M + 0.08), (z, min(z + 0.34, gate.z[1])))
    spot.box(gate.x, (-_WALL_M, -_WALL_M + 0.05), (0.0, gate.z[1]))
    for x in gate.x:
        spot.box((x - 0.12, x + 0.12), (-0.02, 0.1), (0.0, gate.z[1]))
    spot.box((gate.x[0] - 0.2, gate.x[1] + 0.2), (0.0, 0.45), (gate.z[1], gate.z[1] + 0.5))


def _draw_truss(plan: HallPlan, x: float, builder: Builder) -> None:
    """A lattice girder across the hall: chords, posts, and diagonals that change direction in the middle."""
    low, high = plan.height - _TRUSS_M, plan.height - 0.25
    for z in (low, high):
        builder.box((x, 0.5 * plan.depth, z), (0.2, plan.depth, 0.16))
    ys = np.linspace(0.0, plan.depth, 15)
    for k, (a, b) in enumerate(pairwise(ys)):
        rising = k < 7
        builder.beam((x, a, low if rising else high), (x, b, high if rising else low), 0.1, 0.1)
        builder.box((x, b, 0.5 * (low + high)), (0.1, 0.1, high - low))


def _draw_columns(
    plan: HallPlan, frames: FloatArray, rows: tuple[float, float], builder: Builder, clearance: Clearance
) -> None:
    """Columns of H section on footings below the trusses, wherever the way and the ramps leave room; girders on top."""
    top = plan.height - _TRUSS_M - 0.08
    for y in rows:
        builder.box((0.5 * plan.width, y, top - 0.3), (plan.width, 0.25, 0.6))
        for x in frames[1:-1]:
            if not clearance.claim(np.array([x - 0.35, y - 0.35, 0.0]), np.array([x + 0.35, y + 0.35, plan.height])):
                continue
            builder.box((x, y, 0.15), (0.7, 0.7, 0.3))
            for side in (-1.0, 1.0):
                builder.box((x, y + side * 0.19, 0.5 * top), (0.4, 0.03, top))
            builder.box((x, y, 0.5 * top), (0.03, 0.35, top))
            builder.box((x, y, 1.5), (0.44, 0.44, 0.08))


def _draw_crane(plan: HallPlan, rows: tuple[float, float], builder: Builder, rng: np.random.Generator) -> None:
    """A bridge crane under the girders of the column rows, its hook hanging."""
    z, x = plan.height - _TRUSS_M - 1.0, rng.uniform(0.35, 0.8) * plan.width
    for y in rows:
        builder.box((x, y, z + 0.1), (3.2, 0.3, 0.45))
    for dx in (-0.9, 0.9):
        builder.box((x + dx, 0.5 * sum(rows), z - 0.35), (0.35, rows[1] - rows[0], 0.7))
    y = rng.uniform(rows[0] + 2.0, rows[1] - 2.0)
    builder.box((x, y, z + 0.2), (2.3, 1.4, 0.5))
    hook = z - rng.uniform(1.0, 2.2)
    builder.pole((x, y), (hook, z), 0.03)
    builder.box((x, y, hook - 0.2), (0.35, 0.2, 0.5))


def _draw_ducts(plan: HallPlan, builder: Builder, rng: np.random.Generator) -> None:
    """Round ventilation ducts along the hall below the trusses, with outlets and hangers."""
    for y in (plan.aisle_y[0] + rng.uniform(1.5, 3.0), plan.aisle_y[1] + rng.uniform(0.5, 2.0)):
        radius, z = rng.uniform(0.3, 0.5), plan.height - _TRUSS_M - rng.uniform(0.8, 1.2)
        start, end = rng.uniform(2.0, 8.0), plan.width - rng.uniform(2.0, 8.0)
        builder.cylinder((start, y, z), (end, y, z), radius)
        for x in np.arange(start + 1.5, end - 1.0, rng.uniform(4.0, 5.5)):
            builder.pole((x, y), (z, plan.height - _TRUSS_M), 0.03)
            builder.cylinder((x - 0.05, y, z), (x + 0.05, y, z), radius + 0.05)
            side = rng.choice([-1.0, 1.0]) * (radius + 0.5)
            builder.cylinder((x + 1.0, y, z), (x + 1.0, y + side, z - 0.5), 0.5 * radius)


def _draw_pipes(plan: HallPlan, builder: Builder, clearance: Clearance, rng: np.random.Generator) -> None:
    """Pipes in bundles along the far right wall, and down pipes with valves between its pilasters."""
    x = plan.width - 0.45
    for k in range(int(rng.integers(2, 5))):
        z, radius = 5.0 + 0.42 * k, rng.uniform(0.06, 0.16)
        builder.cylinder((x, 0.5, z), (x, plan.depth - 0.5, z), radius)
        for y in rng.uniform(2.0, plan.depth - 12.0, 2):
            if clearance.claim(np.array([x - 0.2, y - 0.2, 0.0]), np.array([x + 0.2, y + 0.2, z])):
                builder.pole((x, y), (0.0, z), 0.8 * radius)
                builder.cylinder((x - 0.25, y, 1.2), (x - 0.2, y, 1.2), 0.16)
                builder.cylinder((x - 0.25, y, 1.2), (x, y, 1.2), 0.03)
