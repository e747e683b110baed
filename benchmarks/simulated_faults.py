"""Recordings that are difficult to track: faults of a sensor in the field, and places without features.

A sensor is covered, carried away or surrounded by traffic, or scans are dropped; each fault takes a simulation and
returns the scans with ground truth. In an even tunnel or an open plain, surfaces do not constrain the position.
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
# Half width, height and thickness of the walls of the tunnel; extent of a place beyond the ends of the drive.
_WIDE_M, _HIGH_M = 3.0, 4.5
_THICK_M = 0.5
_BEYOND_M = 60.0


@dataclass(frozen=True, eq=False)
class Faulty:
    """A recording with a fault."""

    scans: tuple[Scan, ...]  # N, with increasing stamps
    truth: Trajectory  # T_world_lidar at their stamps
    concerned: NDArray[np.bool_]  # (N,) scans affected by the fault; none where it is between two scans
    after: int  # first scan after the fault


def covered(simulation: Simulation, start: int, stop: int, cover: Cover, seed: int = 0) -> Faulty:
    """The sensor is covered during scans `start` to `stop` - 1.

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


# Too long for a prediction from the motion.
CARRYING_S = 1.2


def carried_off(simulation: Simulation, at: int, resume_at: int, turned_deg: float = 0.0) -> Faulty:
    """Lifted after scan `at` - 1, and set down at the pose of scan `resume_at`, turned about the z axis.

    Nothing is recorded while the sensor is carried; the recording then continues with independent noise.
    """
    T_lidar_turned = exp(np.array([0.0, 0.0, np.deg2rad(turned_deg), 0.0, 0.0, 0.0]))
    later = replace(simulation, T_body_lidar=simulation.T_body_lidar @ T_lidar_turned, seed=simulation.seed + 1)
    count = min(len(simulation) - at, len(simulation) - resume_at)
    stamps = simulation.stamps[: at + count] + CARRYING_S * (np.arange(at + count) >= at)
    there = [replace(later.scan(resume_at + k).scan, stamp=float(stamps[at + k])) for k in range(count)]
    poses = [simulation.ground_truth.T_world_lidar[:at], later.ground_truth.T_world_lidar[resume_at:][:count]]
    scans = (*simulation.scans(0, at), *there)
    concerned = np.zeros(len(scans), dtype=np.bool_)
    concerned[at] = True
    return Faulty(scans, Trajectory(stamps, np.concatenate(poses)), concerned, at)


def index_back(simulation: Simulation, index: int, distance_m: float) -> int:
    """The scan before `index` whose distance from scan `index` - 1 is closest to `distance_m`."""
    positions = simulation.ground_truth.positions
    away = np.linalg.norm(positions[:index] - positions[index - 1], axis=1)
    return int(np.abs(away - distance_m).argmin())


def dropped(simulation: Simulation, missing: Collection[int]) -> Faulty:
    """Some scans are missing."""
    kept = [index for index in range(len(simulation)) if index not in missing]
    scans = tuple(simulation.scan(index).scan for index in kept)
    after = sum(index < min(missing) for index in kept)
    truth = Trajectory(simulation.stamps[kept], simulation.ground_truth.T_world_lidar[kept])
    return Faulty(scans, truth, np.zeros(len(kept), dtype=np.bool_), after)


def standing_still(position: FloatArray, yaw: float, sensor_height_m: float) -> Motion:
    """A body at rest at a place (3,) on the ground."""
    base = np.zeros((3, len(CHANNELS)))
    base[:, :3], base[:, 5] = position, yaw
    return Motion("still", np.array([0.0, 1.0, 2.0]), base, sensor_height_m, repeats=False)


def passing_by(
    place: FloatArray, yaw: float, size: FloatArray, beside_m: FloatArray, speed_mps: float, reach_m: float
) -> tuple[Mover, ...]:
    """Boxes that move back and forth beside a place (3,) on the ground, along a heading.

    Args:
        place, yaw: position and heading.
        size: (3,) length, width and height of each.
        beside_m: (K,) lateral offset of each, to the left of the place.
        speed_mps: of each, varied by up to a fifth.
        reach_m: distance ahead and behind at which they turn back.
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
    """A straight tunnel along x, even from `begin_m` to `end_m`, with niches and cabinets before and after."""
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
    """Unlimited level ground, with trunks and sheds before `begin_m` and after `end_m` on the x axis."""
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
    """Along the x axis, at a speed that varies between three quarters and all of `speed_mps`."""
    times = np.arange(0.0, 2.0 * length_m / speed_mps, 0.1)
    speed = speed_mps * (0.875 - 0.125 * np.cos(2.0 * np.pi * times / 8.0))
    speed *= np.clip(times / 4.0, 0.0, 1.0)
    along = np.concatenate([[0.0], np.cumsum(speed[:-1] * 0.1)])
    times = times[along <= length_m]
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = along[: len(times)], sensor_height_m
    return Trajectory(times, poses)


def _places(rng: np.random.Generator, begin_m: float, end_m: float, length_m: float, apart_m: float) -> FloatArray:
    """Unevenly spaced positions of objects on the x axis."""
    spans = ((-_BEYOND_M, begin_m), (end_m, length_m + _BEYOND_M))
    return np.concatenate([rng.uniform(low, high, int((high - low) / apart_m)) for low, high in spans])


def _route(length_m: float) -> Route:
    return Route(np.array([[0.0, 0.0, 0.0], [length_m, 0.0, 0.0], [length_m, 1.0, 0.0]]), 1.0, 1.0, 3.0, 20.0)
