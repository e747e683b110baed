"""Goods in a hall: pallet racks, stacks, drums, a foreman's cabin, and the fork-lift that moves them."""

import numpy as np

from lidarslam.simulation.world import Boxes
from lidarslam.simulation.worlds.building import Builder, Spot
from lidarslam.simulation.worlds.interior import Size

RACK_DEPTH_M, BAY_M = 1.1, 2.8


def rack(spot: Spot, size: Size, rng: np.random.Generator) -> None:
    """A pallet rack of whole bays and levels: uprights with braces, beams, and pallets with goods in most places."""
    bays, levels = round(size[0] / BAY_M), round(size[2] / 1.6)
    a, b, rise = 0.5 * bays * BAY_M, 0.5 * RACK_DEPTH_M, rng.uniform(1.3, 1.6)
    top = levels * rise
    for x in -a + np.arange(bays + 1) * BAY_M:
        for y in (-b, b):
            spot.box((x - 0.05, x + 0.05), (y - 0.04, y + 0.04), (0.0, top))
        for z in np.arange(0.3, top - 0.6, 1.2):
            spot.rod((x, -b, z), (x, b, z + 0.6), 0.02)
    for level in range(levels):
        z = level * rise
        for y in (-b, b) if level else ():
            spot.box((-a, a), (y - 0.03, y + 0.03), (z - 0.06, z + 0.06))
        for x in np.arange(-a + 0.72, a, 0.5 * BAY_M):
            if rng.random() < 0.75:
                pallet(spot.shifted(x, 0.0, z + (0.06 if level else 0.0)), rise - 0.35, rng)


def pallet(spot: Spot, most: float, rng: np.random.Generator) -> None:
    """A pallet, 1.2 by 0.9 m, with one load on it or several, at most so high."""
    spot.box((-0.6, 0.6), (-0.45, 0.45), (0.02, 0.14))
    if rng.random() < 0.5:
        x, y = rng.uniform(0.45, 0.6), rng.uniform(0.35, 0.46)
        spot.box((-x, x), (-y, y), (0.14, rng.uniform(0.5, 1.0) * most))
        return
    for x in (-0.58, 0.02):
        spot.box((x, x + 0.56), (-0.42, rng.uniform(-0.05, 0.42)), (0.14, rng.uniform(0.3, 0.95) * most))


def loaded_pallet(spot: Spot, size: Size, rng: np.random.Generator) -> None:  # noqa: ARG001
    """A pallet with a load of up to 1.2 m."""
    pallet(spot, 1.2, rng)


def drums(spot: Spot, size: Size, rng: np.random.Generator) -> None:
    """Oil drums in two rows, some on top of others."""
    columns = round(size[0] / 0.62)
    for k in range(columns):
        for y in (-0.31, 0.31):
            for z in (0.0, 0.89)[: 1 + int(rng.random() < 0.3)]:
                spot.pillar((k - 0.5 * (columns - 1)) * 0.62, y, (z, z + 0.88), 0.29)


def cabin(spot: Spot, size: Size, rng: np.random.Generator) -> None:  # noqa: ARG001
    """A foreman's cabin: windows set back in two sides, a door, a roof that stands over."""
    a, b = 0.5 * (size[0] - 0.4), 0.5 * (size[1] - 0.4)
    spot.box((-a + 0.08, a - 0.08), (-b + 0.08, b - 0.08), (0.0, 2.4))
    spot.box((-a, a), (-b, b), (0.0, 1.0))
    spot.box((-a, a), (-b, b), (2.1, 2.4))
    for x in (-a, a - 0.15):
        for y in (-b, b - 0.15):
            spot.box((x, x + 0.15), (y, y + 0.15), (1.0, 2.1))
    spot.box((-0.45, 0.45), (-b - 0.03, -b + 0.05), (0.0, 2.05))
    spot.box((-a - 0.2, a + 0.2), (-b - 0.2, b + 0.2), (2.4, 2.5))


def forklift(rng: np.random.Generator) -> Boxes:
    """A fork-lift in its own frame: x forwards, the origin on the ground below its middle; 3.2 m long, 1.2 m wide."""
    builder = Builder()
    spot = Spot(builder, np.zeros(3), 0.0)
    spot.box((-1.2, 0.5), (-0.55, 0.55), (0.18, 0.95))
    spot.box((-1.3, -0.7), (-0.5, 0.5), (0.3, 1.25))
    spot.box((-0.45, 0.0), (-0.25, 0.25), (0.95, 1.15))
    spot.box((-0.5, -0.38), (-0.25, 0.25), (1.15, 1.65))
    for x in (-0.75, 0.4):
        for y in (-0.5, 0.5):
            spot.box((x - 0.04, x + 0.04), (y - 0.04, y + 0.04), (0.95, 2.1))
            spot.box((x - 0.28, x + 0.28), (y - 0.1, y + 0.1), (0.0, 0.56))
    spot.box((-0.85, 0.5), (-0.55, 0.55), (2.1, 2.16))
    carriage = rng.uniform(0.1, 1.0)
    for y in (-0.3, 0.3):
        spot.box((0.6, 0.75), (y - 0.06, y + 0.06), (0.05, 2.3))
        spot.box((0.85, 1.9), (y - 0.06, y + 0.06), (carriage, carriage + 0.05))
    spot.box((0.76, 0.84), (-0.5, 0.5), (carriage, carriage + 0.6))
    if rng.random() < 0.6:
        pallet(spot.shifted(1.4, 0.0, carriage + 0.05), rng.uniform(0.6, 1.0), rng)
    return builder.boxes
