"""Open, rolling fields with a road round them: grass and crops, and a few fences, hedges, trees and poles."""

from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Route, World
from lidarslam.simulation.worlds import outdoor, paths
from lidarslam.simulation.worlds.building import UP, Builder, relief, smooth_noise
from lidarslam.simulation.worlds.outdoor import SUNK_M, Grounds, beside

_CELL_M = 0.75
_MARGIN_M = 70.0
_ROAD_HALF_M = 2.8
_KEEP_OFF_M = 4.5
_POINT_M = 0.5  # between the points of the road


def build(seed: int) -> World:
    """Fields; a road of two gently winding kilometres that can be driven at 30 m/s for half of it."""
    rng = np.random.default_rng(seed)
    road = _road(rng)
    low, nodes = paths.grid_around(road, _MARGIN_M, _CELL_M)
    distance = paths.distance_to_loop(nodes, road, 12.0)
    # Swells some 150 m long and several metres high; fields are rough, the road is smooth and a little raised.
    heights = relief(rng, distance.shape, (rng.uniform(2.0, 3.0), 50.0 / _CELL_M), (0.35, 24.0 / _CELL_M))
    off_road = np.clip((distance - _ROAD_HALF_M) / 1.5, 0.0, 1.0)
    heights += (0.1 + 0.9 * off_road) * 0.05 * smooth_noise(rng, distance.shape, 2.0 / _CELL_M)
    heights += off_road * 0.035 * smooth_noise(rng, distance.shape, 0.7) - 0.2 * off_road
    ground = HeightField(low, _CELL_M, heights)
    grounds = Grounds(rng, road, ground)
    for things in (_poles, _fences, _barn, _bales, _hedges, _trees):
        things(grounds)
    # Without the first there is a leg of twice the length: a lap begins in its middle.
    route = Route(paths.on_ground(paths.resample_loop(road, 2.0)[1:], ground), 3.0, 2.4, 4.0, 28.0)  # 100 km/h
    grounds.prune(route)
    # Stubble, meadow or crops in parcels, a mown strip along the road.
    kind = np.digitize(smooth_noise(rng, distance.shape, 40.0 / _CELL_M), [-0.4, 0.5])
    tall = np.where(distance < _ROAD_HALF_M + 2.0, 0.12, np.array([0.06, 0.22, 0.4])[kind])
    grass = outdoor.grass(rng, ground, tall, distance - _ROAD_HALF_M)
    return World("fields", seed, route, *grounds.solid.solids, (ground,), map_spacing_m=0.1, grass=grass)


def _road(rng: np.random.Generator) -> FloatArray:
    """A long closed line (N, 2): two sides that sway gently, joined by wide bends.

    It begins a quarter along a side; the sides' bends are wider than 250 m, so that 3.5 m/s^2 across allow 30 m/s.
    """
    side, radius = rng.uniform(560.0, 640.0), rng.uniform(95.0, 115.0)
    corners = np.array([[-0.5, -1.0], [0.5, -1.0], [0.5, 1.0], [-0.5, 1.0]]) * [side + 2.0 * radius, radius]
    loop = paths.resample_loop(paths.round_corners(corners, np.full(4, 0.999 * radius), 2.0), _POINT_M)
    for amplitude, wave in ((rng.uniform(6.0, 10.0), 450.0), (rng.uniform(1.0, 2.5), 230.0)):
        phase = rng.uniform(0.0, 2.0 * np.pi)
        loop[:, 1] += amplitude * np.sin(2.0 * np.pi * loop[:, 0] / wave + phase)
    begin = np.abs(loop - [-0.25 * side, loop[:, 1].min()]).sum(axis=1).argmin()
    return np.roll(loop, -begin, axis=0)[:: rng.choice([-1, 1])]


def _poles(grounds: Grounds) -> None:
    """A line of telegraph poles with cross-arms along a third of the road."""
    rng, road = grounds.rng, grounds.path
    left, spacing = beside(rng, 6.0, 9.0), rng.uniform(45.0, 60.0)
    first = int(rng.integers(len(road)))
    part = Builder()
    part.pole((0.0, 0.0), (-1.0, 7.2), 0.12)
    part.block((-0.05, 0.05), (-0.8, 0.8), (6.7, 6.82))
    for at in np.arange(0.0, len(road) * _POINT_M / 3.0, spacing):
        grounds.put(part, *grounds.beside(first + round(at / _POINT_M), left))


def _fences(grounds: Grounds) -> None:
    """Posts and two rails along a few stretches of the road, as far from it as a verge is wide."""
    rng, step = grounds.rng, round(3.0 / _POINT_M)
    for at in rng.integers(0, len(grounds.path), 4):
        left, count = beside(rng, 5.0, 7.0), int(rng.integers(15, 30))
        feet = np.stack([grounds.beside(at + k * step, left)[0] for k in range(count)])
        posts = paths.on_ground(feet, grounds.ground)
        for foot in posts:
            grounds.solid.pole(foot[:2], (foot[2] - SUNK_M, foot[2] + 1.25), 0.06)
        for a, b in pairwise(posts):
            for high in (0.55, 1.05):
                grounds.solid.beam(a + high * UP, b + high * UP, 0.04, 0.12)


def _barn(grounds: Grounds) -> None:
    rng, road = grounds.rng, grounds.path
    where, yaw = road[0], 0.0
    while grounds.off_path(where) < 22.0:
        where, yaw = grounds.beside(int(rng.integers(len(road))), beside(rng, 25.0, 40.0))
    part = Builder()
    long, wide, high = rng.uniform(7.0, 10.0), rng.uniform(4.5, 6.0), rng.uniform(3.8, 5.0)  # half, half, all
    part.block((-long, long), (-wide, wide), (-2.0, high))
    ridge = high + 0.5 * wide
    for eave in (-wide - 0.4, wide + 0.4):
        part.beam((0.0, eave, high - 0.2), (0.0, 0.0, ridge), 2.0 * long + 0.8, 0.15)
    for fraction in (0.15, 0.4, 0.65):  # the gables, in steps
        inset = fraction * wide
        part.block((-long, long), (-wide + inset, wide - inset), (high, high + fraction * (ridge - high)))
    grounds.put(part, where, yaw + rng.normal(0.0, 0.2))


def _bales(grounds: Grounds) -> None:
    rng = grounds.rng
    for at in rng.integers(0, len(grounds.path), 2):
        middle, _ = grounds.beside(at, beside(rng, 25.0, 35.0))
        for where in middle + rng.uniform(-35.0, 35.0, (int(rng.integers(6, 11)), 2)):
            if grounds.off_path(where) >= _KEEP_OFF_M + 1.0:
                angle = rng.uniform(0.0, np.pi)
                axis = 0.6 * np.array([np.cos(angle), np.sin(angle), 0.0])
                centre = paths.on_ground(where[None], grounds.ground)[0] + 0.55 * UP
                grounds.solid.cylinder(centre - axis, centre + axis, 0.65)


def _hedges(grounds: Grounds) -> None:
    rng = grounds.rng
    for at in rng.integers(0, len(grounds.path), 6):
        side = rng.choice([-1.0, 1.0])
        begin, yaw = grounds.beside(at, side * rng.uniform(7.0, 10.0))
        heading = yaw + side * 0.5 * np.pi + rng.normal(0.0, 0.15)
        away = np.array([np.cos(heading), np.sin(heading)])
        high, wide, length = rng.uniform(1.2, 1.9), rng.uniform(0.8, 1.3), 4.0
        for k in range(int(rng.integers(6, 12))):
            where = begin + k * length * away
            if grounds.off_path(where + np.array([[0.0], [length]]) * away) > _KEEP_OFF_M + 1.5:
                grounds.put(outdoor.hedge(rng, length, high, wide), where, heading, is_green=True)


def _trees(grounds: Grounds) -> None:
    rng, road = grounds.rng, grounds.path
    low, high = road.min(axis=0) - 0.7 * _MARGIN_M, road.max(axis=0) + 0.7 * _MARGIN_M
    stands = np.empty((0, 2))
    darts = rng.uniform(low, high, (150, 2))
    for where, distance in zip(darts, paths.distance_to_loop(darts, road), strict=True):
        apart = np.linalg.norm(stands - where, axis=1).min(initial=np.inf)
        if _KEEP_OFF_M + 2.0 < distance < 0.8 * _MARGIN_M and apart >= 55.0:
            grounds.put(outdoor.old_tree(rng), where, is_green=True)
            stands = np.concatenate([stands, where[None]])
    for at in rng.integers(0, len(road), 14):
        where, _ = grounds.beside(at, beside(rng, 6.5, 25.0))
        if grounds.off_path(where) > _KEEP_OFF_M + 1.5:
            grounds.put(outdoor.bush(rng, rng.uniform(0.5, 1.2), 24), where, 0.0, is_green=True)
