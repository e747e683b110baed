"""Recordings in which tracking is hard: faults of a sensor in the field, and places without features.

A sensor is covered, carried off, hemmed in by traffic, or scans are dropped; each fault takes a simulation and gives
the scans with the truth about them. Along an even tunnel or an open plain the surfaces do not constrain the position.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.motion import CHANNELS, Motion
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.world import Boxes, HeightField, Mover, Route, World
from lidarslam.simulation.worlds.building import Builder

Cover = Literal["empty", "near", "stray"]

_NEAR_M = 0.3
_STRAY_POINTS = 25
_STRAY_M = 20.0
# Ends of the even stretch on the x axis, of what is full of things before and behind it, and of the place.
_WIDE_M, _HIGH_M = 3.0, 4.5
_THICK_M = 0.5
_BEYOND_M = 60.0


@dataclass(frozen=True, eq=False)
class Faulty:
    """A recording with a fault in it."""

    scans: tuple[Scan, ...]  # N of them, stamps increasing
    truth: Trajectory  # T_world_lidar at their stamps
    concerned: NDArray[np.bool_]  # (N,) the scans that the fault shows in; none where it lies between two scans
    after: int  # the first scan for which all is well again


def covered(simulation: Simulation, start: int, stop: int, cover: Cover, seed: int = 0) -> Faulty:
    """Something lies over the sensor during scans `start` to `stop` - 1.

    It returns nothing, echoes from within 0.3 m all around, or a few stray points.
    """
    rng = np.random.default_rng(seed)
    scans = list(simulation.scans())
    for index in range(start, stop):
        scans[index] = _cover(scans[index], cover, rng)
    concerned = np.zeros(len(scans), dtype=np.bool_)
    concerned[start:stop] = True
    return Faulty(tuple(scans), simulation.ground_truth, concerned, stop)


def _cover(scan: Scan, cover: Cover, rng: np.random.Generator) -> Scan:
    if cover == "empty":
        return scan.select(np.empty(0, dtype=np.intp))
    if cover == "near":
        ranges = np.linalg.norm(scan.points, axis=1, keepdims=True)
        return replace(scan, points=scan.points / ranges * rng.uniform(0.6 * _NEAR_M, _NEAR_M, (len(scan), 1)))
    few = scan.select(np.sort(rng.choice(len(scan), _STRAY_POINTS, replace=False)))
    return replace(few, points=rng.uniform(-_STRAY_M, _STRAY_M, (_STRAY_POINTS, 3)))


# Longer than a sensor that was tracked is within reach of its motion.
CARRYING_S = 1.2


def carried_off(simulation: Simulation, at: int, goes_on_at: int, turned_deg: float = 0.0) -> Faulty:
    """Lifted after scan `at` - 1, and set down where the simulation is at scan `goes_on_at`, turned about its z axis.

    Carrying takes a while, in which nothing is recorded; the recording goes on from there with noise of its own.
    """
    T_lidar_turned = exp(np.array([0.0, 0.0, np.deg2rad(turned_deg), 0.0, 0.0, 0.0]))
    later = replace(simulation, T_body_lidar=simulation.T_body_lidar @ T_lidar_turned, seed=simulation.seed + 1)
    count = min(len(simulation) - at, len(simulation) - goes_on_at)
    stamps = simulation.stamps[: at + count] + CARRYING_S * (np.arange(at + count) >= at)
    there = [replace(later.scan(goes_on_at + k).scan, stamp=float(stamps[at + k])) for k in range(count)]
    poses = [simulation.ground_truth.T_world_lidar[:at], later.ground_truth.T_world_lidar[goes_on_at:][:count]]
    scans = (*simulation.scans(0, at), *there)
    concerned = np.zeros(len(scans), dtype=np.bool_)
    concerned[at] = True
    return Faulty(scans, Trajectory(stamps, np.concatenate(poses)), concerned, at)


def index_back(simulation: Simulation, index: int, distance_m: float) -> int:
    """The scan, of those before `index`, whose place is nearest to so far from that of the scan before `index`."""
    positions = simulation.ground_truth.positions
    away = np.linalg.norm(positions[:index] - positions[index - 1], axis=1)
    return int(np.abs(away - distance_m).argmin())


def dropped(simulation: Simulation, missing: Collection[int]) -> Faulty:
    """Some scans never came."""
    kept = [index for index in range(len(simulation)) if index not in missing]
    scans = tuple(simulation.scan(index).scan for index in kept)
    after = sum(index < min(missing) for index in kept)
    truth = Trajectory(simulation.stamps[kept], simulation.ground_truth.T_world_lidar[kept])
    return Faulty(scans, truth, np.zeros(len(kept), dtype=np.bool_), after)


def standing_still(position: FloatArray, yaw: float, sensor_height_m: float) -> Motion:
    """A body that stays at a place (3,) on the ground."""
    base = np.zeros((3, len(CHANNELS)))
    base[:, :3], base[:, 5] = position, yaw
    return Motion("still", np.array([0.0, 1.0, 2.0]), base, sensor_height_m, repeats=False)


def passing_by(
    place: FloatArray, yaw: float, size: FloatArray, beside_m: FloatArray, speed_mps: float, reach_m: float
) -> tuple[Mover, ...]:
    """Boxes that go up and down beside a place (3,) on the ground, along a heading.

    Args:
        place, yaw: where, and which way they go.
        size: (3,) length, width and height of each.
        beside_m: (K,) how far to the left of the place each goes.
        speed_mps: of each, some faster and some slower by up to a fifth.
        reach_m: how far ahead and behind they turn back.
    """
    body = Boxes(np.array([[0.0, 0.0, 0.5 * size[2] + 0.1]]), 0.5 * size[None], np.eye(3)[None])
    ahead, left = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    movers = []
    for number, beside in enumerate(beside_m):
        ends = place + beside * left + np.array([[-reach_m], [reach_m]]) * ahead
        speed = speed_mps * (0.8 + 0.4 * ((0.618 * number) % 1.0))
        movers.append(Mover(body, ends, speed, 4.0 * reach_m * ((0.382 * number) % 1.0)))
    return tuple(movers)


def even_tunnel(begin_m: float, end_m: float, length_m: float, seed: int = 0) -> World:
    """A straight tunnel along x, even from `begin_m` to `end_m`; before and behind that, niches and cabinets."""
    builder, middle, length = Builder(), 0.5 * length_m, length_m + 2.0 * _BEYOND_M
    for z in (-0.5 * _THICK_M, _HIGH_M + 0.5 * _THICK_M):
        builder.box((middle, 0.0, z), (length, 12.0, _THICK_M))
    for side in (-1.0, 1.0):
        builder.box((middle, side * (_WIDE_M + 0.5 * _THICK_M), 0.5 * _HIGH_M), (length, _THICK_M, 6.0))
    rng = np.random.default_rng([seed, 1])
    places = _places(rng, begin_m, end_m, length_m, 1.6)
    sides = rng.choice([-1.0, 1.0], len(places))
    halves = [rng.uniform(*limits, len(places)) for limits in ((0.1, 0.35), (0.2, 0.7), (0.6, 2.2))]
    for x, side, depth, width, tall in zip(places, sides, *halves, strict=True):
        builder.box((x, side * (_WIDE_M - depth), tall), (2.0 * width, 2.0 * depth, 2.0 * tall))
    return World("even-tunnel", seed, _route(length_m), builder.boxes)


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
    builder, trunks = Builder(), xy[~sheds]
    for trunk, radius in zip(trunks, rng.uniform(0.1, 0.4, len(trunks)), strict=True):
        builder.pole(trunk, (-0.5, 5.5), radius)
    for shed, half in zip(xy[sheds], rng.uniform([0.5, 0.5, 1.5], [2.0, 2.0, 3.0], (sheds.sum(), 3)), strict=True):
        builder.box((*shed, half[2] - 0.1), 2.0 * half)
    return World("open-plain", seed, _route(length_m), *builder.solids, (ground,), map_spacing_m=0.1)


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
