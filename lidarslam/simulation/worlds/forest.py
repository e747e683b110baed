"""A forest with a winding track: trunks of all sizes, fallen ones, boulders and bushes on bumpy, sloping ground."""

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Route, World
from lidarslam.simulation.worlds import outdoor, paths
from lidarslam.simulation.worlds.building import UP, relief
from lidarslam.simulation.worlds.outdoor import Grounds, on_slope

_CELL_M = 0.4
_MARGIN_M = 32.0
_FREE_SIDE_M = 1.3


def build(seed: int) -> World:
    """A forest; its track is just wide enough to pass."""
    rng = np.random.default_rng(seed)
    track = paths.winding_loop(rng, rng.uniform(160.0, 290.0), 6, 0.6, 4.0)
    low, nodes = paths.grid_around(track, _MARGIN_M, _CELL_M)
    distance = paths.distance_to_loop(nodes, track)
    # Slopes of up to a sixth or so, knolls, and bumps that are worn down on the track.
    heights = relief(rng, distance.shape, (rng.uniform(1.0, 2.0), 16.0 / _CELL_M), (0.22, 4.0 / _CELL_M))
    untrodden = np.clip((distance - 0.5) / 1.5, 0.3, 1.0)
    heights += untrodden * relief(rng, distance.shape, (0.09, 1.0 / _CELL_M), (0.02, 0.7))
    ground = HeightField(low, _CELL_M, heights)
    grounds = Grounds(rng, track, ground)
    _trees(grounds)
    _floor(grounds)
    route = Route(paths.on_ground(paths.resample_loop(track, 1.5), ground), 1.5, _FREE_SIDE_M, 2.6, 3.0)
    grounds.prune(route)
    return World("forest", seed, route, *grounds.solid.solids, (ground,), map_spacing_m=0.1)


def _scatter(grounds: Grounds, count: int, from_track_m: tuple[float, float], apart_m: float) -> FloatArray:
    """Up to `count` places (N, 2) at that distance from the track and no closer to one another than `apart_m`."""
    track = grounds.path
    low, high = track.min(axis=0) - _MARGIN_M + 2.0, track.max(axis=0) + _MARGIN_M - 2.0
    darts = grounds.rng.uniform(low, high, (12 * count, 2))
    distance = paths.distance_to_loop(darts, track)
    darts = darts[(distance > from_track_m[0]) & (distance < from_track_m[1])]
    is_kept = np.zeros(len(darts), dtype=bool)
    for k, others in enumerate(cKDTree(darts).query_ball_point(darts, apart_m)):
        is_kept[k] = not is_kept[others].any()
    return darts[is_kept][:count]


def _trees(grounds: Grounds) -> None:
    """Spruces and beeches, thick ones and saplings, in shares that differ from forest to forest."""
    rng = grounds.rng
    places = _scatter(grounds, int(rng.integers(320, 400)), (_FREE_SIDE_M + 1.1, 30.0), 2.1)
    beeches = rng.uniform(0.15, 0.6)
    for where in places:
        radius = float(np.clip(rng.lognormal(-1.65, 0.4), 0.1, 0.5))
        height = rng.uniform(7.0, 10.0) + 20.0 * radius
        if rng.random() < beeches:
            tree = outdoor.broadleaf(rng, 0.8 * height, radius, 17)
        else:
            tree = outdoor.conifer(rng, height, radius, 15)
        grounds.put(tree, where, is_green=True)


def _floor(grounds: Grounds) -> None:
    rng, ground, green = grounds.rng, grounds.ground, grounds.green
    for where in _scatter(grounds, 26, (_FREE_SIDE_M + 0.8, 25.0), 6.0):
        length, radius, yaw = rng.uniform(4.0, 11.0), rng.uniform(0.14, 0.38), rng.uniform(0.0, np.pi)
        ends = where + np.outer([-0.5, -0.25, 0.25, 0.5], length * np.array([np.cos(yaw), np.sin(yaw)]))
        if grounds.off_path(ends) > _FREE_SIDE_M + 4.0 * radius:
            green.place(outdoor.fallen_trunk(rng, length, radius), on_slope(ground, where, yaw, 0.7 * length, 1.0))
    for where in paths.on_ground(_scatter(grounds, 45, (_FREE_SIDE_M + 1.5, 25.0), 3.0), ground):
        size = rng.uniform(0.5, 1.7)
        for _ in range(int(rng.integers(2, 5))):  # boxes through one another make a boulder of many faces
            turn = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
            centre = where + 0.1 * size * UP + rng.normal(0.0, 0.12 * size, 3)
            green.box(centre, size * rng.uniform(0.55, 0.9, 3), R=turn)
    for where in _scatter(grounds, 60, (_FREE_SIDE_M + 0.9, 25.0), 2.5):
        grounds.put(outdoor.bush(rng, rng.uniform(0.35, 0.9), 20), where, 0.0, is_green=True)
    for x, y, level in paths.on_ground(_scatter(grounds, 30, (_FREE_SIDE_M + 0.6, 20.0), 4.0), ground):  # stumps
        green.pole((x, y), (level - 0.4, level + rng.uniform(0.2, 0.6)), rng.uniform(0.12, 0.35))
    for where in _scatter(grounds, 3, (_FREE_SIDE_M + 3.0, 8.0), 25.0):
        pile = outdoor.log_pile(rng, int(rng.integers(3, 6)))
        green.place(pile, on_slope(ground, where, rng.uniform(0.0, np.pi), 2.0, 1.0))
