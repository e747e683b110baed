"""A wide rolling meadow with a path round it: few trees, lamp posts and benches, low walls and hedges, a pavilion."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Mover, Route, World
from lidarslam.simulation.worlds import outdoor, paths
from lidarslam.simulation.worlds.building import Builder, around, relief
from lidarslam.simulation.worlds.outdoor import Grounds, beside

_CELL_M = 0.5
_MARGIN_M = 60.0
_FREE_SIDE_M = 1.8
# Interval of upright things along the path, however bare the rest is.
_LAMP_SPACING_M = 24.0


def build(seed: int) -> World:
    """A park; the path has something upright in sight everywhere, but little of it."""
    rng = np.random.default_rng(seed)
    path = paths.winding_loop(rng, rng.uniform(240.0, 390.0), 4, 0.35, 12.0)
    low, nodes = paths.grid_around(path, _MARGIN_M, _CELL_M)
    distance = paths.distance_to_loop(nodes, path)
    # Swells some 25 m wide and up to a few metres high; the path itself is smoother than the grass.
    heights = relief(rng, distance.shape, (rng.uniform(0.9, 1.5), 22.0 / _CELL_M))
    on_grass = np.clip((distance - 1.0) / 1.5, 0.1, 1.0)
    heights += on_grass * relief(rng, distance.shape, (0.03, 1.5 / _CELL_M), (0.012, 0.7))
    ground = HeightField(low, _CELL_M, heights - 0.06 * (1.0 - on_grass))
    grounds = Grounds(rng, path, ground)
    _along_the_path(grounds)
    pavilion = _pavilion(grounds)
    _trees(grounds, pavilion)
    _borders(grounds, pavilion)
    route = Route(paths.on_ground(paths.resample_loop(path, 2.0), ground), 3.0, _FREE_SIDE_M, 3.0, 6.0)
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


def _trees(grounds: Grounds, pavilion: FloatArray) -> None:
    """Old trees far apart, some in groups; those by the path start higher than anybody's head."""
    rng, path = grounds.rng, grounds.path
    stands = np.empty((0, 2))
    for where in rng.uniform(path.min(axis=0) - 0.6 * _MARGIN_M, path.max(axis=0) + 0.6 * _MARGIN_M, (400, 2)):
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


def _borders(grounds: Grounds, pavilion: FloatArray) -> None:
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
        if grounds.off_path(circle) > _FREE_SIDE_M + 1.0:
            body = outdoor.pedestrian(rng).boxes
            movers.append(Mover(body, paths.on_ground(circle, grounds.ground), rng.uniform(1.0, 2.8), 0.0))
    return tuple(movers)
