"""A town: a network of streets that meet at odd angles, and a drive that takes every street in both directions."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Route, World
from lidarslam.simulation.worlds.along import FREE_SIDE_M, build_along
from lidarslam.simulation.worlds.paths import on_ground
from lidarslam.simulation.worlds.street import lane_of

# Crossings, before some streets are left out: rows and columns, their distance, and the largest displacement of each.
_ROWS = 6
_SPACING_M = (95.0, 115.0)
_SHIFT_M = 16.0
_LEFT_OUT = 10
_SPEED_LIMIT_MPS = 14.0  # 50 km/h
# The share of houses with ornaments, and of kerbs with cars and trees.
_FULLNESS = 0.4


def build(seed: int) -> World:
    """Some 6 km of streets; a lap of some 11 km takes each in both directions."""
    rng = np.random.default_rng(seed)
    nodes, streets = draw_network(rng)
    lane = lane_of(nodes[draw_tour(rng, len(nodes), streets)], 1.0)
    built = build_along(np.concatenate([lane, lane[:1]]), seed, _FULLNESS)
    route = Route(on_ground(lane, built.height_fields[0]), 2.0, FREE_SIDE_M, 4.0, _SPEED_LIMIT_MPS)
    return replace(built, name="town", route=route)


def draw_network(rng: np.random.Generator) -> tuple[FloatArray, list[tuple[int, int]]]:
    """Crossings (N, 2), and the streets between them; no crossing is a dead end."""
    grid = np.arange(_ROWS * _ROWS).reshape(_ROWS, _ROWS)
    nodes = rng.uniform(*_SPACING_M) * np.stack(np.divmod(grid.ravel(), _ROWS), axis=1)
    nodes = nodes + rng.uniform(-_SHIFT_M, _SHIFT_M, nodes.shape)
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in
                            ((grid[:-1], grid[1:]), (grid[:, :-1], grid[:, 1:]))])  # fmt: skip
    streets = [(int(a), int(b)) for a, b in pairs]
    for left_out in rng.permutation(len(pairs)).tolist():
        fewer = [street for street in streets if street != tuple(pairs[left_out].tolist())]
        if len(pairs) - len(streets) < _LEFT_OUT and np.bincount(np.ravel(fewer), minlength=len(nodes)).min() > 1:
            streets = fewer
    return nodes, streets


def draw_tour(rng: np.random.Generator, crossings: int, streets: list[tuple[int, int]]) -> list[int]:
    """The crossings along a closed drive, once through every street in either direction, without a U-turn.

    Each street is left by another one, drawn for each crossing; drawn again at random places, and mostly kept where the
    round has become longer, these choices end as a single round.
    """
    around = [[b if a == node else a for a, b in streets if node in (a, b)] for node in range(crossings)]
    leaves = [_turns(rng, len(nodes)) for nodes in around]
    tour = _round(around, leaves, streets[0])
    while len(tour) < 2 * len(streets):
        node = int(rng.integers(crossings))
        before, leaves[node] = leaves[node], _turns(rng, len(around[node]))
        other = _round(around, leaves, streets[0])
        if len(other) < len(tour) and rng.random() > 0.1:
            leaves[node] = before
        else:
            tour = other
    return tour


def _turns(rng: np.random.Generator, count: int) -> NDArray[np.intp]:
    """(count,) the street by which to leave after arriving by each of `count`, never the same."""
    while True:
        leave = rng.permutation(count)
        if (leave != np.arange(count)).all():
            return leave


def _round(around: list[list[int]], leaves: list[NDArray[np.intp]], first: tuple[int, int]) -> list[int]:
    """The crossings from the first street until it is taken again."""
    tour, (start, end) = [first[0]], first
    while True:
        start, end = end, around[end][int(leaves[end][around[end].index(start)])]
        if (start, end) == first:
            return tour
        tour.append(start)
