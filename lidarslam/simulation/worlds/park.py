"""A wide rolling meadow with a path round it: few trees, lamp posts and benches, low walls and hedges, a pavilion."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Mover, Route, World
from lidarslam.simulation.worlds import outdoor, paths
from lidarslam.simulation.worlds.building import Builder, smooth_noise
from lidarslam.simulation.worlds.outdoor import upright

_CELL_M = 0.5
_MARGIN_M = 60.0
_FREE_SIDE_M = 1.8
# Interval of upright things along the path, however bare the rest is.
_LAMP_SPACING_M = 24.0


def build(seed: int) -> World:
    """A park; the path has something upright in sight everywhere, but little of it."""
    rng = np.random.default_rng(seed)
    path = paths.winding_loop(rng, rng.uniform(240.0, 390.0), 4, 0.35, 12.0)
    ground = _ground(rng, path)
    solid, green = Builder(), Builder()
    _along_the_path(solid, rng, path, ground)
    taken = _pavilion(solid, rng, path, ground)
    _trees(green, rng, path, ground, taken)
    _borders(solid, green, rng, path, ground, taken)
    route = Route(paths.on_ground(paths.resample_loop(path, 2.0), ground), 3.0, _FREE_SIDE_M, 3.0, 6.0)
    solid.place(paths.prune(green, route), np.eye(4))
    return World("park", seed, route, *solid.solids, (ground,), _strollers(rng, path, ground), map_spacing_m=0.1)


def _ground(rng: np.random.Generator, path: FloatArray) -> HeightField:
    """Swells some 25 m wide and up to a few metres high; the path itself is smoother than the grass."""
    low = np.floor(path.min(axis=0) - _MARGIN_M)
    distance = paths.distance_to_loop(paths.grid_nodes(low, path.max(axis=0) + _MARGIN_M, _CELL_M), path)
    shape = distance.shape
    on_grass = np.clip((distance - 1.0) / 1.5, 0.1, 1.0)
    heights = rng.uniform(0.9, 1.5) * smooth_noise(rng, shape, 22.0 / _CELL_M)
    heights += on_grass * (0.03 * smooth_noise(rng, shape, 1.5 / _CELL_M) + 0.012 * smooth_noise(rng, shape, 0.7))
    return HeightField(low, _CELL_M, heights - 0.06 * (1.0 - on_grass))


def _along_the_path(solid: Builder, rng: np.random.Generator, path: FloatArray, ground: HeightField) -> None:
    """Lamp posts on alternate sides, and between them a bench with a litter bin, a sign, or nothing."""
    count = max(6, round(0.5 * len(path) / _LAMP_SPACING_M))
    side = 1.0
    for place in np.arange(count) + rng.uniform(-0.2, 0.2, count):
        at = int(place / count * len(path)) % len(path)
        where, yaw = paths.beside_loop(path, at, side * rng.uniform(2.4, 3.2))
        solid.place(outdoor.lamp_post(3.6, 0.0), upright(ground, where, yaw))
        between = (at + int(rng.integers(14, 30))) % len(path)
        if rng.random() < 0.5:
            where, yaw = paths.beside_loop(path, between, side * rng.uniform(2.9, 3.3))
            solid.place(outdoor.bench(rng), upright(ground, where, yaw - side * 0.5 * np.pi))
            where, yaw = paths.beside_loop(path, (between + 4) % len(path), side * 2.8)
            solid.place(outdoor.litter_bin(), upright(ground, where, yaw))
        elif rng.random() < 0.3:
            where, yaw = paths.beside_loop(path, between, -side * 2.6)
            solid.place(outdoor.sign(rng), upright(ground, where, yaw))
        side = -side


def _pavilion(solid: Builder, rng: np.random.Generator, path: FloatArray, ground: HeightField) -> FloatArray:
    """An open pavilion on columns next to the path; its middle and radius (3,), where nothing else may stand."""
    size, high = rng.uniform(5.0, 8.0), rng.uniform(2.9, 3.4)
    where, yaw = path[0], 0.0
    while paths.distance_to_loop(where[None], path)[0] < 0.75 * size + 2.5:
        index, side = int(rng.integers(len(path))), rng.choice([-1.0, 1.0])
        where, yaw = paths.beside_loop(path, index, side * (0.75 * size + 4.0))
    part, half = Builder(), 0.5 * size
    part.block((-half - 0.3, -half - 0.3, -1.2), (half + 0.3, half + 0.3, 0.18))
    for x in np.linspace(-half, half, 3):
        for y in (-half, half):
            part.pole((x, y), (-1.2, high), 0.14)
    part.block((-half, half - 0.1, 0.1), (half, half + 0.1, high))  # the back wall
    part.block((-half + 0.3, half - 0.6, 0.1), (half - 0.3, half - 0.1, 0.6))
    for y in (-half - 0.6, half + 0.6):
        part.beam((0.0, y, high - 0.15), (0.0, 0.0, high + 0.3 * size), size + 1.0, 0.12)
    for x in (-half, half):
        part.block((x - 0.08, -0.12, high), (x + 0.08, 0.12, high + 0.28 * size))
    part.block((-half - 0.2, -half - 0.2, high - 0.2), (half + 0.2, half + 0.2, high))
    solid.place(part, upright(ground, where, yaw))
    return np.append(where, 0.75 * size)


def _from_pavilion(xy: FloatArray, taken: FloatArray) -> float:
    """Distance of the nearest of points (..., 2) from the pavilion, a circle (3,)."""
    return float(np.linalg.norm(xy - taken[:2], axis=-1).min() - taken[2])


def _trees(green: Builder, rng: np.random.Generator, path: FloatArray, ground: HeightField, taken: FloatArray) -> None:
    """Old trees far apart, some in groups; those by the path start higher than anybody's head."""
    low, high = path.min(axis=0) - 0.6 * _MARGIN_M, path.max(axis=0) + 0.6 * _MARGIN_M
    stands = np.empty((0, 2))
    for where in rng.uniform(low, high, (400, 2)):
        distance = float(paths.distance_to_loop(where[None], path)[0])
        apart = np.linalg.norm(stands - where, axis=1).min(initial=np.inf)
        is_crowded = apart < 15.0 or _from_pavilion(where, taken) <= 5.0
        if distance < 4.0 or distance > 45.0 or is_crowded or rng.random() < 0.45:
            continue
        group = where + rng.normal(0.0, 3.0, (int(rng.integers(1, 4)) if rng.random() < 0.25 else 1, 2))
        group[0] = where
        for foot in group:
            if paths.distance_to_loop(foot[None], path)[0] > 3.5:
                tree = outdoor.broadleaf(rng, rng.uniform(7.0, 13.0), rng.uniform(0.18, 0.4), 80)
                green.place(tree, upright(ground, foot, rng.uniform(0.0, 2.0 * np.pi)))
        stands = np.concatenate([stands, group])


def _borders(
    solid: Builder, green: Builder, rng: np.random.Generator, path: FloatArray, ground: HeightField, taken: FloatArray
) -> None:
    """A few low walls, hedges and bushes along the path."""
    for at in rng.integers(0, len(path), 9):
        start, yaw = paths.beside_loop(path, int(at), rng.choice([-1.0, 1.0]) * rng.uniform(4.0, 9.0))
        length, high = rng.uniform(5.0, 12.0), rng.uniform(0.5, 1.2)
        end = start + length * np.array([np.cos(yaw), np.sin(yaw)])
        line = start + np.linspace(0.0, 1.0, 9)[:, None] * (end - start)
        if paths.distance_to_loop(line, path).min() < 3.0 or _from_pavilion(line, taken) < 1.5:
            continue
        level = float(ground.height_at(line).mean())
        if rng.random() < 0.45:
            solid.wall(start, end, (level - 1.5, level + high), 0.35)
            solid.wall(start, end, (level + high - 0.01, level + high + 0.07), 0.45)
        else:
            for a, b in zip(line[:-1:2], line[2::2], strict=True):  # steps down a slope with the ground
                green.place(outdoor.hedge(rng, 0.25 * length, high, 0.7), upright(ground, 0.5 * (a + b), yaw))
    for at in rng.integers(0, len(path), 14):
        where, yaw = paths.beside_loop(path, int(at), rng.choice([-1.0, 1.0]) * rng.uniform(4.0, 16.0))
        if _from_pavilion(where, taken) > 1.5:
            green.place(outdoor.bush(rng, rng.uniform(0.6, 1.3), 24), upright(ground, where, yaw))


def _strollers(rng: np.random.Generator, path: FloatArray, ground: HeightField) -> tuple[Mover, ...]:
    """People who walk or run round the meadow next to the path, never on it."""
    movers = []
    for _ in range(int(rng.integers(2, 5))):
        radius, phase = rng.uniform(4.0, 8.0), rng.uniform(0.0, 2.0 * np.pi)
        angle = np.linspace(0.0, 2.0 * np.pi, 73)[:-1] * rng.choice([-1.0, 1.0]) + phase
        ellipse = radius * np.stack([np.cos(angle), 0.7 * np.sin(angle)], axis=1)
        circle = path.mean(axis=0) + rng.normal(0.0, 4.0, 2) + ellipse
        if paths.distance_to_loop(circle, path).min() > _FREE_SIDE_M + 1.0:
            body = outdoor.pedestrian(rng).boxes
            movers.append(Mover(body, paths.on_ground(circle, ground), rng.uniform(1.0, 2.8), 0.0))
    return tuple(movers)
