"""A large industrial hall: machines and racks below, decks above, and ramps that lead up to them and down again."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Boxes, Cylinders, Mover, Route, World
from lidarslam.simulation.worlds.building import UP, Builder, Opening, Spot
from lidarslam.simulation.worlds.hall_equipment import (
    BAY_M,
    MACHINES,
    RACK_DEPTH_M,
    cabin,
    drums,
    forklift,
    loaded_pallet,
    rack,
)
from lidarslam.simulation.worlds.interior import Piece, Size, crate
from lidarslam.simulation.worlds.paths import Clearance

_STRIP_M = 9.0
_DECK_2_WIDTH_M = 10.0
_LANDING_WIDTH_M = 7.0
LANE_M = 3.0
# From a wall to the middle of the lane along it, and to the middle of the next lane.
_LANE_AT_M, _NEXT_LANE_AT_M = 2.5, 7.0
_FREE_SIDE_M, _FREE_HEIGHT_M = 0.9, 2.2


@dataclass(frozen=True)
class Deck:
    """A level floor on columns."""

    low: FloatArray  # (2,) corners
    high: FloatArray
    z: float  # of its upper face
    railings: FloatArray  # (K, 2, 2) from and to, its open edges


@dataclass(frozen=True)
class HallPlan:
    """The hall; it fills x from 0 to `width`, y from 0 to `depth`."""

    width: float
    depth: float
    height: float  # inside
    aisle_y: tuple[float, float]  # of the two aisles across the ground floor
    turn_x: float  # where the route changes from one aisle to the other
    ramps: FloatArray  # (4, 2, 3) foot and head of A to D in the picture above, the middle of their upper faces' ends
    decks: tuple[Deck, ...]  # deck 1, deck 2, landing
    route: Route


def draw_hall(rng: np.random.Generator) -> HallPlan:
    """A hall that is different for each seed, its route 230 to 300 m long, its ramps at most 11.7 % steep."""
    width, depth, height = rng.uniform(58.0, 64.0), rng.uniform(40.0, 43.0), rng.uniform(11.5, 13.0)
    run = rng.uniform(25.0, depth - _STRIP_M - 4.8)
    rise = run * rng.uniform(0.106, 0.117)
    near, next_lane, far = _LANE_AT_M, depth - _NEXT_LANE_AT_M, depth - _LANE_AT_M
    deck_1_x, landing_y = _DECK_2_WIDTH_M + run, depth - _STRIP_M - run
    ramp_a = [(_DECK_2_WIDTH_M, next_lane, 0.0), (deck_1_x, next_lane, rise)]
    ramp_b = [(deck_1_x, far, rise), (_DECK_2_WIDTH_M, far, 2.0 * rise)]
    ramp_c = [(near, landing_y, rise), (near, depth - _STRIP_M, 2.0 * rise)]
    ramp_d = [(_LANDING_WIDTH_M + run, near, 0.0), (_LANDING_WIDTH_M, near, rise)]
    aisles = (rng.uniform(0.32, 0.4) * depth, depth - rng.uniform(12.5, 14.0))
    turn_x, deck_turn_x = rng.uniform(0.3, 0.55) * width, deck_1_x + rng.uniform(7.0, 12.0)
    waypoints = [
        *((width - 4.0, near, 0.0), (width - 4.0, aisles[0], 0.0), (turn_x, aisles[0], 0.0)),
        *((turn_x, aisles[1], 0.0), (6.5, aisles[1], 0.0), (6.5, next_lane, 0.0)),
        *(*ramp_a, (deck_turn_x, next_lane, rise), (deck_turn_x, far, rise)),
        *(*ramp_b, (near, far, 2.0 * rise), *ramp_c[::-1], (near, near, rise), *ramp_d[::-1]),
    ]
    route = Route(np.array(waypoints), 0.8, _FREE_SIDE_M, _FREE_HEIGHT_M, 2.0)
    ramps = np.array([ramp_a, ramp_b, ramp_c, ramp_d])
    decks = _decks(width, depth, rise, deck_1_x, landing_y)
    return HallPlan(width, depth, height, aisles, turn_x, ramps, decks, route)


def _decks(width: float, depth: float, rise: float, deck_1_x: float, landing_y: float) -> tuple[Deck, ...]:
    """Deck 1, deck 2 and the landing, with railings wherever no ramp joins and no wall is."""
    front, half = depth - _STRIP_M, 0.5 * LANE_M
    far, second, near = depth - _LANE_AT_M, depth - _NEXT_LANE_AT_M, _LANE_AT_M

    def along_y(x: float, *spans: tuple[float, float]) -> list[list[tuple[float, float]]]:
        return [[(x, a), (x, b)] for a, b in spans]

    def along_x(y: float, *spans: tuple[float, float]) -> list[list[tuple[float, float]]]:
        return [[(a, y), (b, y)] for a, b in spans]

    railings_1 = along_y(deck_1_x, (front, second - half), (second + half, far - half), (far + half, depth))
    railings_1 += along_x(front, (deck_1_x, width - 3.2), (width - 1.8, width))  # a gap for the stairs
    railings_2 = along_y(_DECK_2_WIDTH_M, (front, far - half), (far + half, depth))
    railings_2 += along_x(front, (0.0, near - half), (near + half, _DECK_2_WIDTH_M))
    railings_3 = along_x(landing_y, (0.0, near - half), (near + half, _LANDING_WIDTH_M))
    railings_3 += along_y(_LANDING_WIDTH_M, (0.0, near - half), (near + half, landing_y))
    return (
        Deck(np.array([deck_1_x, front]), np.array([width, depth]), rise, np.array(railings_1)),
        Deck(np.array([0.0, front]), np.array([_DECK_2_WIDTH_M, depth]), 2.0 * rise, np.array(railings_2)),
        Deck(np.zeros(2), np.array([_LANDING_WIDTH_M, landing_y]), rise, np.array(railings_3)),
    )


_SLAB_M, _RAIL_M = 0.25, 1.1


def _draw_ramp(foot: FloatArray, head: FloatArray, builder: Builder, clearance: Clearance) -> None:
    step = head - foot
    along = step / np.linalg.norm(step)
    side = np.array([-along[1], along[0], 0.0]) / np.hypot(along[0], along[1])
    down = 0.5 * _SLAB_M * np.cross(side, along)
    builder.beam(foot + down, head + down, LANE_M, _SLAB_M)
    for sign in (-1.0, 1.0):
        edge = sign * (0.5 * LANE_M - 0.06) * side
        builder.beam(foot + edge + 0.06 * UP, head + edge + 0.06 * UP, 0.12, 0.14)
        draw_railing(foot + edge, head + edge, builder)
    reach = np.abs(side) * 0.5 * LANE_M
    for k, (a, b) in enumerate(pairwise(np.linspace(0.0, 1.0, round(float(np.linalg.norm(step))) + 1))):
        low, high = foot + a * step, foot + b * step
        bottom, top = np.minimum(low, high) - reach, np.maximum(low, high) + reach
        clearance.take(bottom - (_SLAB_M + 0.25) * UP, top + _RAIL_M * UP)
        if k % 5 == 4 and low[2] > 1.0:
            for sign in (-1.0, 1.0):
                _stand(low + sign * (0.5 * LANE_M - 0.2) * side, _SLAB_M, builder, clearance)


def _stand(top: FloatArray, thickness: float, builder: Builder, clearance: Clearance) -> None:
    """A square column from the ground to below a slab, where the route and other things leave room."""
    low, high = np.append(top[:2] - 0.1, 0.0), np.append(top[:2] + 0.1, top[2] - thickness)
    if not clearance.on_route(low, high):
        clearance.take(low, high)
        builder.box(0.5 * (low + high), high - low + 0.1 * UP)


def draw_railing(a: FloatArray, b: FloatArray, builder: Builder) -> None:
    """Posts every 1.5 m or so, a hand rail and a knee rail, from a to b (3,)."""
    length = float(np.linalg.norm(b - a))
    for t in np.linspace(0.0, 1.0, max(2, round(length / 1.6) + 1)):
        foot = a + t * (b - a)
        builder.cylinder(foot, foot + _RAIL_M * UP, 0.025)
    for z in (0.55, _RAIL_M):
        builder.cylinder(a + z * UP, b + z * UP, 0.025)


def _draw_deck(deck: Deck, builder: Builder, clearance: Clearance) -> None:
    """Slab, beams below it, columns at its corners and between, railings along its open edges."""
    size = deck.high - deck.low
    low, high = np.append(deck.low, deck.z - _SLAB_M), np.append(deck.high, deck.z)
    builder.box(0.5 * (low + high), high - low)
    clearance.take(low - 0.35 * UP, high)
    xs, ys = (np.linspace(low[k] + 0.15, high[k] - 0.15, max(2, round(size[k] / 4.5) + 1)) for k in (0, 1))
    for x in xs:
        builder.box((x, 0.5 * (low[1] + high[1]), deck.z - _SLAB_M - 0.15), (0.18, size[1] - 0.02, 0.3))
        for y in ys:
            _stand(np.array([x, y, deck.z]), _SLAB_M + 0.3, builder, clearance)
    for a, b in deck.railings:
        draw_railing(np.append(a, deck.z), np.append(b, deck.z), builder)


def _draw_stairs(plan: HallPlan, builder: Builder, clearance: Clearance) -> None:
    """Steep stairs from the ground to deck 1, at its far end, between two stringers."""
    deck = plan.decks[0]
    steps = round(deck.z / 0.19)
    x, head = plan.width - 2.5, np.array([plan.width - 2.5, deck.low[1], deck.z])
    foot = np.array([x, deck.low[1] - 0.24 * steps, 0.0])
    for k in range(1, steps):
        point = foot + (head - foot) * k / steps
        builder.box(point - 0.02 * UP, (1.2, 0.26, 0.04))
    for side in (-0.64, 0.64):
        offset = np.array([side, 0.0, 0.0])
        builder.beam(foot + offset + 0.1 * UP, head + offset - 0.05 * UP, 0.05, 0.25)
        draw_railing(foot + offset, head + offset, builder)
    aside = np.array([0.8, 0.9, 0.0])
    clearance.take(foot - aside, head + aside + 1.5 * UP)


_GAP_M = 0.5


@dataclass(frozen=True)
class Yard:
    """Places things where there is room for them."""

    builder: Builder
    clearance: Clearance
    rng: np.random.Generator

    def put(self, at: FloatArray, size: Size, turned: bool, piece: Piece) -> bool:
        """Draw a piece of that length, width and height with its middle at (3,); whether there was room for it."""
        reach = 0.5 * np.array([size[1], size[0]] if turned else [size[0], size[1]])
        low = np.append(at[:2] - reach, at[2] + 0.01)
        if not self.clearance.claim(low, np.append(at[:2] + reach, at[2] + size[2]), _GAP_M):
            return False
        spot = Spot(self.builder, at, 0.5 * np.pi * turned + np.pi * float(self.rng.integers(2)))
        piece(spot, size, self.rng)
        return True


def _send_forklifts(plan: HallPlan, yard: Yard) -> tuple[Mover, ...]:
    """Two or three fork-lifts that drive in rectangles off the route."""
    rng = yard.rng
    movers: list[Mover] = []
    wanted = int(rng.integers(2, 4))
    for attempt in range(400):
        if len(movers) == wanted:
            break
        # Where a large round does not fit, a small one may.
        shrink = 1.0 - 0.7 * attempt / 400
        size = shrink * rng.uniform([6.0, 3.0], [14.0, 6.0])[:: int(rng.choice([-1, 1]))]
        low = rng.uniform([3.0, 5.0], np.array([plan.width - 3.0, plan.depth - 11.0]) - size)
        high = low + size
        # Turning on the spot, its forks sweep 2.1 m.
        if not yard.clearance.claim(np.append(low - 2.1, 0.01), np.append(high + 2.1, 2.5)):
            continue
        corners = np.array([[*low, 0.0], [high[0], low[1], 0.0], [*high, 0.0], [low[0], high[1], 0.0]])
        corners = corners[:: int(rng.choice([-1, 1]))]
        movers.append(Mover(forklift(rng), corners, rng.uniform(0.8, 1.8), rng.uniform(0.0, float(size.sum()))))
    return tuple(movers)


def _set_racks(plan: HallPlan, yard: Yard) -> None:
    """Rows of racks between the aisles, to the right of where the route turns."""
    rng = yard.rng
    spacing, levels = rng.uniform(3.2, 4.0), int(rng.integers(3, 5))
    for y in np.arange(plan.aisle_y[0] + 2.2, plan.aisle_y[1] + 1.5, spacing):
        x = plan.turn_x + 3.0
        while x < plan.width - 5.0:
            size = (
                int(rng.integers(1, 4)) * BAY_M + 0.1,
                RACK_DEPTH_M + 0.2,
                1.6 * levels,
            )
            middle = np.array([x + 0.5 * size[0], y, 0.0])
            fits = middle[0] + 0.5 * size[0] < plan.width - 1.0
            x += size[0] + rng.choice([0.55, 2.0]) if fits and yard.put(middle, size, False, rack) else 0.5


def _set_machines(plan: HallPlan, yard: Yard) -> None:
    """Machines in rows, of alternating kinds."""
    rng = yard.rng
    xs, ys = np.arange(3.0, plan.width - 2.0, 3.6), np.arange(6.0, plan.depth - 10.0, 3.2)
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    for k, place in enumerate(rng.permutation(places)):
        machine, least, most = MACHINES[k % len(MACHINES)]
        x, y, z = rng.uniform(least, most)
        middle = np.append(place + rng.uniform(-0.3, 0.3, 2), 0.0)
        reach = 0.5 * max(x, y) + 0.5
        if (middle[:2] > reach).all() and (middle[:2] < [plan.width - reach, plan.depth - reach]).all():
            yard.put(middle, (x, y, z), bool(rng.random() < 0.3), machine)


def _fill(yard: Yard, low: FloatArray, high: FloatArray, z: float, tries: int) -> None:
    """A cabin, and pallets, drums and crates wherever there is room between two corners (2,)."""
    rng = yard.rng
    for k in range(tries):
        piece: Piece = cabin if k == 0 else (loaded_pallet, drums, crate)[int(rng.integers(3))]
        if piece is loaded_pallet:
            size: Size = (1.25, 0.95, 1.3)
        elif piece is drums:
            size = (0.62 * rng.integers(2, 5), 1.25, 1.8)
        elif piece is crate:
            size = (rng.uniform(0.5, 1.4), rng.uniform(0.5, 1.4), rng.uniform(0.5, 1.4))
        else:
            size = (rng.uniform(2.6, 4.0), rng.uniform(2.2, 3.0), 2.5)
        reach = 0.5 * max(size[:2])
        middle = np.append(rng.uniform(low + reach, high - reach), z)
        yard.put(middle, size, bool(rng.random() < 0.5), piece)


_WALL_M = 0.4
_TRUSS_M = 1.6


def build(seed: int) -> World:
    """The hall of that seed; the ground floor is at z = 0, the route climbs two decks and is 230 to 300 m long."""
    rng = np.random.default_rng(seed)
    plan = draw_hall(rng)
    builder, clearance = Builder(), Clearance(plan.route)
    for foot, head in plan.ramps:
        _draw_ramp(foot, head, builder, clearance)
    for deck in plan.decks:
        _draw_deck(deck, builder, clearance)
    _draw_stairs(plan, builder, clearance)
    draw_shell(plan, builder, clearance, rng)
    yard = Yard(builder, clearance, rng)
    movers = _send_forklifts(plan, yard)
    _set_racks(plan, yard)
    _set_machines(plan, yard)
    for deck in plan.decks[:2]:
        _fill(yard, deck.low + 0.4, deck.high - 0.4, deck.z, 40)
    _fill(yard, np.full(2, 0.6), np.array([plan.width, plan.depth]) - 0.6, 0.0, 300)
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
    """The structure of the hall, and the fittings fastened to it."""
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
    """Columns of H section on footings below the trusses, where the route and the ramps leave room; girders on top."""
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
