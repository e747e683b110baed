"""The shell of an office floor: walls with doors and windows in them, the ceiling and what hangs from it."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import UP, Builder
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.interior import HAIR_M, Spot, radiator
from lidarslam.simulation.worlds.office.doors import DOOR_HEIGHT_M, Door, into_room
from lidarslam.simulation.worlds.office.plan import OUTSIDE, Plan, Room, WallLine
from lidarslam.simulation.worlds.pierced_wall import Opening, pierced_wall

WALL_M, FACADE_M = 0.12, 0.36
FRAME_M = 0.06
WINDOW_SILL_M, WINDOW_TOP_M = 0.92, 2.2


def wall_spot(builder: Builder, wall: WallLine) -> Spot:
    """A spot at a wall's start, x along its middle line, y to its left."""
    yaw = float(np.arctan2(wall.direction[1], wall.direction[0]))
    return Spot(builder, np.array([*wall.a, 0.0]), yaw)


def draw_walls(plan: Plan, doors: list[Door], height: float, builder: Builder, clearance: Clearance) -> None:
    """Every wall, with its doors or windows."""
    for k, wall in enumerate(plan.walls):
        spot = wall_spot(builder, wall)
        if OUTSIDE in (wall.left, wall.right):
            _facade(spot, wall, height, clearance)
            continue
        here = [door for door in doors if door.wall == k]
        holes = [_hole(door) for door in here]
        half = 0.5 * WALL_M
        pierced_wall(spot, (-half + HAIR_M, wall.length + half - HAIR_M), (-half, half), height, holes)
        for door in here:
            _draw_door(spot, wall, door, clearance)


def _hole(door: Door) -> Opening:
    half = 0.5 * door.width + FRAME_M
    return Opening((door.along - half, door.along + half), (0.0, DOOR_HEIGHT_M + FRAME_M))


def _draw_door(spot: Spot, wall: WallLine, door: Door, clearance: Clearance) -> None:
    """Frame and leaf; the swing and the way in are kept free of furniture."""
    inwards = 1.0 if into_room(wall) @ wall.to_left > 0.0 else -1.0
    half, reach = 0.5 * door.width, 0.5 * WALL_M + 0.02
    for side in (-1.0, 1.0):
        x = sorted((door.along + side * half, door.along + side * (half + FRAME_M + 0.03)))
        spot.box((x[0], x[1]), (-reach, reach), (0.0, DOOR_HEIGHT_M + FRAME_M + 0.03))
    spot.box((door.along - half, door.along + half), (-reach, reach), (DOOR_HEIGHT_M, DOOR_HEIGHT_M + FRAME_M + 0.03))
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
    low, high = np.minimum(a, b), np.maximum(a, b)
    around = np.array([0.05, 0.05, 0.0])
    clearance.take(low - around, high + around + DOOR_HEIGHT_M * UP)


def _facade(spot: Spot, wall: WallLine, height: float, clearance: Clearance) -> None:
    """An outer wall: windows in recesses with a bar down their middle, a radiator below each."""
    inwards = -1.0 if wall.left == OUTSIDE else 1.0
    inner, outer = inwards * 0.5 * WALL_M, inwards * (0.5 * WALL_M - FACADE_M)
    y = (min(inner, outer), max(inner, outer))
    count = int(wall.length // 2.1)
    width = 0.62 * wall.length / max(count, 1)
    middles = (np.arange(count) + 0.5) * wall.length / max(count, 1)
    holes = [Opening((m - 0.5 * width, m + 0.5 * width), (WINDOW_SILL_M, WINDOW_TOP_M)) for m in middles]
    # Outer corners are closed by both walls reaching past the grid point.
    pierced_wall(spot, (-0.4 * FACADE_M, wall.length + 0.4 * FACADE_M), y, height, holes)
    for m in middles:
        pane = sorted((outer + 0.06 * inwards, outer + 0.09 * inwards))
        bar = sorted((outer + 0.04 * inwards, outer + 0.13 * inwards))
        sill = sorted((outer, inner + 0.09 * inwards))
        spot.box((m - 0.5 * width, m + 0.5 * width), (pane[0], pane[1]), (WINDOW_SILL_M, WINDOW_TOP_M))
        spot.box((m - 0.035, m + 0.035), (bar[0], bar[1]), (WINDOW_SILL_M, WINDOW_TOP_M))
        spot.box(
            (m - 0.5 * width - 0.05, m + 0.5 * width + 0.05), (sill[0], sill[1]), (WINDOW_SILL_M - 0.03, WINDOW_SILL_M)
        )
        foot = spot.shifted(m, inner, yaw=0.0 if inwards > 0.0 else np.pi)
        a, b = foot.point(-0.5 * width, 0.0, 0.0), foot.point(0.5 * width, 0.14, 0.75)
        if clearance.claim(np.minimum(a, b), np.maximum(a, b)):
            radiator(foot, width)


def draw_slabs(plan: Plan, height: float, builder: Builder) -> None:
    """Floor and ceiling."""
    low, high = plan.extent[0] - 1.0, plan.extent[1] + 1.0
    middle, size = 0.5 * (low + high), high - low
    builder.box((middle[0], middle[1], -0.15), (size[0], size[1], 0.3))
    builder.box((middle[0], middle[1], height + 0.15), (size[0], size[1], 0.3))


def draw_corridor_ceiling(corridor: Room, height: float, builder: Builder, rng: np.random.Generator) -> None:
    """Beams across a corridor, lamps between them, and a duct or a cable tray along it."""
    size = corridor.high - corridor.low
    lengthwise = int(size[1] > size[0])
    corner = np.array([*corridor.low, 0.0]) if not lengthwise else np.array([corridor.high[0], corridor.low[1], 0.0])
    spot = Spot(builder, corner, 0.5 * np.pi * lengthwise)
    length, width = float(size[lengthwise]), float(size[1 - lengthwise])
    inner = (0.5 * WALL_M, width - 0.5 * WALL_M)
    spacing, depth = rng.uniform(2.2, 3.4), rng.uniform(0.12, 0.28)
    for x in np.arange(0.5 * spacing, length, spacing):
        spot.box((x - 0.1, x + 0.1), inner, (height - depth, height))
        if x + 0.5 * spacing + 0.6 < length:
            lamp = x + 0.5 * spacing
            spot.box((lamp - 0.6, lamp + 0.6), (0.5 * width - 0.09, 0.5 * width + 0.09), (height - 0.09, height))
    side = inner[0] + 0.2 if rng.random() < 0.5 else inner[1] - 0.2
    if rng.random() < 0.6:
        z = height - depth - 0.13
        spot.rod((0.3, side, z), (length - 0.3, side, z), 0.12)
    else:
        spot.box((0.3, length - 0.3), (side - 0.12, side + 0.12), (height - depth - 0.07, height - depth - 0.01))
