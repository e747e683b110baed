"""Worlds along a winding way on open ground: a forest, a park, fields."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Mover, Route, World
from lidarslam.simulation.worlds import outdoor, paths
from lidarslam.simulation.worlds.building import UP, Builder, around, relief, smooth_noise
from lidarslam.simulation.worlds.outdoor import SUNK_M, Grounds, beside, on_slope

_FOREST_MARGIN_M = 32.0
_TRACK_SIDE_M = 1.3


def forest(seed: int) -> World:
    """A forest; its track is just wide enough to pass."""
    rng, cell = np.random.default_rng(seed), 0.4
    track = paths.winding_loop(rng, rng.uniform(160.0, 290.0), 6, 0.6, 4.0)
    low, nodes = paths.grid_around(track, _FOREST_MARGIN_M, cell)
    distance = paths.distance_to_loop(nodes, track)
    # Slopes of up to a sixth or so, knolls, and bumps that are worn down on the track.
    heights = relief(rng, distance.shape, (rng.uniform(1.0, 2.0), 16.0 / cell), (0.22, 4.0 / cell))
    untrodden = np.clip((distance - 0.5) / 1.5, 0.3, 1.0)
    heights += untrodden * relief(rng, distance.shape, (0.09, 1.0 / cell), (0.02, 0.7))
    ground = HeightField(low, cell, heights)
    grounds = Grounds(rng, track, ground)
    _forest_trees(grounds)
    _forest_floor(grounds)
    route = Route(paths.on_ground(paths.resample_loop(track, 1.5), ground), 1.5, _TRACK_SIDE_M, 2.6, 3.0)
    grounds.prune(route)
    return World("forest", seed, route, *grounds.solid.solids, (ground,), map_spacing_m=0.1)


def _scatter(grounds: Grounds, count: int, from_track_m: tuple[float, float], apart_m: float) -> FloatArray:
    """Up to `count` places (N, 2) at that distance from the track and no closer to one another than `apart_m`."""
    track = grounds.path
    low, high = track.min(axis=0) - _FOREST_MARGIN_M + 2.0, track.max(axis=0) + _FOREST_MARGIN_M - 2.0
    darts = grounds.rng.uniform(low, high, (12 * count, 2))
    distance = paths.distance_to_loop(darts, track)
    darts = darts[(distance > from_track_m[0]) & (distance < from_track_m[1])]
    is_kept = np.zeros(len(darts), dtype=bool)
    for k, others in enumerate(cKDTree(darts).query_ball_point(darts, apart_m)):
        is_kept[k] = not is_kept[others].any()
    return darts[is_kept][:count]


def _forest_trees(grounds: Grounds) -> None:
    """Spruces and beeches, thick ones and saplings, in shares that differ from forest to forest."""
    rng = grounds.rng
    places = _scatter(grounds, int(rng.integers(320, 400)), (_TRACK_SIDE_M + 1.1, 30.0), 2.1)
    beeches = rng.uniform(0.15, 0.6)
    for where in places:
        radius = float(np.clip(rng.lognormal(-1.65, 0.4), 0.1, 0.5))
        height = rng.uniform(7.0, 10.0) + 20.0 * radius
        if rng.random() < beeches:
            tree = outdoor.broadleaf(rng, 0.8 * height, radius, 17)
        else:
            tree = outdoor.conifer(rng, height, radius, 15)
        grounds.put(tree, where, is_green=True)


def _forest_floor(grounds: Grounds) -> None:
    rng, ground, green = grounds.rng, grounds.ground, grounds.green
    for where in _scatter(grounds, 26, (_TRACK_SIDE_M + 0.8, 25.0), 6.0):
        length, radius, yaw = rng.uniform(4.0, 11.0), rng.uniform(0.14, 0.38), rng.uniform(0.0, np.pi)
        ends = where + np.outer([-0.5, -0.25, 0.25, 0.5], length * np.array([np.cos(yaw), np.sin(yaw)]))
        if grounds.off_path(ends) > _TRACK_SIDE_M + 4.0 * radius:
            green.place(outdoor.fallen_trunk(rng, length, radius), on_slope(ground, where, yaw, 0.7 * length, 1.0))
    for where in paths.on_ground(_scatter(grounds, 45, (_TRACK_SIDE_M + 1.5, 25.0), 3.0), ground):
        size = rng.uniform(0.5, 1.7)
        for _ in range(int(rng.integers(2, 5))):  # boxes through one another make a boulder of many faces
            turn = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
            centre = where + 0.1 * size * UP + rng.normal(0.0, 0.12 * size, 3)
            green.box(centre, size * rng.uniform(0.55, 0.9, 3), R=turn)
    for where in _scatter(grounds, 60, (_TRACK_SIDE_M + 0.9, 25.0), 2.5):
        grounds.put(outdoor.bush(rng, rng.uniform(0.35, 0.9), 20), where, 0.0, is_green=True)
    for x, y, level in paths.on_ground(_scatter(grounds, 30, (_TRACK_SIDE_M + 0.6, 20.0), 4.0), ground):  # stumps
        green.pole((x, y), (level - 0.4, level + rng.uniform(0.2, 0.6)), rng.uniform(0.12, 0.35))
    for where in _scatter(grounds, 3, (_TRACK_SIDE_M + 3.0, 8.0), 25.0):
        pile = outdoor.log_pile(rng, int(rng.integers(3, 6)))
        green.place(pile, on_slope(ground, where, rng.uniform(0.0, np.pi), 2.0, 1.0))


_PARK_MARGIN_M = 60.0
_PATH_SIDE_M = 1.8
# Interval of upright things along the path, however bare the rest is.
_LAMP_SPACING_M = 24.0


def park(seed: int) -> World:
    """A park; the path has something upright in sight everywhere, but little of it."""
    rng, cell = np.random.default_rng(seed), 0.5
    path = paths.winding_loop(rng, rng.uniform(240.0, 390.0), 4, 0.35, 12.0)
    low, nodes = paths.grid_around(path, _PARK_MARGIN_M, cell)
    distance = paths.distance_to_loop(nodes, path)
    # Swells some 25 m wide and up to a few metres high; the path itself is smoother than the grass.
    heights = relief(rng, distance.shape, (rng.uniform(0.9, 1.5), 22.0 / cell))
    on_grass = np.clip((distance - 1.0) / 1.5, 0.1, 1.0)
    heights += on_grass * relief(rng, distance.shape, (0.03, 1.5 / cell), (0.012, 0.7))
    ground = HeightField(low, cell, heights - 0.06 * (1.0 - on_grass))
    grounds = Grounds(rng, path, ground)
    _along_the_path(grounds)
    pavilion = _pavilion(grounds)
    _park_trees(grounds, pavilion)
    _park_borders(grounds, pavilion)
    route = Route(paths.on_ground(paths.resample_loop(path, 2.0), ground), 3.0, _PATH_SIDE_M, 3.0, 6.0)
    grounds.prune(route)
    return World("park", seed, route, *grounds.solid.solids, (ground,), _strollers(grounds), map_spacing_m=0.1)


def _along_the_path(grounds: Grounds) -> None:
    """Lamp posts on alternate sides, and between them a bench with a litter bin, a sign, or nothing."""
    rng, points = grounds.rng, len(grounds.path)
    count = max(6, round(0.5 * points / _LAMP_SPACING_M))
    side = 1.0
    for place in np.arange(count) + rng.uniform(-0.2, 0.2, count):
        at = int(place / count * points)
        grounds.put(outdoor.lamp_post(3.6, 0.0), *grounds.beside(at, side * rng.uniform(2.4, 3.2)))
        between = at + int(rng.integers(14, 30))
        if rng.random() < 0.5:
            where, yaw = grounds.beside(between, side * rng.uniform(2.9, 3.3))
            grounds.put(outdoor.bench(rng), where, yaw - side * 0.5 * np.pi)
            grounds.put(outdoor.litter_bin(), *grounds.beside(between + 4, side * 2.8))
        elif rng.random() < 0.3:
            grounds.put(outdoor.sign(rng), *grounds.beside(between, -side * 2.6))
        side = -side


def _pavilion(grounds: Grounds) -> FloatArray:
    """An open pavilion on columns next to the path; its middle and radius (3,), where nothing else may stand."""
    rng = grounds.rng
    size, high = rng.uniform(5.0, 8.0), rng.uniform(2.9, 3.4)
    where, yaw = grounds.path[0], 0.0
    while grounds.off_path(where) < 0.75 * size + 2.5:
        index, side = int(rng.integers(len(grounds.path))), rng.choice([-1.0, 1.0])
        where, yaw = grounds.beside(index, side * (0.75 * size + 4.0))
    part, half = Builder(), 0.5 * size
    part.blocks((half + 0.3, half + 0.3, -1.2, 0.18))
    part.poles(*((x, y, -1.2, high, 0.14) for x in np.linspace(-half, half, 3) for y in (-half, half)))
    # the back wall and a seat along it
    part.blocks(
        (-half, half, half - 0.1, half + 0.1, 0.1, high), (-half + 0.3, half - 0.3, half - 0.6, half - 0.1, 0.1, 0.6)
    )
    for y in (-half - 0.6, half + 0.6):
        part.beam((0.0, y, high - 0.15), (0.0, 0.0, high + 0.3 * size), size + 1.0, 0.12)
    part.block(around((-half, half), 0.08), (-0.12, 0.12), (high, high + 0.28 * size))
    part.blocks((half + 0.2, half + 0.2, high - 0.2, high))
    grounds.put(part, where, yaw)
    return np.append(where, 0.75 * size)


def _from_pavilion(xy: FloatArray, pavilion: FloatArray) -> float:
    """Distance of the nearest of points (..., 2) from the pavilion, a circle (3,)."""
    return float(np.linalg.norm(xy - pavilion[:2], axis=-1).min() - pavilion[2])


def _park_trees(grounds: Grounds, pavilion: FloatArray) -> None:
    """Old trees far apart, some in groups; those by the path start higher than anybody's head."""
    rng, path, reach = grounds.rng, grounds.path, 0.6 * _PARK_MARGIN_M
    stands = np.empty((0, 2))
    for where in rng.uniform(path.min(axis=0) - reach, path.max(axis=0) + reach, (400, 2)):
        apart = np.linalg.norm(stands - where, axis=1).min(initial=np.inf)
        is_crowded = apart < 15.0 or _from_pavilion(where, pavilion) <= 5.0
        if not 4.0 <= grounds.off_path(where) <= 45.0 or is_crowded or rng.random() < 0.45:
            continue
        group = where + rng.normal(0.0, 3.0, (int(rng.integers(1, 4)) if rng.random() < 0.25 else 1, 2))
        group[0] = where
        for foot in group:
            if grounds.off_path(foot) > 3.5:
                grounds.put(outdoor.old_tree(rng), foot, is_green=True)
        stands = np.concatenate([stands, group])


def _park_borders(grounds: Grounds, pavilion: FloatArray) -> None:
    rng, solid = grounds.rng, grounds.solid
    for at in rng.integers(0, len(grounds.path), 9):
        start, yaw = grounds.beside(at, beside(rng, 4.0, 9.0))
        length, high = rng.uniform(5.0, 12.0), rng.uniform(0.5, 1.2)
        end = start + length * np.array([np.cos(yaw), np.sin(yaw)])
        line = start + np.linspace(0.0, 1.0, 9)[:, None] * (end - start)
        if grounds.off_path(line) < 3.0 or _from_pavilion(line, pavilion) < 1.5:
            continue
        level = float(grounds.ground.height_at(line).mean())
        if rng.random() < 0.45:
            solid.wall(start, end, (level - 1.5, level + high), 0.35)
            solid.wall(start, end, (level + high - 0.01, level + high + 0.07), 0.45)
        else:
            for a, b in zip(line[:-1:2], line[2::2], strict=True):  # steps down a slope with the ground
                grounds.put(outdoor.hedge(rng, 0.25 * length, high, 0.7), 0.5 * (a + b), yaw, is_green=True)
    for at in rng.integers(0, len(grounds.path), 14):
        where, yaw = grounds.beside(at, beside(rng, 4.0, 16.0))
        if _from_pavilion(where, pavilion) > 1.5:
            grounds.put(outdoor.bush(rng, rng.uniform(0.6, 1.3), 24), where, yaw, is_green=True)


def _strollers(grounds: Grounds) -> tuple[Mover, ...]:
    """People who walk or run round the meadow next to the path, never on it."""
    rng, movers = grounds.rng, []
    for _ in range(int(rng.integers(2, 5))):
        radius, phase = rng.uniform(4.0, 8.0), rng.uniform(0.0, 2.0 * np.pi)
        angle = np.linspace(0.0, 2.0 * np.pi, 73)[:-1] * rng.choice([-1.0, 1.0]) + phase
        ellipse = radius * np.stack([np.cos(angle), 0.7 * np.sin(angle)], axis=1)
        circle = grounds.path.mean(axis=0) + rng.normal(0.0, 4.0, 2) + ellipse
        if grounds.off_path(circle) > _PATH_SIDE_M + 1.0:
            body = outdoor.pedestrian(rng).boxes
            movers.append(Mover(body, paths.on_ground(circle, grounds.ground), rng.uniform(1.0, 2.8), 0.0))
    return tuple(movers)


_FIELDS_MARGIN_M = 70.0
_ROAD_HALF_M = 2.8
_KEEP_OFF_M = 4.5
_POINT_M = 0.5  # between the points of the road


def fields(seed: int) -> World:
    """Fields; a road of two gently winding kilometres that can be driven at 30 m/s for half of it."""
    rng, cell = np.random.default_rng(seed), 0.75
    road = _road(rng)
    low, nodes = paths.grid_around(road, _FIELDS_MARGIN_M, cell)
    distance = paths.distance_to_loop(nodes, road, 12.0)
    # Swells some 150 m long and several metres high; fields are rough, the road is smooth and a little raised.
    heights = relief(rng, distance.shape, (rng.uniform(2.0, 3.0), 50.0 / cell), (0.35, 24.0 / cell))
    off_road = np.clip((distance - _ROAD_HALF_M) / 1.5, 0.0, 1.0)
    heights += (0.1 + 0.9 * off_road) * 0.05 * smooth_noise(rng, distance.shape, 2.0 / cell)
    heights += off_road * 0.035 * smooth_noise(rng, distance.shape, 0.7) - 0.2 * off_road
    ground = HeightField(low, cell, heights)
    grounds = Grounds(rng, road, ground)
    for things in (_poles, _fences, _barn, _bales, _hedges, _field_trees):
        things(grounds)
    # Without the first there is a leg of twice the length: a lap begins in its middle.
    route = Route(paths.on_ground(paths.resample_loop(road, 2.0)[1:], ground), 3.0, 2.4, 4.0, 28.0)  # 100 km/h
    grounds.prune(route)
    # Stubble, meadow or crops in parcels, a mown strip along the road.
    kind = np.digitize(smooth_noise(rng, distance.shape, 40.0 / cell), [-0.4, 0.5])
    tall = np.where(distance < _ROAD_HALF_M + 2.0, 0.12, np.array([0.06, 0.22, 0.4])[kind])
    grass = outdoor.grass(rng, ground, tall, distance - _ROAD_HALF_M)
    return World("fields", seed, route, *grounds.solid.solids, (ground,), map_spacing_m=0.1, grass=grass)


def ploughed(seed: int) -> World:
    """The fields of that seed, without grass."""
    return replace(fields(seed), name="ploughed", grass=None)


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


def _field_trees(grounds: Grounds) -> None:
    rng, road = grounds.rng, grounds.path
    low, high = road.min(axis=0) - 0.7 * _FIELDS_MARGIN_M, road.max(axis=0) + 0.7 * _FIELDS_MARGIN_M
    stands = np.empty((0, 2))
    darts = rng.uniform(low, high, (150, 2))
    for where, distance in zip(darts, paths.distance_to_loop(darts, road), strict=True):
        apart = np.linalg.norm(stands - where, axis=1).min(initial=np.inf)
        if _KEEP_OFF_M + 2.0 < distance < 0.8 * _FIELDS_MARGIN_M and apart >= 55.0:
            grounds.put(outdoor.old_tree(rng), where, is_green=True)
            stands = np.concatenate([stands, where[None]])
    for at in rng.integers(0, len(road), 14):
        where, _ = grounds.beside(at, beside(rng, 6.5, 25.0))
        if grounds.off_path(where) > _KEEP_OFF_M + 1.5:
            grounds.put(outdoor.bush(rng, rng.uniform(0.5, 1.2), 24), where, 0.0, is_green=True)
