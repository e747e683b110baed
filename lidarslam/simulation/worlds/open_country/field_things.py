"""What little stands in open fields: poles, fences, hedges, trees, bales, a barn; all off the road."""

from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField
from lidarslam.simulation.worlds.building import Builder
from lidarslam.simulation.worlds.furnishing import SUNK_M, upright
from lidarslam.simulation.worlds.open_country import plants
from lidarslam.simulation.worlds.paths import beside_loop, distance_to_loop, on_ground

_POINT_M = 0.5  # between the points of a road
_KEEP_OFF_M = 4.5


def poles(solid: Builder, rng: np.random.Generator, road: FloatArray, ground: HeightField) -> None:
    """A line of telegraph poles with cross-arms along a third of the road."""
    left, spacing = rng.choice([-1.0, 1.0]) * rng.uniform(6.0, 9.0), rng.uniform(45.0, 60.0)
    first = int(rng.integers(len(road)))
    for at in np.arange(0.0, len(road) * _POINT_M / 3.0, spacing):
        where, yaw = beside_loop(road, (first + round(at / _POINT_M)) % len(road), left)
        part = Builder()
        part.pole(np.zeros(2), (-1.0, 7.2), 0.12)
        part.block((-0.05, -0.8, 6.7), (0.05, 0.8, 6.82))
        solid.place(part, upright(ground, where, yaw))


def fences(solid: Builder, rng: np.random.Generator, road: FloatArray, ground: HeightField) -> None:
    """Posts and two rails along a few stretches of the road, as far from it as a verge is wide."""
    for at in rng.integers(0, len(road), 4):
        left, count = rng.choice([-1.0, 1.0]) * rng.uniform(5.0, 7.0), int(rng.integers(15, 30))
        step = round(3.0 / _POINT_M)
        feet = np.stack([beside_loop(road, (at + k * step) % len(road), left)[0] for k in range(count)])
        posts = on_ground(feet, ground)
        for foot in posts:
            solid.pole(foot[:2], (foot[2] - SUNK_M, foot[2] + 1.25), 0.06)
        for a, b in pairwise(posts):
            for high in (0.55, 1.05):
                rise = np.array([0.0, 0.0, high])
                solid.beam(a + rise, b + rise, 0.04, 0.12)


def barn(solid: Builder, rng: np.random.Generator, road: FloatArray, ground: HeightField) -> None:
    """One barn with a pitched roof, some way off the road."""
    where, yaw = beside_loop(road, int(rng.integers(len(road))), rng.choice([-1.0, 1.0]) * rng.uniform(25.0, 40.0))
    while distance_to_loop(where[None], road)[0] < 22.0:
        where, yaw = beside_loop(road, int(rng.integers(len(road))), rng.choice([-1.0, 1.0]) * rng.uniform(25.0, 40.0))
    part = Builder()
    long, wide, high = rng.uniform(7.0, 10.0), rng.uniform(4.5, 6.0), rng.uniform(3.8, 5.0)  # half, half, all
    part.block((-long, -wide, -2.0), (long, wide, high))
    ridge = high + 0.5 * wide
    for eave in (-wide - 0.4, wide + 0.4):
        part.beam(np.array([0.0, eave, high - 0.2]), np.array([0.0, 0.0, ridge]), 2.0 * long + 0.8, 0.15)
    for fraction in (0.15, 0.4, 0.65):  # the gables, in steps
        inset = fraction * wide
        part.block((-long, -wide + inset, high), (long, wide - inset, high + fraction * (ridge - high)))
    solid.place(part, upright(ground, where, yaw + rng.normal(0.0, 0.2)))


def bales(solid: Builder, rng: np.random.Generator, road: FloatArray, ground: HeightField) -> None:
    """Round bales, lying about two parcels."""
    for at in rng.integers(0, len(road), 2):
        middle, _ = beside_loop(road, int(at), rng.choice([-1.0, 1.0]) * rng.uniform(25.0, 35.0))
        for where in middle + rng.uniform(-35.0, 35.0, (int(rng.integers(6, 11)), 2)):
            if distance_to_loop(where[None], road)[0] < _KEEP_OFF_M + 1.0:
                continue
            angle = rng.uniform(0.0, np.pi)
            axis = 0.6 * np.array([np.cos(angle), np.sin(angle), 0.0])
            centre = on_ground(where[None], ground)[0] + np.array([0.0, 0.0, 0.55])
            solid.cylinder(centre - axis, centre + axis, 0.65)


def hedges(green: Builder, rng: np.random.Generator, road: FloatArray, ground: HeightField) -> None:
    """Hedges between parcels, from the verge away from the road."""
    for at in rng.integers(0, len(road), 6):
        side = rng.choice([-1.0, 1.0])
        begin, yaw = beside_loop(road, int(at), side * rng.uniform(7.0, 10.0))
        heading = yaw + side * 0.5 * np.pi + rng.normal(0.0, 0.15)
        away = np.array([np.cos(heading), np.sin(heading)])
        high, wide, length = rng.uniform(1.2, 1.9), rng.uniform(0.8, 1.3), 4.0
        for k in range(int(rng.integers(6, 12))):
            where = begin + k * length * away
            if distance_to_loop(where[None] + np.array([[0.0], [length]]) * away, road).min() > _KEEP_OFF_M + 1.5:
                green.place(plants.hedge(rng, length, high, wide), upright(ground, where, heading))


def trees(green: Builder, rng: np.random.Generator, road: FloatArray, ground: HeightField, farthest_m: float) -> None:
    """Single trees far from one another, and some bushes."""
    low, high = road.min(axis=0) - 0.7 * farthest_m, road.max(axis=0) + 0.7 * farthest_m
    stands = np.empty((0, 2))
    darts = rng.uniform(low, high, (150, 2))
    for where, distance in zip(darts, distance_to_loop(darts, road), strict=True):
        apart = np.linalg.norm(stands - where, axis=1).min(initial=np.inf)
        if not _KEEP_OFF_M + 2.0 < distance < 0.8 * farthest_m or apart < 55.0:
            continue
        tree = plants.broadleaf(rng, rng.uniform(7.0, 13.0), rng.uniform(0.18, 0.4), 80)
        green.place(tree, upright(ground, where, rng.uniform(0.0, 2.0 * np.pi)))
        stands = np.concatenate([stands, where[None]])
    for at in rng.integers(0, len(road), 14):
        where, _ = beside_loop(road, int(at), rng.choice([-1.0, 1.0]) * rng.uniform(6.5, 25.0))
        if distance_to_loop(where[None], road)[0] > _KEEP_OFF_M + 1.5:
            green.place(plants.bush(rng, rng.uniform(0.5, 1.2), 24), upright(ground, where, 0.0))
