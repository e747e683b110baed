"""An office floor: corridors that close a loop around sharp corners, and rooms off them."""

from itertools import combinations

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import World
from lidarslam.simulation.worlds.building import HAIR_M, UP, Builder, Opening, Spot, heading
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.interior import radiator
from lidarslam.simulation.worlds.office.doors import DOOR_HEIGHT_M, Door, draw_doors, into_room
from lidarslam.simulation.worlds.office.plan import OUTSIDE, WALL_M, Plan, Room, WallLine, draw_plan
from lidarslam.simulation.worlds.office.rooms import KINDS, Furnisher, furnish_corridor, furnish_room

_FACADE_M = 0.36
_FRAME_M = 0.06
_SILL_M, _LINTEL_M = 0.92, 2.2


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
    for one, other in combinations(plan.corridors, 2):  # where they cross, there is only floor
        low, high = np.maximum(one.low, other.low), np.minimum(one.high, other.high)
        if (low < high).all():
            clearance.take(np.append(low - 0.1, 0.0), np.append(high + 0.1, height))
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
        draw_room_ceiling(room, height, builder, rng)
    return World("office", seed, route, *builder.solids)


def draw_walls(plan: Plan, doors: list[Door], height: float, builder: Builder, clearance: Clearance) -> None:
    """Every wall, with its doors or windows."""
    for k, wall in enumerate(plan.walls):
        spot = Spot(builder, np.array([*wall.a, 0.0]), heading(wall.direction))  # y to the wall's left
        if OUTSIDE in (wall.left, wall.right):
            _facade(spot, wall, height, clearance)
            continue
        here = [door for door in doors if door.wall == k]
        half = 0.5 * WALL_M
        reach = (-half + HAIR_M, wall.length + half - HAIR_M)
        spot.pierced_wall(reach, (-half, half), height, [_opening(door) for door in here])
        for door in here:
            _draw_door(spot, wall, door, clearance)


def _opening(door: Door) -> Opening:
    half = 0.5 * door.width + _FRAME_M
    return Opening((door.along - half, door.along + half), (0.0, DOOR_HEIGHT_M + _FRAME_M))


def _draw_door(spot: Spot, wall: WallLine, door: Door, clearance: Clearance) -> None:
    """Frame and leaf; the swing and the way in are kept free of furniture."""
    inwards = 1.0 if into_room(wall) @ wall.to_left > 0.0 else -1.0
    half, reach, top = 0.5 * door.width, 0.5 * WALL_M + 0.02, DOOR_HEIGHT_M + _FRAME_M + 0.03
    for side in (-1.0, 1.0):
        jamb = (door.along + side * half, door.along + side * (half + _FRAME_M + 0.03))
        spot.box(jamb, (-reach, reach), (0.0, top))
    spot.box((door.along - half, door.along + half), (-reach, reach), (DOOR_HEIGHT_M, top))
    # The leaf's frame: x from the hinge to the other jamb, y towards the room when closed.
    hinge = spot.shifted(door.along + door.hinge * half, inwards * (0.5 * WALL_M - 0.03))
    yaw = (np.pi if door.hinge > 0.0 else 0.0) - door.hinge * inwards * door.opened
    leaf = Spot(spot.builder, hinge.origin, spot.yaw + yaw)
    leaf.box((0.005, door.width - 0.005), (-0.022, 0.022), (0.01, DOOR_HEIGHT_M - 0.01))
    leaf.box((door.width - 0.12, door.width - 0.07), (-0.07, 0.07), (1.0, 1.03))
    before, behind = spot.point(door.along - half, -0.6 * inwards, 0.0), spot.point(door.along + half, inwards, 0.0)
    _keep_free(clearance, before, behind)
    _keep_free(clearance, hinge.origin, leaf.point(door.width, 0.0, 0.0))


def _keep_free(clearance: Clearance, a: FloatArray, b: FloatArray) -> None:
    around = np.array([0.05, 0.05, 0.0])
    clearance.take(np.minimum(a, b) - around, np.maximum(a, b) + around + DOOR_HEIGHT_M * UP)


def _facade(spot: Spot, wall: WallLine, height: float, clearance: Clearance) -> None:
    """An outer wall: windows in recesses with a bar down their middle, a radiator below each."""
    inwards = -1.0 if wall.left == OUTSIDE else 1.0
    inner, outer = inwards * 0.5 * WALL_M, inwards * (0.5 * WALL_M - _FACADE_M)
    count = int(wall.length // 2.1)
    half = 0.5 * (0.62 * wall.length / max(count, 1))
    middles = (np.arange(count) + 0.5) * wall.length / max(count, 1)
    holes = [Opening((m - half, m + half), (_SILL_M, _LINTEL_M)) for m in middles]
    # Outer corners are closed by both walls reaching past the grid point.
    reach = (-0.4 * _FACADE_M, wall.length + 0.4 * _FACADE_M)
    spot.pierced_wall(reach, (min(inner, outer), max(inner, outer)), height, holes)
    for m, hole in zip(middles, holes, strict=True):
        spot.box(hole.x, (outer + 0.06 * inwards, outer + 0.09 * inwards), hole.z)
        spot.box((m - 0.035, m + 0.035), (outer + 0.04 * inwards, outer + 0.13 * inwards), hole.z)
        spot.box((m - half - 0.05, m + half + 0.05), (outer, inner + 0.09 * inwards), (_SILL_M - 0.03, _SILL_M))
        foot = spot.shifted(m, inner, yaw=0.0 if inwards > 0.0 else np.pi)
        if clearance.claim(*foot.bounds((-half, half), (0.0, 0.14), (0.0, 0.75))):
            radiator(foot, 2.0 * half)


def draw_slabs(plan: Plan, height: float, builder: Builder) -> None:
    """Floor and ceiling."""
    low, high = plan.extent[0] - 1.0, plan.extent[1] + 1.0
    middle, size = 0.5 * (low + high), high - low
    for z in (-0.15, height + 0.15):
        builder.box((*middle, z), (*size, 0.3))


def draw_corridor_ceiling(corridor: Room, height: float, builder: Builder, rng: np.random.Generator) -> None:
    """Beams across a corridor, lamps between them, and a duct or a cable tray along it."""
    size = corridor.high - corridor.low
    lengthwise = int(size[1] > size[0])
    corner = np.array([corridor.high[0] if lengthwise else corridor.low[0], corridor.low[1], 0.0])
    spot = Spot(builder, corner, 0.5 * np.pi * lengthwise)
    length, width = float(size[lengthwise]), float(size[1 - lengthwise])
    inner = (0.5 * WALL_M, width - 0.5 * WALL_M)
    spacing, depth = rng.uniform(2.2, 3.4), rng.uniform(0.12, 0.28)
    for x in np.arange(0.5 * spacing, length, spacing):
        spot.box((x - 0.1, x + 0.1), inner, (height - depth, height))
        lamp = x + 0.5 * spacing
        if lamp + 0.6 < length:
            spot.box((lamp - 0.6, lamp + 0.6), (0.5 * width - 0.09, 0.5 * width + 0.09), (height - 0.09, height))
    side = inner[0] + 0.2 if rng.random() < 0.5 else inner[1] - 0.2
    if rng.random() < 0.6:
        z = height - depth - 0.13
        spot.rod((0.3, side, z), (length - 0.3, side, z), 0.12)
    else:
        spot.box((0.3, length - 0.3), (side - 0.12, side + 0.12), (height - depth - 0.07, height - depth - 0.01))


def draw_room_ceiling(room: Room, height: float, builder: Builder, rng: np.random.Generator) -> None:
    """Rows of lamps, and at times a beam across."""
    size = room.high - room.low
    drop = rng.choice([0.0, rng.uniform(0.12, 0.3)])
    spot = Spot(builder, np.array([*room.low, height]), 0.0)
    xs, ys = ((np.arange(max(1, span // 2)) + 0.5) * span / max(1, span // 2) for span in size)
    for x in xs:
        for y in ys:
            spot.box((x - 0.15, x + 0.15), (y - 0.55, y + 0.55), (-drop - 0.07, -drop))
            if drop > 0.0:
                for hanger in (y - 0.4, y + 0.4):
                    spot.pillar(x, hanger, (-drop, 0.0), 0.008)
    if rng.random() < 0.5:
        x = rng.uniform(0.3, 0.7) * size[0]
        spot.box((x - 0.15, x + 0.15), (0.5 * WALL_M, size[1] - 0.5 * WALL_M), (-rng.uniform(0.2, 0.35), 0.0))
