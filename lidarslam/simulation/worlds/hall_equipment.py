"""Machines and goods in a hall, each kind drawn around the middle of its footprint: x along its length."""

from itertools import pairwise

import numpy as np

from lidarslam.simulation.world import Boxes
from lidarslam.simulation.worlds.building import Builder, around, starting
from lidarslam.simulation.worlds.interior import Piece, Size

RACK_DEPTH_M, BAY_M = 1.1, 2.8


def press(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A press: bed, two columns, a crown with its cylinder, a ram half way down."""
    a, b, z, ram = 0.5 * size[0], 0.5 * size[1], size[2], rng.uniform(1.3, size[2] - 1.5)
    spot.blocks(
        (a, b, 0.0, 0.9), (-a, -0.6 * a, 0.7 * b, 0.9, z - 0.9), (0.6 * a, a, 0.7 * b, 0.9, z - 0.9),
        (a, 0.8 * b, z - 0.9, z - 0.3), (0.5 * a, 0.5 * b, ram, ram + 0.5),
    )  # fmt: skip
    spot.poles((0.0, 0.0, z - 0.3, z, 0.3 * min(a, b)), (0.0, 0.0, ram + 0.5, z - 0.9, 0.12))


def machining_centre(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A cased machine: a window set back, a panel on an arm, a chip conveyor at its end."""
    a, b, z, top = 0.5 * size[0], 0.5 * size[1], size[2], 0.85 * size[2]
    split = rng.uniform(-0.4, 0.2) * a
    spot.blocks(
        (-a, 0.7 * a, -b, 0.55 * b, 0.1, top), (-a + 0.1, 0.7 * a - 0.1, -b + 0.1, 0.5 * b, 0.0, 0.1),
        (-a, split, 0.55 * b, 0.85 * b, 0.1, top), (0.35 * a, 0.7 * a, 0.55 * b, 0.85 * b, 0.1, top),
        (split, 0.35 * a, 0.55 * b, 0.85 * b, 0.1, 0.45 * top), (0.75 * a, a, 0.3 * b, 0.0, 0.8),
        (0.45 * a, 0.7 * a, 0.88 * b, 0.98 * b, 1.1, 1.7),
    )  # fmt: skip
    spot.cylinder((0.6 * a, 0.7 * b, top), (0.6 * a, 0.95 * b, top), 0.04)
    spot.pole((-0.5 * a, 0.0), (top, z), 0.15)


def tank(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """An upright tank on legs with a flange on top, a pipe down its side and a ladder."""
    (x, y, z), legs = size, 0.5 * rng.uniform(0.6, 1.2)
    radius = 0.5 * min(x, y) - 0.15
    spot.poles(
        (0.0, 0.0, legs, z - 0.3, radius), (0.0, 0.0, z - 0.3, z, 0.35 * radius),
        (0.0, 0.0, 0.6 * z, 0.6 * z + 0.08, radius + 0.05),
    )  # fmt: skip
    for angle in np.arange(4) * 0.5 * np.pi + 0.25 * np.pi:
        spot.pole((0.8 * radius * np.cos(angle), 0.8 * radius * np.sin(angle)), (0.0, legs), 0.07)
    spot.pole((0.0, radius + 0.06), (0.0, z - 0.5), 0.05)
    spot.block((radius, radius + 0.12), (-0.2, 0.2), starting(np.arange(0.4, z - 0.4, 0.35), 0.03))


def conveyor(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A belt on legs with side guides and parcels on it."""
    x, y, z = size
    a, b, belt = 0.5 * x, min(0.5 * y, 0.5), min(0.9, z)
    spot.block((-a, a), (-b, b), (belt - 0.15, belt))
    spot.block((-a, a), [(-b, 0.04 - b), (b - 0.04, b)], (belt, belt + 0.12))
    for leg in np.linspace(-a + 0.2, a - 0.2, max(2, int(x / 1.5))):
        spot.poles(*((leg, sign * (b - 0.08), 0.0, belt - 0.1, 0.035) for sign in (-1.0, 1.0)))
    at = -a + 0.3
    while at < a - 0.6:
        length, height = rng.uniform(0.25, 0.55, 2)
        spot.block((at, at + length), (-0.25, 0.2), (belt, belt + height))
        at += length + rng.uniform(0.2, 1.2)
    spot.block((-a + 0.3, -a + 0.9), (b, b + 0.3), (0.4, belt))


def robot_cell(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A fence of posts and bars around a jointed arm and its fixture."""
    a, b, fence = 0.5 * size[0], 0.5 * size[1], min(2.0, size[2])
    for sign in (-1.0, 1.0):
        posts = around(np.linspace(-a, a, max(2, round(size[0] / 1.2))), 0.03)
        spot.block(posts, (sign * b - 0.03, sign * b + 0.03), (0.0, fence))
        for bar in (0.2, 1.1, fence - 0.05):
            spot.block((-a, a), (sign * b - 0.015, sign * b + 0.015), (bar, bar + 0.05))
            spot.block((sign * a - 0.015, sign * a + 0.015), (-b, b), (bar, bar + 0.05))
    angle, reach = rng.uniform(0.0, 2.0 * np.pi), 0.45 * min(a, b)
    elbow = (reach * np.cos(angle), reach * np.sin(angle), 1.7)
    spot.pole((0.0, 0.0), (0.4, 0.9), 0.25)
    spot.cylinder((0.0, 0.0, 0.9), elbow, 0.13)
    spot.cylinder(elbow, (1.6 * elbow[0], 1.6 * elbow[1], 1.2), 0.1)
    spot.blocks((0.35, 0.35, 0.0, 0.4), (0.4 * a, 0.8 * a, 0.6 * b, 0.0, 0.8))


def generator(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A motor lying on a frame, a gear box, an exhaust with a bend and cooling ribs."""
    a, b, z, axis = 0.5 * size[0], 0.5 * size[1], size[2], 0.45 * size[2]
    radius, top = min(0.6 * b, 0.3 * z), rng.uniform(0.85, 1.0) * z
    spot.cylinder((-0.8 * a, 0.0, axis), (0.2 * a, 0.0, axis), radius)
    for rib in np.linspace(-0.7 * a, 0.1 * a, 5):
        spot.cylinder((rib, 0.0, axis), (rib + 0.06, 0.0, axis), radius + 0.08)
    spot.cylinder((0.2 * a, 0.0, axis), (0.45 * a, 0.0, axis), 0.12)
    spot.blocks(
        (a, 0.8 * b, 0.0, 0.2), (-0.7 * a, 0.1 * a, 0.6 * radius, 0.2, axis - 0.5 * radius),
        (0.45 * a, 0.95 * a, 0.7 * b, 0.2, axis + 0.8 * radius),
    )  # fmt: skip
    spot.pole((-0.5 * a, 0.0), (axis, top), 0.12)
    spot.cylinder((-0.5 * a, 0.0, top - 0.1), (-0.5 * a, 0.8 * b, top - 0.1), 0.1)


def control_cabinets(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A row of switch cabinets of one height with protruding doors, a cable duct on top."""
    x, y, z = size
    a, b, top = 0.5 * x, min(0.5 * y, 0.35), min(z, 2.1)
    for left, right in pairwise(np.linspace(-a, a, max(2, round(x / 0.8) + 1))):
        spot.block((left, right), (-b, b - 0.03), (0.0, top))
        spot.block((left + 0.03, right - 0.03), (b - 0.03, b), (0.12, top - rng.uniform(0.04, 0.5)))
    spot.block((-a, a), (-0.1, 0.1), (top, top + 0.15))


# Each machine with the least and the most of its length, width and height.
MACHINES: tuple[tuple[Piece, Size, Size], ...] = (
    (press, (1.8, 1.4, 3.0), (3.2, 2.2, 5.0)),
    (machining_centre, (2.8, 1.8, 2.0), (4.8, 2.8, 2.9)),
    (tank, (1.4, 1.4, 2.4), (2.8, 2.8, 5.0)),
    (conveyor, (3.5, 1.3, 1.0), (8.0, 1.6, 1.6)),
    (robot_cell, (3.2, 3.0, 2.0), (5.0, 4.2, 2.4)),
    (generator, (2.4, 1.4, 1.6), (4.2, 2.4, 3.0)),
    (control_cabinets, (1.8, 0.8, 2.0), (4.2, 0.9, 2.3)),
)


def rack(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """A pallet rack of whole bays and levels: uprights with braces, beams, and pallets with goods in most places."""
    bays, levels = round(size[0] / BAY_M), round(size[2] / 1.6)
    a, b, rise = 0.5 * bays * BAY_M, 0.5 * RACK_DEPTH_M, rng.uniform(1.3, 1.6)
    top = levels * rise
    for x in -a + np.arange(bays + 1) * BAY_M:
        spot.block((x - 0.05, x + 0.05), around((-b, b), 0.04), (0.0, top))
        for z in np.arange(0.3, top - 0.6, 1.2):
            spot.cylinder((x, -b, z), (x, b, z + 0.6), 0.02)
    for level in range(levels):
        z = level * rise
        if level:
            spot.block((-a, a), around((-b, b), 0.03), (z - 0.06, z + 0.06))
        for x in np.arange(-a + 0.72, a, 0.5 * BAY_M):
            if rng.random() < 0.75:
                pallet(spot.shifted(x, 0.0, z + (0.06 if level else 0.0)), rise - 0.35, rng)


def pallet(spot: Builder, most: float, rng: np.random.Generator) -> None:
    """A pallet, 1.2 by 0.9 m, with one load on it or several, at most `most` high."""
    spot.block((-0.6, 0.6), (-0.45, 0.45), (0.02, 0.14))
    if rng.random() < 0.5:
        spot.blocks((rng.uniform(0.45, 0.6), rng.uniform(0.35, 0.46), 0.14, rng.uniform(0.5, 1.0) * most))
        return
    for x in (-0.58, 0.02):
        spot.block((x, x + 0.56), (-0.42, rng.uniform(-0.05, 0.42)), (0.14, rng.uniform(0.3, 0.95) * most))


def drums(spot: Builder, size: Size, rng: np.random.Generator) -> None:
    """Oil drums in two rows, some on top of others."""
    columns = round(size[0] / 0.62)
    for k in range(columns):
        for y in (-0.31, 0.31):
            for z in (0.0, 0.89)[: 1 + int(rng.random() < 0.3)]:
                spot.pole(((k - 0.5 * (columns - 1)) * 0.62, y), (z, z + 0.88), 0.29)


def cabin(spot: Builder, size: Size, rng: np.random.Generator) -> None:  # noqa: ARG001
    """A foreman's cabin: windows set back in two sides, a door, a projecting roof."""
    a, b = 0.5 * (size[0] - 0.4), 0.5 * (size[1] - 0.4)
    spot.blocks((a - 0.08, b - 0.08, 0.0, 2.4), (a, b, 0.0, 1.0), (a, b, 2.1, 2.4))
    spot.block(starting((-a, a - 0.15), 0.15), starting((-b, b - 0.15), 0.15), (1.0, 2.1))
    spot.blocks((-0.45, 0.45, -b - 0.03, -b + 0.05, 0.0, 2.05), (a + 0.2, b + 0.2, 2.4, 2.5))


def forklift(rng: np.random.Generator) -> Boxes:
    """A fork-lift in its own frame: x forwards, the origin on the ground below its middle; 3.2 m long, 1.2 m wide."""
    spot = Builder()
    spot.blocks(
        (-1.2, 0.5, 0.55, 0.18, 0.95), (-1.3, -0.7, 0.5, 0.3, 1.25),
        (-0.45, 0.0, 0.25, 0.95, 1.15), (-0.5, -0.38, 0.25, 1.15, 1.65),
    )  # fmt: skip
    for x in (-0.75, 0.4):
        for y in (-0.5, 0.5):
            spot.block((x - 0.04, x + 0.04), (y - 0.04, y + 0.04), (0.95, 2.1))
            spot.block((x - 0.28, x + 0.28), (y - 0.1, y + 0.1), (0.0, 0.56))
    spot.blocks((-0.85, 0.5, 0.55, 2.1, 2.16))
    carriage = rng.uniform(0.1, 1.0)
    for y in (-0.3, 0.3):
        spot.block((0.6, 0.75), (y - 0.06, y + 0.06), (0.05, 2.3))
        spot.block((0.85, 1.9), (y - 0.06, y + 0.06), (carriage, carriage + 0.05))
    spot.blocks((0.76, 0.84, 0.5, carriage, carriage + 0.6))
    if rng.random() < 0.6:
        pallet(spot.shifted(1.4, 0.0, carriage + 0.05), rng.uniform(0.6, 1.0), rng)
    return spot.boxes
