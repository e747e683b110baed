"""A street along a given path, such as one that a car drove with a real LiDAR: as long as it takes, nothing in the way.

Everything keeps its distance from all of the path, so also from where it crosses itself, comes back or turns round.
"""

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Mover, Route, World
from lidarslam.simulation.worlds import furnishing
from lidarslam.simulation.worlds.building import Builder, smooth_noise
from lidarslam.simulation.worlds.paths import on_ground
from lidarslam.simulation.worlds.street.course import STEP_M, Course
from lidarslam.simulation.worlds.street.network import KERB_HEIGHT_M, KERB_WIDTH_M
from lidarslam.simulation.worlds.street.rows import FREE_SIDE_M, HALF_WIDTH_M, Rows

_MARGIN_M = 45.0
_CELL_M = 0.5
# Above this the ground's grid becomes wider, so that a path of kilometres takes no more memory than this.
_MOST_GROUND_POINTS = 600_000
_LONGEST_SIDE_M = 5_000.0
_STONE_M = 3.0
_MOST_PEOPLE = 24


def build_along(path: FloatArray, seed: int) -> World:
    """A street with the path in its middle; within `FREE_SIDE_M` of the path, at any height, there is only the road.

    The route goes along the path and back. Long streets have plainer houses and fewer things, so that the number of
    primitives grows slowly, and a wider grid for the ground.

    Args:
        path: (N, 2) polyline, or (N, 3) with the height of the ground; else the ground is gently hilly.
        seed: of everything that the path leaves open.

    Raises:
        InputError: the path is shorter than a metre, or extends over more than 5 km.
    """
    extent = np.ptp(path[:, :2], axis=0)
    length = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum()
    if length < 1.0 or extent.max() > _LONGEST_SIDE_M:
        raise InputError(
            f"a street is made along 1 m or more and within {_LONGEST_SIDE_M / 1e3:g} km; the path is {length:.1f} m"
            f" long within {extent.max():.1f} m"
        )
    rng = np.random.default_rng(seed)
    course = Course.along(path)
    ground = _ground(rng, course)
    solid = Builder()
    rows = Rows(rng, course, ground)
    rows.build(solid)
    _kerbs(solid, course, ground)
    there = course.points[:: round(2.0 / STEP_M), :2]
    route = Route(on_ground(np.concatenate([there, there[-2:0:-1]]), ground), 2.0, FREE_SIDE_M, 4.0, 11.0)
    return World(
        "street",
        seed,
        route,
        boxes=solid.boxes,
        cylinders=solid.cylinders,
        height_fields=(ground,),
        movers=tuple(_people(rng, rows, course, ground)),
        map_spacing_m=0.1,
    )


def _ground(rng: np.random.Generator, course: Course) -> HeightField:
    """A cambered road, pavements a kerb higher, and roughness on both."""
    low = np.floor(course.points[:, :2].min(axis=0) - _MARGIN_M)
    size = course.points[:, :2].max(axis=0) + _MARGIN_M - low
    cell = max(_CELL_M, float(np.sqrt(size.prod() / _MOST_GROUND_POINTS)))
    shape = tuple(np.ceil(size / cell).astype(int) + 1)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    found = course.tree.query((low + cell * grid).reshape(-1, 2))
    distance, nearest = np.asarray(found[0]).reshape(shape), np.asarray(found[1]).reshape(shape)
    if course.points.shape[1] == 3:
        from scipy.ndimage import gaussian_filter

        heights = gaussian_filter(course.points[nearest, 2], 6.0 / cell, mode="nearest")
    else:
        heights = rng.uniform(0.6, 1.1) * smooth_noise(rng, shape, 40.0 / cell)
    heights += 0.02 * smooth_noise(rng, shape, 3.0 / cell) + 0.005 * smooth_noise(rng, shape, 0.7)
    heights += KERB_HEIGHT_M * np.clip((distance - HALF_WIDTH_M) / cell, 0.0, 1.0)
    heights += 0.08 * (1.0 - (1.0 - np.clip(1.0 - distance / HALF_WIDTH_M, 0.0, 1.0)) ** 2)
    return HeightField(low, cell, heights)


def _kerbs(solid: Builder, course: Course, ground: HeightField) -> None:
    """Stones along the edges of the road, but not where another part of the path has its road."""
    middle = HALF_WIDTH_M + 0.5 * KERB_WIDTH_M
    laid: set[tuple[int, int]] = set()
    for side in course.sides():
        at = np.arange(0.0, side.length_m, _STONE_M)
        starts, ends = side.beside(at, middle), side.beside(at + _STONE_M, middle)
        lengths = np.linalg.norm(ends - starts, axis=1)
        inside = np.minimum(course.distance(starts), course.distance(ends)) < HALF_WIDTH_M - 0.1
        inside |= course.distance(0.5 * (starts + ends)) < HALF_WIDTH_M - 0.4
        levels = (
            ground.height_at(side.beside(at, middle + 0.8)),
            ground.height_at(side.beside(at + _STONE_M, middle + 0.8)),
        )
        for k in np.flatnonzero(~inside & (lengths > 0.5)):
            place = tuple(np.floor(0.5 * (starts[k] + ends[k])).astype(int).tolist())
            if place not in laid:
                laid.add(place)
                solid.beam(
                    np.append(starts[k], levels[0][k] - 0.14),
                    np.append(ends[k], levels[1][k] - 0.14),
                    KERB_WIDTH_M,
                    0.3,
                )


def _people(rng: np.random.Generator, rows: Rows, course: Course, ground: HeightField) -> list[Mover]:
    """Pedestrians who walk up and down the pavement."""
    movers: list[Mover] = []
    for side in course.sides():
        for start in np.arange(
            rng.uniform(5.0, 20.0), side.length_m - 40.0, max(40.0, 2.0 * side.length_m / _MOST_PEOPLE)
        ):
            there = side.beside(
                np.arange(start, start + rng.uniform(20.0, 35.0), 1.0), HALF_WIDTH_M + rng.uniform(1.9, 2.4)
            )
            if course.distance(there).min() > HALF_WIDTH_M + 1.4 and rows.land.is_free(there):
                waypoints = on_ground(np.concatenate([there, there[-2:0:-1]]), ground)
                movers.append(Mover(furnishing.pedestrian(rng).boxes, waypoints, rng.uniform(0.9, 1.5), 0.0))
    return movers
