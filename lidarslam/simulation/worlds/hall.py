"""A large industrial hall: machines and racks below, decks above, and ramps that lead up to them and down again."""

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Mover, Route, World
from lidarslam.simulation.worlds import hall_equipment as equipment
from lidarslam.simulation.worlds.building import UP, Builder, Opening, Room, around
from lidarslam.simulation.worlds.interior import Furnisher, Measures, Piece, Size, crate, draw_railing
from lidarslam.simulation.worlds.paths import Clearance

_STRIP_M = 9.0
_DECK_2_WIDTH_M = 10.0
_LANDING_WIDTH_M = 7.0
_LANE_M = 3.0
# From a wall to the middle of the lane along it, and to the middle of the next lane.
_LANE_AT_M, _NEXT_LANE_AT_M = 2.5, 7.0
_SLAB_M, _WALL_M, _TRUSS_M = 0.25, 0.4, 1.6
_GAP_M = 0.5  # between the things on the floor


class Deck(NamedTuple):
    """A level floor on columns."""

    floor: Room
    z: float  # of its upper face
    railings: FloatArray  # (K, 2, 2) from and to, its open edges


class HallPlan(NamedTuple):
    """The hall."""

    floor: Room  # from the origin
    height: float  # inside
    aisle_y: tuple[float, float]  # of the two aisles across the ground floor
    turn_x: float  # where the route changes from one aisle to the other
    ramps: FloatArray  # (4, 2, 3) foot and head, the middle of their upper faces' ends
    decks: tuple[Deck, ...]  # deck 1, deck 2, landing
    route: Route


def draw_hall(rng: np.random.Generator) -> HallPlan:
    """A hall that is different for each seed, its route 230 to 300 m long, its ramps at most 11.7 % steep."""
    width, depth, height = rng.uniform(58.0, 64.0), rng.uniform(40.0, 43.0), rng.uniform(11.5, 13.0)
    run = rng.uniform(25.0, depth - _STRIP_M - 4.8)
    rise = run * rng.uniform(0.106, 0.117)
    near, next_lane, far = _LANE_AT_M, depth - _NEXT_LANE_AT_M, depth - _LANE_AT_M
    front, deck_1_x, landing_y = depth - _STRIP_M, _DECK_2_WIDTH_M + run, depth - _STRIP_M - run
    ramp_a = [(_DECK_2_WIDTH_M, next_lane, 0.0), (deck_1_x, next_lane, rise)]
    ramp_b = [(deck_1_x, far, rise), (_DECK_2_WIDTH_M, far, 2.0 * rise)]
    ramp_c = [(near, landing_y, rise), (near, front, 2.0 * rise)]
    ramp_d = [(_LANDING_WIDTH_M + run, near, 0.0), (_LANDING_WIDTH_M, near, rise)]
    aisles = (rng.uniform(0.32, 0.4) * depth, depth - rng.uniform(12.5, 14.0))
    turn_x, deck_turn_x = rng.uniform(0.3, 0.55) * width, deck_1_x + rng.uniform(7.0, 12.0)
    waypoints = [
        *((width - 4.0, near, 0.0), (width - 4.0, aisles[0], 0.0), (turn_x, aisles[0], 0.0)),
        *((turn_x, aisles[1], 0.0), (6.5, aisles[1], 0.0), (6.5, next_lane, 0.0)),
        *(*ramp_a, (deck_turn_x, next_lane, rise), (deck_turn_x, far, rise)),
        *(*ramp_b, (near, far, 2.0 * rise), *ramp_c[::-1], (near, near, rise), *ramp_d[::-1]),
    ]
    route = Route(np.array(waypoints), 0.8, 0.9, 2.2, 2.0)
    ramps = np.array([ramp_a, ramp_b, ramp_c, ramp_d])
    # Railings wherever no ramp joins and no wall is, a gap for the stairs.
    one, two, landing = (deck_1_x, front), (_DECK_2_WIDTH_M, front), (_LANDING_WIDTH_M, landing_y)
    edges = (
        [_edge(one, (deck_1_x, depth), next_lane, far), _edge(one, (width, front), width - 2.5, half=0.7)],
        [_edge(two, (_DECK_2_WIDTH_M, depth), far), _edge((0.0, front), two, near)],
        [_edge((0.0, landing_y), landing, near), _edge((_LANDING_WIDTH_M, 0.0), landing, near)],
    )
    floors = ((one, (width, depth)), ((0.0, front), (two[0], depth)), ((0.0, 0.0), landing))
    decks = tuple(
        Deck(Room(np.array(low), np.array(high)), z, np.concatenate(railings))
        for (low, high), z, railings in zip(floors, (rise, 2.0 * rise, rise), edges, strict=True)
    )
    return HallPlan(Room(np.zeros(2), np.array([width, depth])), height, aisles, turn_x, ramps, decks, route)


def _edge(a: tuple[float, float], b: tuple[float, float], *gaps: float, half: float = 0.5 * _LANE_M) -> FloatArray:
    """Railings (K, 2, 2) along an edge parallel to an axis, open that far around coordinates on this axis."""
    axis = int(a[0] == b[0])
    at = [a[axis], *(gap + side * half for gap in gaps for side in (-1.0, 1.0)), b[axis]]
    points = np.tile(a, (len(at), 1))
    points[:, axis] = at
    return points.reshape(-1, 2, 2)


def hall(seed: int) -> World:
    """The hall of that seed; the ground floor is at z = 0, the route climbs two decks and is 230 to 300 m long."""
    rng = np.random.default_rng(seed)
    plan = draw_hall(rng)
    put = Furnisher(Builder(), Clearance(plan.route), rng)
    for foot, head in plan.ramps:
        _draw_ramp(foot, head, put)
    for deck in plan.decks:
        _draw_deck(deck, put)
    _draw_stairs(plan, put)
    _draw_shell(plan, put)
    movers = _send_forklifts(plan, put)
    _set_racks(plan, put)
    _set_machines(plan, put)
    for deck in plan.decks[:2]:
        _fill(put, deck.floor, 0.4, deck.z, 40)
    _fill(put, plan.floor, 0.6, 0.0, 300)
    # x, y or both turned to the other side: four halls from one plan. A box is its own mirror image; turning both of
    # its sides keeps the rotation right-handed.
    mirror = np.append(rng.choice([-1.0, 1.0], 2), 1.0)
    boxes, cylinders = put.builder.solids
    return World(
        "hall",
        seed,
        replace(plan.route, waypoints=plan.route.waypoints * mirror),
        replace(boxes, centres=boxes.centres * mirror, R_world_box=boxes.R_world_box * np.outer(mirror, mirror)),
        replace(cylinders, starts=cylinders.starts * mirror, ends=cylinders.ends * mirror),
        movers=tuple(replace(mover, waypoints=mover.waypoints * mirror) for mover in movers),
    )


def _draw_ramp(foot: FloatArray, head: FloatArray, put: Furnisher) -> None:
    step = head - foot
    along = step / np.linalg.norm(step)
    side = np.array([-along[1], along[0], 0.0]) / np.hypot(along[0], along[1])
    down = 0.5 * _SLAB_M * np.cross(side, along)
    put.builder.beam(foot + down, head + down, _LANE_M, _SLAB_M)
    for sign in (-1.0, 1.0):
        edge = sign * (0.5 * _LANE_M - 0.06) * side
        put.builder.beam(foot + edge + 0.06 * UP, head + edge + 0.06 * UP, 0.12, 0.14)
        draw_railing(foot + edge, head + edge, put.builder)
    reach = np.abs(side) * 0.5 * _LANE_M
    for k, (a, b) in enumerate(pairwise(np.linspace(0.0, 1.0, round(float(np.linalg.norm(step))) + 1))):
        low, high = foot + a * step, foot + b * step
        bottom, top = np.minimum(low, high) - reach, np.maximum(low, high) + reach
        put.clearance.take(bottom - (_SLAB_M + 0.25) * UP, top + 1.1 * UP)
        for sign in (-1.0, 1.0) if k % 5 == 4 and low[2] > 1.0 else ():
            _stand(low + sign * (0.5 * _LANE_M - 0.2) * side, _SLAB_M, put)


def _stand(top: FloatArray, thickness: float, put: Furnisher) -> None:
    """A square column from the ground to below a slab, where the route and other things leave room."""
    low, high = np.append(top[:2] - 0.1, 0.0), np.append(top[:2] + 0.1, top[2] - thickness)
    if not put.clearance.on_route(low, high):
        put.clearance.take(low, high)
        put.builder.box(0.5 * (low + high), high - low + 0.1 * UP)


def _draw_deck(deck: Deck, put: Furnisher) -> None:
    """Slab, beams below it, columns at its corners and between, railings along its open edges."""
    low, high = np.append(deck.floor.low, deck.z - _SLAB_M), np.append(deck.floor.high, deck.z)
    put.builder.block(*np.stack([low, high], axis=1))
    put.clearance.take(low - 0.35 * UP, high)
    size = high - low
    xs, ys = (np.linspace(low[k] + 0.15, high[k] - 0.15, max(2, round(size[k] / 4.5) + 1)) for k in (0, 1))
    for x in xs:
        put.builder.box((x, 0.5 * (low[1] + high[1]), deck.z - _SLAB_M - 0.15), (0.18, size[1] - 0.02, 0.3))
        for y in ys:
            _stand(np.array([x, y, deck.z]), _SLAB_M + 0.3, put)
    for a, b in deck.railings:
        draw_railing(np.append(a, deck.z), np.append(b, deck.z), put.builder)


def _draw_stairs(plan: HallPlan, put: Furnisher) -> None:
    """Steep stairs from the ground to deck 1, at its far end, between two stringers."""
    deck = plan.decks[0]
    steps = round(deck.z / 0.19)
    head = np.array([plan.floor.high[0] - 2.5, deck.floor.low[1], deck.z])
    foot = np.array([head[0], head[1] - 0.24 * steps, 0.0])
    for k in range(1, steps):
        put.builder.box(foot + (head - foot) * k / steps - 0.02 * UP, (1.2, 0.26, 0.04))
    for side in (-0.64, 0.64):
        offset = np.array([side, 0.0, 0.0])
        put.builder.beam(foot + offset + 0.1 * UP, head + offset - 0.05 * UP, 0.05, 0.25)
        draw_railing(foot + offset, head + offset, put.builder)
    aside = np.array([0.8, 0.9, 0.0])
    put.clearance.take(foot - aside, head + aside + 1.5 * UP)


def _send_forklifts(plan: HallPlan, put: Furnisher) -> tuple[Mover, ...]:
    rng = put.rng
    movers: list[Mover] = []
    wanted = int(rng.integers(2, 4))
    for attempt in range(400):
        if len(movers) == wanted:
            break
        # Where a large round does not fit, a small one may.
        shrink = 1.0 - 0.7 * attempt / 400
        size = shrink * rng.uniform([6.0, 3.0], [14.0, 6.0])[:: int(rng.choice([-1, 1]))]
        low = rng.uniform([3.0, 5.0], plan.floor.high - [3.0, 11.0] - size)
        high = low + size
        # Turning on the spot, its forks sweep 2.1 m.
        if put.clearance.claim(np.append(low - 2.1, 0.01), np.append(high + 2.1, 2.5)):
            corners = np.array([[*low, 0.0], [high[0], low[1], 0.0], [*high, 0.0], [low[0], high[1], 0.0]])
            corners = corners[:: int(rng.choice([-1, 1]))]
            body = equipment.forklift(rng)
            movers.append(Mover(body, corners, rng.uniform(0.8, 1.8), rng.uniform(0.0, float(size.sum()))))
    return tuple(movers)


def _set_racks(plan: HallPlan, put: Furnisher) -> None:
    """Rows of racks between the aisles, to the right of where the route turns."""
    rng, width = put.rng, plan.floor.high[0]
    spacing, levels = rng.uniform(3.2, 4.0), int(rng.integers(3, 5))
    for y in np.arange(plan.aisle_y[0] + 2.2, plan.aisle_y[1] + 1.5, spacing):
        x = plan.turn_x + 3.0
        while x < width - 5.0:
            long = int(rng.integers(1, 4)) * equipment.BAY_M + 0.1
            size = (long, equipment.RACK_DEPTH_M + 0.2, 1.6 * levels)
            middle = np.array([x + 0.5 * long, y, 0.0])
            fits = middle[0] + 0.5 * long < width - 1.0
            x += long + rng.choice([0.55, 2.0]) if fits and put.at(middle, size, False, equipment.rack, _GAP_M) else 0.5


def _set_machines(plan: HallPlan, put: Furnisher) -> None:
    rng, (width, depth) = put.rng, plan.floor.high
    xs, ys = np.arange(3.0, width - 2.0, 3.6), np.arange(6.0, depth - 10.0, 3.2)
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    for k, place in enumerate(rng.permutation(places)):
        machine, least, most = equipment.MACHINES[k % len(equipment.MACHINES)]
        x, y, z = rng.uniform(least, most)
        middle = place + rng.uniform(-0.3, 0.3, 2)
        reach = 0.5 * max(x, y) + 0.5
        if (middle > reach).all() and (middle < plan.floor.high - reach).all():
            put.at(np.append(middle, 0.0), (x, y, z), bool(rng.random() < 0.3), machine, _GAP_M)


_GOODS: tuple[tuple[Piece, Measures], ...] = (
    (lambda spot, _, rng: equipment.pallet(spot, 1.2, rng), (1.25, 0.95, 1.3)),
    (equipment.drums, (1.0, 1.25, 1.8)),
    (crate, ((0.5, 1.4), (0.5, 1.4), (0.5, 1.4))),
)
_CABIN: tuple[Piece, Measures] = equipment.cabin, ((2.6, 4.0), (2.2, 3.0), 2.5)


def _fill(put: Furnisher, floor: Room, from_walls: float, z: float, tries: int) -> None:
    rng = put.rng
    for k in range(tries):
        piece, measures = _GOODS[int(rng.integers(3))] if k else _CABIN
        size: Size = put.drawn(measures)
        if piece is equipment.drums:
            size = (0.62 * rng.integers(2, 5), *size[1:])
        reach = 0.5 * max(size[:2])
        middle = rng.uniform(floor.low + from_walls + reach, floor.high - from_walls - reach)
        put.at(np.append(middle, z), size, bool(rng.random() < 0.5), piece, _GAP_M)


def _draw_shell(plan: HallPlan, put: Furnisher) -> None:
    builder, rng, (width, depth) = put.builder, put.rng, plan.floor.high
    for z in (-0.2, plan.height + 0.2):
        builder.box((0.5 * width, 0.5 * depth, z), (width + 2.0 * _WALL_M, depth + 2.0 * _WALL_M, 0.4))
    frames = np.linspace(0.0, width, round(width / rng.uniform(5.5, 7.0)) + 1)
    # Gates only where the wall is not along a ramp: the far end of the near wall, the middle of the right one.
    for side, gate_x in enumerate(((width - 9.0, width - 3.0), (7.0, 20.0), None, None)):
        _draw_wall(*plan.floor.at_wall(side, builder), plan.height, gate_x, rng)
    for x in frames[1:-1]:
        # A lattice girder across the hall: chords, posts, and diagonals that change direction in the middle.
        low, high = plan.height - _TRUSS_M, plan.height - 0.25
        for z in (low, high):
            builder.box((x, 0.5 * depth, z), (0.2, depth, 0.16))
        for k, (a, b) in enumerate(pairwise(np.linspace(0.0, depth, 15))):
            ends = (low, high) if k < 7 else (high, low)
            builder.beam((x, a, ends[0]), (x, b, ends[1]), 0.1, 0.1)
            builder.box((x, b, 0.5 * (low + high)), (0.1, 0.1, high - low))
    for y in np.linspace(0.0, depth, 10)[1:-1]:
        builder.box((0.5 * width, y, plan.height - 0.1), (width, 0.14, 0.2))
    rows = (plan.aisle_y[0] - rng.uniform(4.0, 6.0), 0.5 * sum(plan.aisle_y) + rng.uniform(-1.5, 1.5))
    _draw_columns_and_crane(plan, frames, rows, put)
    _draw_ducts_and_pipes(plan, put)


def _draw_wall(
    wall: Builder, along: float, height: float, gate_x: tuple[float, float] | None, rng: np.random.Generator
) -> None:
    """A wall with a roller gate or none, a band of windows high up, and pilasters."""
    bays = round(along / 6.0)
    bay, upper, top = along / bays, 0.5 * height, height - 1.9
    windows = [Opening(((k + 0.15) * bay, (k + 0.85) * bay), (top - 1.5, top)) for k in range(bays)]
    gates = []
    if gate_x is not None:
        at, wide = rng.uniform(gate_x[0], gate_x[1] - 4.5), rng.uniform(3.6, 4.4)
        gates = [Opening((at, at + wide), (0.0, rng.uniform(4.0, 4.6)))]
    reach = (-_WALL_M, along + _WALL_M)
    wall.pierced_wall(reach, (-_WALL_M, 0.0), upper, gates)
    lowered = [Opening(window.x, (window.z[0] - upper, window.z[1] - upper)) for window in windows]
    wall.shifted(0.0, 0.0, upper).pierced_wall(reach, (-_WALL_M, 0.0), height - upper, lowered)
    for window in windows:
        wall.block(window.x, (-_WALL_M, -_WALL_M + 0.05), window.z)
        wall.block(around(np.linspace(*window.x, 4)[1:-1], 0.03), (-_WALL_M, -_WALL_M + 0.12), window.z)
    for (left, right), (_, shut) in gates:  # a roller shutter of broad slats, set back, with guides and its box above
        for z in np.arange(0.0, shut, 0.4):
            wall.block((left, right), (-_WALL_M, -_WALL_M + 0.08), (z, min(z + 0.34, shut)))
        wall.block((left, right), (-_WALL_M, -_WALL_M + 0.05), (0.0, shut))
        wall.block(around((left, right), 0.12), (-0.02, 0.1), (0.0, shut))
        wall.block((left - 0.2, right + 0.2), (0.0, 0.45), (shut, shut + 0.5))
    wall.block(around([k * bay for k in range(bays + 1)], 0.2), (0.0, 0.3), (0.0, height))


def _draw_columns_and_crane(plan: HallPlan, frames: FloatArray, rows: tuple[float, float], put: Furnisher) -> None:
    """Columns of H section on footings below the trusses, where the route and the ramps leave room; girders on top,
    and under them a bridge crane, its hook hanging.
    """
    top, width, builder, rng = plan.height - _TRUSS_M - 0.08, plan.floor.high[0], put.builder, put.rng
    for y in rows:
        builder.box((0.5 * width, y, top - 0.3), (width, 0.25, 0.6))
        for x in frames[1:-1]:
            if put.clearance.claim(np.array([x - 0.35, y - 0.35, 0.0]), np.array([x + 0.35, y + 0.35, plan.height])):
                builder.box((x, y, 0.15), (0.7, 0.7, 0.3))
                for side in (-1.0, 1.0):
                    builder.box((x, y + side * 0.19, 0.5 * top), (0.4, 0.03, top))
                builder.box((x, y, 0.5 * top), (0.03, 0.35, top))
                builder.box((x, y, 1.5), (0.44, 0.44, 0.08))
    z, x = plan.height - _TRUSS_M - 1.0, rng.uniform(0.35, 0.8) * width
    for y in rows:
        builder.box((x, y, z + 0.1), (3.2, 0.3, 0.45))
    for dx in (-0.9, 0.9):
        builder.box((x + dx, 0.5 * sum(rows), z - 0.35), (0.35, rows[1] - rows[0], 0.7))
    y = rng.uniform(rows[0] + 2.0, rows[1] - 2.0)
    builder.box((x, y, z + 0.2), (2.3, 1.4, 0.5))
    hook = z - rng.uniform(1.0, 2.2)
    builder.pole((x, y), (hook, z), 0.03)
    builder.box((x, y, hook - 0.2), (0.35, 0.2, 0.5))


def _draw_ducts_and_pipes(plan: HallPlan, put: Furnisher) -> None:
    """Round ducts along the hall below the trusses, with outlets and hangers; pipes in bundles along the far right
    wall, and down pipes with valves between its pilasters.
    """
    builder, rng, depth = put.builder, put.rng, plan.floor.high[1]
    for y in (plan.aisle_y[0] + rng.uniform(1.5, 3.0), plan.aisle_y[1] + rng.uniform(0.5, 2.0)):
        radius, z = rng.uniform(0.3, 0.5), plan.height - _TRUSS_M - rng.uniform(0.8, 1.2)
        start, end = rng.uniform(2.0, 8.0), plan.floor.high[0] - rng.uniform(2.0, 8.0)
        builder.cylinder((start, y, z), (end, y, z), radius)
        for x in np.arange(start + 1.5, end - 1.0, rng.uniform(4.0, 5.5)):
            builder.pole((x, y), (z, plan.height - _TRUSS_M), 0.03)
            builder.cylinder((x - 0.05, y, z), (x + 0.05, y, z), radius + 0.05)
            side = rng.choice([-1.0, 1.0]) * (radius + 0.5)
            builder.cylinder((x + 1.0, y, z), (x + 1.0, y + side, z - 0.5), 0.5 * radius)
    x = plan.floor.high[0] - 0.45
    for k in range(int(rng.integers(2, 5))):
        z, radius = 5.0 + 0.42 * k, rng.uniform(0.06, 0.16)
        builder.cylinder((x, 0.5, z), (x, depth - 0.5, z), radius)
        for y in rng.uniform(2.0, depth - 12.0, 2):
            if put.clearance.claim(np.array([x - 0.2, y - 0.2, 0.0]), np.array([x + 0.2, y + 0.2, z])):
                builder.pole((x, y), (0.0, z), 0.8 * radius)
                builder.cylinder((x - 0.25, y, 1.2), (x - 0.2, y, 1.2), 0.16)
                builder.cylinder((x - 0.25, y, 1.2), (x, y, 1.2), 0.03)
