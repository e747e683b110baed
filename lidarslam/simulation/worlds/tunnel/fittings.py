"""Fittings of a tunnel: supports, pipes, cables, rails, lamps, and rocks that came down."""

from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from lidarslam.simulation.worlds.building import UP, Builder
from lidarslam.simulation.worlds.tunnel.rock import Stations


def fit_out(stations: Stations, builder: Builder, rng: np.random.Generator) -> None:
    """Everything, each over stretches of its own."""
    for _ in range(int(rng.integers(3, 6))):
        _lay_pipe(stations, builder, rng)
    for _ in range(int(rng.integers(2, 4))):
        _hang_cable(stations, builder, rng)
    for _ in range(int(rng.integers(2, 5))):
        _set_supports(stations, builder, rng)
    _lay_rails(stations, builder, rng)
    _hang_lamps(stations, builder, rng)
    _drop_rocks(stations, builder, rng)
    _leave_things(stations, builder, rng)


def _stretch(n: int, rng: np.random.Generator, shortest: float, longest: float) -> range:
    start, length = int(rng.integers(n)), int(n * rng.uniform(shortest, longest))
    return range(start, start + length)


def _lay_pipe(stations: Stations, builder: Builder, rng: np.random.Generator) -> None:
    """A pipe that follows one wall at some height, with flanges and brackets; it ends where the wall does."""
    side, up, radius = float(rng.choice([-1.0, 1.0])), rng.uniform(0.5, 2.0), rng.uniform(0.04, 0.13)
    wall = stations.wall(side, up)
    aside = gaussian_filter1d(minimum_filter1d(wall, 5, mode="wrap"), 1.0, mode="wrap") - radius - 0.06
    aside = np.minimum(aside, wall - radius - 0.03)
    there = (aside > stations.free_side_m + radius + 0.15) & (wall < stations.half_widths + 0.9)
    goes_on = there & np.roll(there, -1) & (np.abs(np.roll(aside, -1) - aside) < 0.6)
    stretch = _stretch(len(stations), rng, 0.25, 0.7)
    for k in stretch:
        a, b = k % len(stations), (k + 1) % len(stations)
        if not goes_on[a]:
            continue
        start, end = stations.at(a, side * aside[a], up), stations.at(b, side * aside[b], up)
        builder.cylinder(start, end, radius)
        # A pipe that ends turns into the rock.
        if k == stretch[0] or not goes_on[a - 1]:
            builder.cylinder(start, stations.at(a, side * (wall[a] + 0.3), up), radius)
        if k == stretch[-1] or not goes_on[b]:
            builder.cylinder(end, stations.at(b, side * (wall[b] + 0.3), up), radius)
        if k % 4 == 0:
            along = (end - start) / np.linalg.norm(end - start)
            builder.cylinder(start - 0.03 * along, start + 0.03 * along, 1.5 * radius)
            bracket = stations.at(a, side * (wall[a] + 0.1), up - 1.2 * radius)
            builder.beam(start - 1.2 * radius * UP, bracket, 0.05, 0.03)


def _hang_cable(stations: Stations, builder: Builder, rng: np.random.Generator) -> None:
    """A cable from hook to hook under the roof, sagging between them."""
    side, share = float(rng.choice([-1.0, 1.0])), rng.uniform(0.5, 0.8)
    aside = side * np.minimum(share * stations.wall(side, 1.8), stations.half_widths)
    for k in _stretch(len(stations), rng, 0.3, 0.9)[::3]:
        a, b = k % len(stations), (k + 3) % len(stations)
        ends = np.stack([stations.at(j, aside[j], 0.0) for j in (a, b)])
        ends[:, 2] = stations.rock.roof.height_at(ends[:, :2]) - 0.06
        t, sag = np.linspace(0.0, 1.0, 4)[:, None], rng.uniform(0.08, 0.2)
        points = ends[0] + t * (ends[1] - ends[0]) - 4.0 * sag * t * (1 - t) * UP
        over_way = points[:, 2].min() - max(stations.floor[a, 2], stations.floor[b, 2])
        if abs(aside[a] - aside[b]) > 1.0 or over_way < stations.free_height_m + 0.15:
            continue
        for p, q in pairwise(points):
            builder.cylinder(p, q, 0.025)


def _set_supports(stations: Stations, builder: Builder, rng: np.random.Generator) -> None:
    """Frames of two props and a cap, of round timber or of steel, at even distances over a stretch."""
    timber, every = rng.random() < 0.55, int(rng.integers(2, 5))
    left, right = stations.wall(1.0, 1.0), stations.wall(-1.0, 1.0)
    thick = rng.uniform(0.16, 0.24)
    for k in _stretch(len(stations), rng, 0.08, 0.22)[::every]:
        j = k % len(stations)
        asides = (left[j] - 0.5 * thick, -(right[j] - 0.5 * thick))
        is_wide = max(left[j], right[j]) > stations.half_widths[j] + 0.6
        if is_wide or min(asides[0], -asides[1]) < stations.free_side_m + thick:
            continue
        across = np.array([stations.at(j, a, 0.0) for a in np.linspace(asides[1] + 0.3, asides[0] - 0.3, 9)])
        roof = float(stations.rock.roof.height_at(across[:, :2]).min())
        top = max(roof - 0.03, stations.floor[j, 2] + stations.free_height_m + thick + 0.2)
        feet = [stations.on_ground(j, a) for a in asides]
        heads = [np.array([*stations.at(j, 0.9 * a, 0.0)[:2], top - thick]) for a in asides]
        lift = 0.5 * thick * UP
        if timber:
            for foot, head in zip(feet, heads, strict=True):
                builder.cylinder(foot - 0.45 * UP, head, 0.5 * thick)
            cap = 0.15 * (heads[0] - heads[1]) / np.linalg.norm(heads[0] - heads[1])
            builder.cylinder(heads[1] - cap + lift, heads[0] + cap + lift, 0.5 * thick)
        else:
            for foot, head in zip(feet, heads, strict=True):
                builder.beam(foot - 0.45 * UP, head, 0.8 * thick, 0.8 * thick)
            builder.beam(heads[1] + lift, heads[0] + lift, 0.8 * thick, thick)


def _lay_rails(stations: Stations, builder: Builder, rng: np.random.Generator) -> None:
    """A narrow-gauge track over part of the loop, low enough to drive along."""
    gauge = rng.uniform(0.5, 0.65)
    for k in _stretch(len(stations), rng, 0.2, 0.6):
        for side in (-0.5, 0.5):
            a, b = (stations.on_ground(j % len(stations), side * gauge) + 0.05 * UP for j in (k, k + 1))
            builder.beam(a, b, 0.05, 0.09)
        a, b = stations.on_ground(k % len(stations), 0.5), stations.on_ground(k % len(stations), -0.5)
        builder.beam(a, b, 0.16, 0.07)


def _hang_lamps(stations: Stations, builder: Builder, rng: np.random.Generator) -> None:
    """A lamp on the wall every so often."""
    walls = {side: stations.wall(side, 2.0) for side in (-1.0, 1.0)}
    for k in range(0, len(stations), int(rng.integers(6, 11))):
        side = float(rng.choice([-1.0, 1.0]))
        aside = walls[side][k] - 0.02
        if stations.free_side_m + 0.3 < aside < stations.half_widths[k] + 0.5:
            yaw = float(np.arctan2(stations.left[k, 1], stations.left[k, 0]))
            builder.box(stations.at(k, side * aside, 2.0), (0.14, 0.32, 0.16), yaw=yaw)


def _drop_rocks(stations: Stations, builder: Builder, rng: np.random.Generator) -> None:
    """Single rocks at the foot of the walls, and heaps of them."""
    walls = {side: stations.wall(side, 0.25) for side in (-1.0, 1.0)}
    heaps = [int(rng.integers(len(stations))) for _ in range(len(stations) // 14)]
    places = [*rng.integers(0, len(stations), size=int(1.1 * len(stations))), *np.repeat(heaps, 12)]
    for k in places:
        side, size = float(rng.choice([-1.0, 1.0])), rng.uniform(0.1, 0.3) * rng.uniform(0.7, 2.0)
        inner, outer = stations.free_side_m + 0.95 * size + 0.15, walls[side][k] - 0.3 * size
        if inner >= outer:
            continue
        aside = side * max(inner, outer - abs(rng.normal(0.0, 0.35)))
        spot = stations.on_ground(int(k), aside)
        spot[:2] += rng.uniform(-0.3, 0.3) * np.array([stations.left[k, 1], -stations.left[k, 0]])
        if not stations.is_beside(spot, 0.95 * size):
            continue
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn[:, 0] *= np.sign(np.linalg.det(turn))
        builder.box(spot + 0.22 * size * UP, size * rng.uniform(0.5, 1.1, 3), R=turn)


def _leave_things(stations: Stations, builder: Builder, rng: np.random.Generator) -> None:
    """Barrels, crates and planks where the tunnel is wide enough."""
    walls = {side: stations.wall(side, 0.5) for side in (-1.0, 1.0)}
    for k in rng.permutation(len(stations))[: len(stations) // 4]:
        side, size = float(rng.choice([-1.0, 1.0])), rng.uniform(0.5, 0.75)
        aside = walls[side][k] - 0.5 * size
        if aside - 0.75 * size < stations.free_side_m + 0.12:
            continue
        foot = stations.on_ground(int(k), side * aside)
        if not stations.is_beside(foot, 0.7 * size):
            continue
        if rng.random() < 0.5:
            builder.cylinder(foot - 0.4 * UP, foot + 0.85 * UP, 0.29)
        else:
            builder.box(foot + 0.3 * size * UP, (size, 0.8 * size, 1.4 * size), yaw=rng.uniform(0.0, np.pi))
