"""A town: streets that meet at odd angles, and a drive that takes every street in both directions.

Houses, cars and all else are placed beside the drive. They keep their distance from all of it, also where it crosses
itself or returns.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Mover, Route, World
from lidarslam.simulation.worlds import outdoor, paths, street
from lidarslam.simulation.worlds.building import heading, left_of, smooth_noise
from lidarslam.simulation.worlds.outdoor import Grounds, on_slope, upright

# Crossings, before some streets are left out: rows and columns, their distance, and the largest displacement of each.
_ROWS = 6
_SPACING_M = (95.0, 115.0)
_SHIFT_M = 16.0
_LEFT_OUT = 10
# Turns that are drawn again before a network is taken to have no drive.
_MOST_DRAWS = 10_000
_SPEED_LIMIT_MPS = 14.0  # 50 km/h
# The share of houses with ornaments, and of kerbs with cars and trees.
_FULLNESS = 0.4


_STEP_M = 0.5
# The road continues straight for this long before the drive and after it.
_BEYOND_M = 12.0
# Directions are averaged over this length: a row of houses has no bends as tight as the drive's.
_SMOOTH_M = 3.0
HALF_WIDTH_M = 5.0
FREE_SIDE_M = 2.5
_FRONT_M = HALF_WIDTH_M + 3.8
_CAR_M = (5.4, 2.0)
_MARGIN_M = 45.0
# Above this the ground's grid becomes wider, so that a drive of kilometres takes no more memory than this.
_MOST_GROUND_POINTS = 600_000


def town(seed: int) -> World:
    """Some 6 km of streets; a lap of some 11 km takes each in both directions.

    Within `FREE_SIDE_M` of the drive, at any height, there is only the road.
    """
    nodes, tour = draw_drive(np.random.default_rng(seed))
    lane = street.lane_of(nodes[tour], 1.0)
    rng = np.random.default_rng(seed)  # what stands there does not depend on how long a tour was looked for
    course = Course.along(np.concatenate([lane, lane[:1]]))
    low = np.floor(course.points.min(axis=0) - _MARGIN_M)
    high = course.points.max(axis=0) + _MARGIN_M
    cell = max(street.RISE_M, float(np.sqrt((high - low).prod() / _MOST_GROUND_POINTS)))
    distance = np.asarray(course.tree.query(paths.grid_nodes(low, high, cell))[0])
    hills = rng.uniform(0.6, 1.1) * smooth_noise(rng, distance.shape, 40.0 / cell)
    ground = HeightField(low, cell, street.pave(rng, hills, distance - HALF_WIDTH_M, cell, HALF_WIDTH_M))
    route = Route(paths.on_ground(lane, ground), 2.0, FREE_SIDE_M, 4.0, _SPEED_LIMIT_MPS)
    taken = np.zeros(np.ceil(np.multiply(ground.heights.shape, ground.cell_m)).astype(int), dtype=bool)
    rows = _Rows(Grounds(rng, course.points, ground), course, taken)
    for place in (rows.houses, rows.cars_and_pavement):  # houses first, which need most room
        for side in course.sides():
            place(side)
    solid = rows.grounds.solid
    there = paths.on_ground(course.points[:: round(2.0 / _STEP_M)], ground)
    rows.grounds.prune(
        replace(route, waypoints=np.concatenate([there, there[-2:0:-1]]), free_height_m=1e3), margin_m=0.02
    )
    street.lay_kerbs(solid, rows.kerb_stones(), ground)
    return World("town", seed, route, *solid.solids, (ground,), tuple(rows.people()), map_spacing_m=0.1)


def draw_drive(rng: np.random.Generator) -> tuple[FloatArray, list[int]]:
    """Crossings (N, 2), and those of a closed drive, once through every street in either direction, without a U-turn.

    A network in two parts, or with a ring of streets at the end of another one, has no such drive: another is drawn.
    """
    while True:
        nodes, streets = draw_network(rng)
        tour = draw_tour(rng, len(nodes), streets)
        if len(tour) == 2 * len(streets):
            return nodes, tour


def draw_network(rng: np.random.Generator) -> tuple[FloatArray, list[tuple[int, int]]]:
    """Crossings (N, 2), and the streets between them; no crossing is a dead end."""
    grid = np.arange(_ROWS * _ROWS).reshape(_ROWS, _ROWS)
    nodes = rng.uniform(*_SPACING_M) * np.stack(np.divmod(grid.ravel(), _ROWS), axis=1)
    nodes = nodes + rng.uniform(-_SHIFT_M, _SHIFT_M, nodes.shape)
    ways = ((grid[:-1], grid[1:]), (grid[:, :-1], grid[:, 1:]))
    pairs = [pair for a, b in ways for pair in zip(a.ravel().tolist(), b.ravel().tolist(), strict=True)]
    streets = pairs
    for left_out in rng.permutation(len(pairs)).tolist():
        fewer = [pair for pair in streets if pair != pairs[left_out]]
        if len(pairs) - len(streets) < _LEFT_OUT and np.bincount(np.ravel(fewer), minlength=len(nodes)).min() > 1:
            streets = fewer
    return nodes, streets


def draw_tour(rng: np.random.Generator, crossings: int, streets: list[tuple[int, int]]) -> list[int]:
    """The crossings along a closed drive without a U-turn: through every street in both directions, if it is found.

    Each street is left by another one, drawn for each crossing; drawn again at random places, and mostly kept where the
    round has become longer, these choices end as a single round.
    """
    around = [[b if a == node else a for a, b in streets if node in (a, b)] for node in range(crossings)]
    leaves = {node: _turns(rng, len(nodes)) for node, nodes in enumerate(around)}
    tour = _round(around, leaves, streets[0])
    for _ in range(_MOST_DRAWS):
        if len(tour) == 2 * len(streets):
            break
        node = int(rng.integers(crossings))
        tried = leaves | {node: _turns(rng, len(around[node]))}
        other = _round(around, tried, streets[0])
        if len(other) >= len(tour) or rng.random() <= 0.1:
            leaves, tour = tried, other
    return tour


def _turns(rng: np.random.Generator, count: int) -> NDArray[np.intp]:
    """(count,) the street by which to leave after arriving by each of `count`, never the same."""
    leave = rng.permutation(count)
    return leave if (leave != np.arange(count)).all() else _turns(rng, count)


def _round(around: list[list[int]], leaves: dict[int, NDArray[np.intp]], first: tuple[int, int]) -> list[int]:
    """The crossings from the first street until it is taken again."""
    tour, (start, end) = [first[0]], first
    while True:
        start, end = end, around[end][int(leaves[end][around[end].index(start)])]
        if (start, end) == first:
            return tour
        tour.append(start)


@dataclass(frozen=True, eq=False)
class Course:
    """An open path, as points half a metre apart."""

    points: FloatArray  # (N, 2)

    @classmethod
    def along(cls, path: FloatArray) -> "Course":
        """The course of a polyline (M, 2), extended at either end."""
        at = paths.lengths_along(path)
        points = paths.points_along(path, at, np.linspace(0.0, at[-1], max(4, int(np.ceil(at[-1] / _STEP_M)) + 1)))
        first, last = -left_of(cls(points).lefts[[0, -1]])
        ahead = _STEP_M * np.arange(1, int(_BEYOND_M / _STEP_M) + 1)[:, None]
        return cls(np.concatenate([points[0] - ahead[::-1] * first, points, points[-1] + ahead * last]))

    @property
    def length_m(self) -> float:
        """Its approximate length."""
        return _STEP_M * (len(self.points) - 1)

    @cached_property
    def lefts(self) -> FloatArray:
        """(N, 2) unit, to the left of the direction of travel."""
        smooth = gaussian_filter1d(self.points, _SMOOTH_M / _STEP_M, axis=0, mode="nearest")
        ahead = np.gradient(smooth, axis=0)
        return left_of(ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9))

    @cached_property
    def tree(self) -> "cKDTree[None]":
        """Of the points."""
        return cKDTree(self.points)

    def sides(self) -> Iterator["Course"]:
        """The course and its reverse: things placed along the left of each are on both sides."""
        yield self
        yield Course(self.points[::-1])

    def beside(self, at_m: FloatArray | float, left_m: float) -> FloatArray:
        """Places (..., 2) to the left of the course, at lengths (...) along it."""
        place = np.clip(np.asarray(at_m) / _STEP_M, 0, len(self.points) - 1).round().astype(int)
        return np.asarray(self.points[place] + left_m * self.lefts[place])

    def distance(self, xy: FloatArray) -> FloatArray:
        """Distance (M,) of points (M, 2) from the nearest part of the course."""
        nearest = self.tree.query(xy)[0]
        return np.asarray(np.sqrt(np.maximum(nearest**2 - (0.5 * _STEP_M) ** 2, 0.0)))  # nearer between two points


@dataclass(frozen=True)
class _Rows:
    """Places things next to a course, none on another, none near any part of the course."""

    grounds: Grounds
    course: Course
    taken: NDArray[np.bool_]  # (X, Y) cells of one metre of the ground

    def _claim(self, footprint: FloatArray, nearest_m: float) -> bool:
        """Take the cells of points (M, 2) if they are free and keep that distance from the course; whether they did."""
        x, y = np.floor(footprint - self.grounds.ground.origin_xy).astype(int).T
        # Most are refused by their first point, which saves the search for all.
        is_free = self.course.distance(footprint[:1])[0] >= nearest_m and not self.taken[x, y].any()
        is_free = is_free and self.course.distance(footprint).min() >= nearest_m
        self.taken[x, y] |= is_free
        return bool(is_free)

    def houses(self, side: Course) -> None:
        """Houses along the left of a course, or one time in eight a gap with a tree."""
        rng, ground, at = self.grounds.rng, self.grounds.ground, 0.0
        while at < side.length_m:
            wide, depth = rng.uniform(7.5, 15.0), rng.uniform(8.0, 11.0)
            for width, setback in product((wide, 6.5), (0.0, 1.5, 3.5)):
                start, end = side.beside(np.array([at, at + width]), _FRONT_M + setback)
                front = float(np.linalg.norm(end - start))
                if at + width > side.length_m or not 5.0 < front < 20.0:
                    continue
                along = (end - start) / front
                # Fronts are straight where the road bends, and may be a metre closer.
                if self._claim(_rectangle(start, along, front, depth), _FRONT_M - 1.0):
                    break
            else:
                at += 2.0
                continue
            at += width
            if rng.random() < 0.12:
                tree = outdoor.broadleaf(rng, rng.uniform(6.0, 9.0), 0.16, 24)
                where = start + 0.5 * (front - 0.02) * along + 4.0 * left_of(along)
                self.grounds.put(tree, where, 0.0, is_green=True)
                continue
            is_plain = bool(rng.random() > _FULLNESS)
            part = outdoor.house(rng, front - 0.02, depth, (not is_plain, not is_plain), is_plain=is_plain)
            self.grounds.solid.place(part, street.house_pose(ground, start, along, front - 0.02))

    def cars_and_pavement(self, side: Course) -> None:
        """Parked cars along the left of a course, and what stands on its pavement."""
        rng, ground, green = self.grounds.rng, self.grounds.ground, self.grounds.green
        taken = _FULLNESS * rng.uniform(0.45, 0.8)
        for at in np.arange(4.0, side.length_m - 4.0, 6.0):
            if rng.random() > taken:
                continue
            where = side.beside(at, HALF_WIDTH_M - 1.15 + rng.uniform(-0.08, 0.08))
            ahead = -left_of(side.lefts[min(round(at / _STEP_M), len(side.points) - 1)])
            footprint = _rectangle(where - 0.5 * (_CAR_M[0] * ahead + _CAR_M[1] * left_of(ahead)), ahead, *_CAR_M)
            # Not on the pavement behind a bend, nor where another part of the path has its lane.
            on_road = self.course.distance(footprint).max() <= HALF_WIDTH_M + 0.3
            if on_road and self._claim(footprint, FREE_SIDE_M + 0.2):
                yaw = heading(ahead) + np.pi * (rng.random() < 0.85)
                self.grounds.solid.place(outdoor.car(rng), on_slope(ground, where, yaw, 3.0, 1.6))
        for k, at in enumerate(np.arange(rng.uniform(1.0, 7.0), side.length_m, 8.0)):
            where = side.beside(at, HALF_WIDTH_M + 0.9)
            if self._claim(where[None], HALF_WIDTH_M + 0.7):
                pose = upright(ground, where, heading(where - side.beside(at, HALF_WIDTH_M + 1.9)))
                lamp_height = rng.uniform(5.0, 7.5) if k % 4 == 0 else 0.0
                street.furnish_pavement(green, green, rng, pose, lamp_height, bool(rng.random() < 0.45 * _FULLNESS))

    def kerb_stones(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Stones along the edges of the road, but not where another part of the path has its road."""
        middle = HALF_WIDTH_M + street.RISE_M - 0.5 * street.KERB_WIDTH_M
        laid: set[tuple[int, ...]] = set()
        for side in self.course.sides():
            for at in np.arange(0.0, side.length_m, street.STONE_M):
                start, end = side.beside(np.array([at, at + street.STONE_M]), middle)
                place = tuple(np.floor(0.5 * (start + end)).astype(int).tolist())
                off = self.course.distance(np.stack([start, end, 0.5 * (start + end)]))
                is_outside = (off > HALF_WIDTH_M + np.array([0.2, 0.2, -0.1])).all()
                if is_outside and np.linalg.norm(end - start) > 0.5 and place not in laid:
                    laid.add(place)
                    yield start, end

    def people(self) -> Iterator[Mover]:
        """Pedestrians who walk up and down the pavement."""
        rng = self.grounds.rng
        for side in self.course.sides():
            apart = max(40.0, side.length_m / 12.0)
            for start in np.arange(rng.uniform(5.0, 20.0), side.length_m - 40.0, apart):
                at = np.arange(start, start + rng.uniform(20.0, 35.0), 1.0)
                there = side.beside(at, HALF_WIDTH_M + rng.uniform(1.9, 2.4))
                if self._claim(there, HALF_WIDTH_M + 1.4):
                    waypoints = paths.on_ground(np.concatenate([there, there[-2:0:-1]]), self.grounds.ground)
                    yield Mover(outdoor.pedestrian(rng).boxes, waypoints, rng.uniform(0.9, 1.5), 0.0)


def _rectangle(origin: FloatArray, along: FloatArray, width: float, depth: float) -> FloatArray:
    """Points (M, 2) all over a rectangle, less than a cell apart, from its corner (2,) along (2,) and to its left."""
    x, y = (np.linspace(0.0, size, int(np.ceil(size / 0.7)) + 1) for size in (width, depth))
    return np.asarray((origin + x[:, None, None] * along + y[:, None] * left_of(along)).reshape(-1, 2))
