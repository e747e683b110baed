"""Places in which nothing tells how far one has come, between two that are full of things."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.world import Boxes, Cylinders, HeightField, Route, World

# Ends of the even stretch on the x axis, of what is full of things before and behind it, and of the place.
_WIDE_M, _HIGH_M = 3.0, 4.5
_THICK_M = 0.5
_BEYOND_M = 60.0


def even_tunnel(begin_m: float, end_m: float, length_m: float, seed: int = 0) -> World:
    """A straight tunnel along x, even from `begin_m` to `end_m`; before and behind that, niches and cabinets."""
    half = 0.5 * length_m + _BEYOND_M
    middle = 0.5 * length_m
    shell = [((middle, 0.0, -0.5 * _THICK_M), (half, 6.0, 0.5 * _THICK_M))]
    shell += [((middle, 0.0, _HIGH_M + 0.5 * _THICK_M), (half, 6.0, 0.5 * _THICK_M))]
    beside_m = _WIDE_M + 0.5 * _THICK_M
    shell += [((middle, y, 0.5 * _HIGH_M), (half, 0.5 * _THICK_M, 3.0)) for y in (-beside_m, beside_m)]
    centres, halves = (np.array(rows) for rows in zip(*shell, strict=True))
    rng = np.random.default_rng([seed, 1])
    places = _places(rng, begin_m, end_m, length_m, 1.6)
    side = rng.choice([-1.0, 1.0], len(places))
    depth, width, tall = (
        rng.uniform(0.1, 0.35, len(places)),
        rng.uniform(0.2, 0.7, len(places)),
        rng.uniform(0.6, 2.2, len(places)),
    )
    fittings = np.stack([places, side * (_WIDE_M - depth), tall], axis=-1)
    boxes = Boxes(
        np.concatenate([centres, fittings]),
        np.concatenate([halves, np.stack([width, depth, tall], axis=-1)]),
        np.tile(np.eye(3), (len(centres) + len(places), 1, 1)),
    )
    return World("even-tunnel", seed, _route(length_m), boxes)


def open_plain(begin_m: float, end_m: float, length_m: float, seed: int = 0) -> World:
    """Level ground without end; trunks and sheds stand before `begin_m` and behind `end_m` of the x axis."""
    side_m = 150.0
    cells = np.zeros((2 + int((length_m + 2 * side_m) / 10.0), 2 + int(2 * side_m / 10.0)))
    ground = HeightField(np.array([-side_m, -side_m]), 10.0, cells)
    rng = np.random.default_rng([seed, 2])
    places = _places(rng, begin_m, end_m, length_m, 0.7)
    beside = rng.choice([-1.0, 1.0], len(places)) * rng.uniform(4.0, 15.0, len(places))
    xy = np.stack([places, beside], axis=-1)
    sheds = np.arange(len(places)) % 4 == 0
    starts = np.column_stack([xy[~sheds], np.full((~sheds).sum(), -0.5)])
    trunks = Cylinders(starts, starts + np.array([0.0, 0.0, 6.0]), rng.uniform(0.1, 0.4, len(starts)))
    halves = rng.uniform([0.5, 0.5, 1.5], [2.0, 2.0, 3.0], (sheds.sum(), 3))
    boxes = Boxes(np.column_stack([xy[sheds], halves[:, 2] - 0.1]), halves, np.tile(np.eye(3), (len(halves), 1, 1)))
    return World("open-plain", seed, _route(length_m), boxes, trunks, (ground,), map_spacing_m=0.1)


def straight_drive(length_m: float, speed_mps: float, sensor_height_m: float) -> Trajectory:
    """Along the x axis, at first and in between at three quarters of the speed, so that no speed goes on for ever."""
    times = np.arange(0.0, 2.0 * length_m / speed_mps, 0.1)
    speed = speed_mps * (0.875 - 0.125 * np.cos(2.0 * np.pi * times / 8.0))
    speed *= np.clip(times / 4.0, 0.0, 1.0)
    along = np.concatenate([[0.0], np.cumsum(speed[:-1] * 0.1)])
    times = times[along <= length_m]
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = along[: len(times)], sensor_height_m
    return Trajectory(times, poses)


def _places(rng: np.random.Generator, begin_m: float, end_m: float, length_m: float, apart_m: float) -> FloatArray:
    """Where on the x axis things stand, unevenly."""
    spans = ((-_BEYOND_M, begin_m), (end_m, length_m + _BEYOND_M))
    return np.concatenate([rng.uniform(low, high, int((high - low) / apart_m)) for low, high in spans])


def _route(length_m: float) -> Route:
    return Route(np.array([[0.0, 0.0, 0.0], [length_m, 0.0, 0.0], [length_m, 1.0, 0.0]]), 1.0, 1.0, 3.0, 20.0)
