"""A mine in rough rock: a loop of changing width and height, side galleries, and things left in them."""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d, minimum_filter1d
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Route, World
from lidarslam.simulation.worlds.building import UP, Builder, heading, left_of, smooth_noise
from lidarslam.simulation.worlds.paths import grid_nodes, lengths_along, on_ground, points_along

_SPACING_M = 0.25
_STATION_M = 1.0
_STEEPEST = 0.08
_FREE_SIDE_M, _FREE_HEIGHT_M = 0.8, 2.05


def tunnel(seed: int) -> World:
    """The tunnel of that seed: ground and roof as height fields that meet in the walls, a loop of 150 to 300 m."""
    rng = np.random.default_rng(seed)
    galleries, pillars = draw_mine(rng)
    ground, roof = carve(galleries, pillars, rng)
    line, every = galleries[0].line, round(_STATION_M / _SPACING_M)
    floor = on_ground(line[::every, :2], ground)
    stations = _Stations(floor, _loop_lefts(line)[::every], galleries[0].half_widths[::every], ground, roof, rng)
    for fit, (fewest, most) in ((_lay_pipe, (3, 6)), (_hang_cable, (2, 4)), (_set_supports, (2, 5))):
        for _ in range(int(rng.integers(fewest, most))):
            fit(stations)
    for place in (_lay_rails, _hang_lamps, _drop_rocks, _leave_things):
        place(stations)
    route = Route(on_ground(line[:: round(1.5 / _SPACING_M), :2], ground), 0.4, _FREE_SIDE_M, _FREE_HEIGHT_M, 1.5)
    return World("tunnel", seed, route, *stations.builder.solids, (ground, roof))


class Gallery(NamedTuple):
    """A drift through the rock."""

    line: FloatArray  # (N, 3) middle of its floor, every `_SPACING_M`; the loop's last point is next to its first
    half_widths: FloatArray  # (N,) from the middle to the wall
    heights: FloatArray  # (N,) of the roof above the floor, in the middle


def draw_mine(rng: np.random.Generator) -> tuple[list[Gallery], FloatArray]:
    """Galleries, the loop of 155 to 260 m first, and pillars (P, 3) of rock left standing: middle x, y and radius."""
    loop, pillars = _with_chambers(_draw_loop(rng), rng)
    galleries = [loop, _draw_cut(loop, rng)]
    for _ in range(60):
        if len(galleries) < 11:
            branch = _draw_branch(loop, rng, is_alcove=len(galleries) >= 6)
            galleries += [branch] if _keeps_apart(branch, galleries) else []
    return galleries, pillars


def _loop_lefts(line: FloatArray) -> FloatArray:
    """(N, 2) unit vectors to the left of a closed line (N, 3)."""
    left = left_of(np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0))
    return np.asarray(left / np.linalg.norm(left, axis=1, keepdims=True))


def _draw_loop(rng: np.random.Generator) -> Gallery:
    """A star-shaped loop of random waves, rising and falling gently."""
    angle = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
    radius = np.ones_like(angle)
    for k in range(2, 13):
        size = 0.24 / (k - 0.6) if k < 6 else 0.022
        radius += size * rng.uniform(0.4, 1.0) * np.cos(k * angle + rng.uniform(0.0, 2.0 * np.pi))
    xy = np.stack([rng.uniform(1.0, 1.5) * radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    closed = np.concatenate([xy, xy[:1]])
    along, length = lengths_along(closed), rng.uniform(155.0, 260.0)
    n = round(length / _SPACING_M)
    at = np.arange(n, dtype=np.float64) * (length / n)
    line = points_along(closed * (length / along[-1]), along * length / along[-1], at)

    def waves(most: int) -> FloatArray:
        """(N,) periodic random curve of unit deviation with up to `most` waves."""
        phase, orders = np.arange(n) * (2.0 * np.pi / n), range(1, most + 1)
        curve = sum((rng.normal() * np.cos(k * phase + rng.uniform(0.0, 2.0 * np.pi)) for k in orders), np.zeros(n))
        return np.asarray(curve / curve.std())

    z = waves(3)
    z *= rng.uniform(0.6, 1.0) * _STEEPEST / (float(np.abs(np.roll(z, -1) - z).max()) * n / length)
    widths, heights = 2.25 + 0.5 * np.tanh(waves(14)), 3.2 + 0.5 * np.tanh(waves(9))
    return Gallery(np.column_stack([line, z - z[0]]), widths, heights)


def _with_chambers(loop: Gallery, rng: np.random.Generator) -> tuple[Gallery, FloatArray]:
    """The loop with one to three places where it widens, and pillars that stand in them."""
    n, widths, heights = len(loop.line), loop.half_widths.copy(), loop.heights.copy()
    left, pillars = _loop_lefts(loop.line), []
    for k in rng.choice(8, size=int(rng.integers(1, 4)), replace=False):
        middle = int((k + 0.5) * n / 8)
        away = np.minimum(np.mod(np.arange(n) - middle, n), np.mod(middle - np.arange(n), n)) * _SPACING_M
        bump = np.exp(-((away / rng.uniform(3.0, 5.0)) ** 2))
        widths += rng.uniform(1.6, 2.6) * bump
        heights += rng.uniform(0.2, 0.7) * bump
        for side in (-1.0, 1.0):
            if rng.random() < 0.6:
                radius = rng.uniform(0.5, 0.8)
                xy = loop.line[middle, :2] + side * (radius + rng.uniform(1.9, 2.2)) * left[middle]
                pillars.append([*xy, radius])
    return Gallery(loop.line, widths, np.minimum(heights, 4.2)), np.array(pillars).reshape(-1, 3)


def _draw_cut(loop: Gallery, rng: np.random.Generator) -> Gallery:
    """A bowed gallery from one side of the loop to the other."""
    n = len(loop.line)
    start = int(rng.integers(n))
    a, b = loop.line[start], loop.line[(start + n // 2 + int(rng.integers(-n // 10, n // 10))) % n]
    bend = 0.5 * (a + b) + rng.uniform(-0.3, 0.3) * np.array([a[1] - b[1], b[0] - a[0], 0.0])
    t = np.linspace(0.0, 1.0, 400)[:, None]
    return _gallery((1 - t) ** 2 * a + 2 * t * (1 - t) * bend + t**2 * b, rng, (1.5, 2.1), (2.6, 3.3))


def _draw_branch(loop: Gallery, rng: np.random.Generator, is_alcove: bool) -> Gallery:
    """A dead end off the loop: a gallery of 8 to 16 m, or an alcove a few metres deep."""
    k, side = int(rng.integers(len(loop.line))), float(rng.choice([-1.0, 1.0]))
    yaw = heading(_loop_lefts(loop.line)[k] * side) + rng.uniform(-0.5, 0.5)
    at = np.arange(0.0, loop.half_widths[k] + rng.uniform(*((1.2, 2.4) if is_alcove else (8.0, 16.0))), _SPACING_M)
    yaws = yaw + rng.uniform(-0.05, 0.05) * at
    xy = loop.line[k, :2] + np.cumsum(np.stack([np.cos(yaws), np.sin(yaws)], axis=1), axis=0) * _SPACING_M
    z = loop.line[k, 2] + (0.0 if is_alcove else rng.uniform(-_STEEPEST, _STEEPEST)) * np.maximum(at - 2.0, 0.0)
    widths, heights = ((0.8, 1.3), (2.0, 2.6)) if is_alcove else ((1.4, 2.0), (2.4, 3.2))
    return _gallery(np.column_stack([xy, z]), rng, widths, heights)


def _gallery(
    line: FloatArray, rng: np.random.Generator, widths: tuple[float, float], heights: tuple[float, float]
) -> Gallery:
    """A gallery along a line of any spacing, its width and height varying between limits."""
    ends = lengths_along(line)
    at = np.arange(0.0, ends[-1], _SPACING_M)
    knots = np.linspace(0.0, ends[-1], max(2, int(ends[-1] / 4.0)))
    curves = (np.interp(at, knots, rng.uniform(*limits, len(knots))) for limits in (widths, heights))
    return Gallery(points_along(line, ends, at), *curves)


def _keeps_apart(branch: Gallery, others: list[Gallery]) -> bool:
    """Whether the branch, once it has left the loop, leaves rock between itself and all others."""
    outer = branch.line[int(0.5 * len(branch.line)) :]
    for k, other in enumerate(others):
        gaps = np.linalg.norm(outer[:, None, :2] - other.line[None, ::4, :2], axis=2)
        gaps -= other.half_widths[None, ::4] + branch.half_widths.max() + 1.2
        # The loop is near by where the branch begins.
        near = gaps[-1:] if k == 0 else gaps
        if near.min() < (-1.5 if k == 0 and len(branch.line) < 24 else 0.0):
            return False
    return True


_CELL_M = 0.2
_BORDER_M = 8.0
# Walls lean: steeper than this and the grid would show as teeth.
_WALL_SLOPE = 3.2
# Half the width that is left open along the loop for any roughness, and the headroom over half of it.
_CORE_M, _HEADROOM_M = 1.75, 2.35
_BEND_M = 0.12
# Further than this from a gallery, its rock is solid whatever its width and roughness.
_REACH_M = 10.0


def carve(galleries: list[Gallery], pillars: FloatArray, rng: np.random.Generator) -> tuple[HeightField, HeightField]:
    """Ground and roof of the galleries; rock is below the ground, above the roof, and where they have crossed."""
    lines = np.concatenate([gallery.line for gallery in galleries])
    low = lines[:, :2].min(axis=0) - _BORDER_M
    nodes = grid_nodes(low, lines[:, :2].max(axis=0) + _BORDER_M, _CELL_M)
    shape = nodes.shape[:2]
    depth, floor, height, to_loop = _blend(galleries, nodes)
    warp = np.zeros(shape)
    for size, scale in ((0.24, 9.0), (0.13, 3.5), (0.06, 1.3)):
        warp += size * smooth_noise(rng, shape, scale)
    depth = np.maximum(np.clip(depth + warp, -3.0, None), _CORE_M - to_loop)
    for x, y, radius in pillars:
        depth = np.minimum(depth, np.hypot(nodes[..., 0] - x, nodes[..., 1] - y) - radius + 0.5 * warp)
    # Trodden flat along the path, rubble towards the walls.
    trodden = np.clip((to_loop - 0.9) / 0.8, 0.15, 1.0)
    rubble = np.exp(-np.clip(depth, 0.0, None) / 0.6)
    fine, coarse = smooth_noise(rng, shape, 1.5), smooth_noise(rng, shape, 7.0)
    rough = trodden * (0.05 * coarse + 0.03 * fine + 0.12 * rubble * np.abs(fine))
    ground = floor + rough + _rise(0.5 - depth)
    bumps = 0.12 * smooth_noise(rng, shape, 6.0) + 0.08 * smooth_noise(rng, shape, 2.2)
    arch = 0.3 * height * np.clip(1.0 - depth / 1.9, 0.0, 1.0) ** 2
    roof = floor + height + bumps - arch - _rise(0.35 - depth)
    headroom = floor + _HEADROOM_M - _WALL_SLOPE * np.maximum(to_loop - 1.05, 0.0)
    return HeightField(low, _CELL_M, ground), HeightField(low, _CELL_M, np.maximum(roof, headroom))


def _blend(galleries: list[Gallery], nodes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """For nodes (X, Y, 2): depth inside the galleries, floor, height, and distance from the loop's line, each (X, Y).

    Where galleries meet, each counts by how deep inside of it a node is.
    """
    parts = []
    for gallery in galleries:
        distance, nearest = cKDTree(gallery.line[:, :2]).query(nodes, distance_upper_bound=_REACH_M)
        distance, nearest = np.minimum(distance, _REACH_M), np.minimum(nearest, len(gallery.line) - 1)
        depth = gallery.half_widths[nearest] - distance
        parts.append((distance, depth, gallery.line[nearest, 2], gallery.heights[nearest]))
    distances, depths, floors, heights = (np.stack(part) for part in zip(*parts, strict=True))
    to_loop, deepest = distances[0], depths.max(axis=0)
    weights = np.exp((depths - deepest) / 0.5)
    weights /= weights.sum(axis=0)
    # On the loop the floor is the loop's own, so that the path has no steps at junctions.
    share = np.exp(-((to_loop / 1.5) ** 4))
    floor = share * floors[0] + (1.0 - share) * (weights * floors).sum(axis=0)
    return deepest, gaussian_filter(floor, 2.0), gaussian_filter((weights * heights).sum(axis=0), 3.0), to_loop


def _rise(x: FloatArray) -> FloatArray:
    """0 for x well below 0, a slope of `_WALL_SLOPE` above, with a short bend between."""
    return np.asarray(_WALL_SLOPE * _BEND_M * np.logaddexp(0.0, x / _BEND_M))


@dataclass(frozen=True, eq=False)
class _Stations:
    """Places along the loop, `_STATION_M` apart, numbered round and round, where things are fitted to the rock."""

    floor: FloatArray  # (N, 3) on the ground in the middle
    left: FloatArray  # (N, 2) unit vectors to the left
    half_widths: FloatArray  # (N,) as planned
    ground: HeightField
    roof: HeightField
    rng: np.random.Generator
    builder: Builder = field(default_factory=Builder)

    def __len__(self) -> int:
        return len(self.floor)

    def at(self, k: int, aside: float, up: float) -> FloatArray:
        """A point (3,) that far to the left of station k and above its floor."""
        k %= len(self)
        return np.append(self.floor[k, :2] + aside * self.left[k], self.floor[k, 2] + up)

    def on_ground(self, k: int, aside: float) -> FloatArray:
        """A point (3,) on the ground that far to the left of station k."""
        return np.asarray(on_ground(self.at(k, aside, 0.0)[None, :2], self.ground)[0])

    def is_beside(self, point: FloatArray, reach: float) -> bool:
        """Whether a thing that reaches that far around a point (3,) is outside the free space along the path."""
        nearest = float(np.linalg.norm(self.floor[:, :2] - point[:2], axis=1).min())
        # Between two stations the path is up to this much closer.
        return nearest > float(np.hypot(_FREE_SIDE_M + reach + 0.05, 0.5 * _STATION_M))

    def wall(self, side: float, up: float) -> FloatArray:
        """(N,) level distance to the rock on one side (+1 left, -1 right), at a height above the floor, at most 6 m."""
        steps = np.arange(0.0, 6.0, 0.05)
        points = np.repeat((self.floor + up * UP)[:, None], len(steps), axis=1)
        points[:, :, :2] += steps[:, None] * (side * self.left)[:, None]
        xy, z = points[..., :2].reshape(-1, 2), points[..., 2].ravel()
        solid = ((z < self.ground.height_at(xy)) | (z > self.roof.height_at(xy))).reshape(len(self), len(steps))
        return np.asarray(np.where(solid.any(axis=1), steps[solid.argmax(axis=1)], 6.0))

    def walls(self, up: float) -> dict[float, FloatArray]:
        """The distances to the walls of both sides."""
        return {side: self.wall(side, up) for side in (-1.0, 1.0)}

    def side(self) -> float:
        """One of the sides, drawn."""
        return float(self.rng.choice([-1.0, 1.0]))

    def stretch(self, shortest: float, longest: float) -> range:
        """Consecutive stations, drawn; the limits are shares of the loop."""
        start, length = int(self.rng.integers(len(self))), int(len(self) * self.rng.uniform(shortest, longest))
        return range(start, start + length)


def _lay_pipe(stations: _Stations) -> None:
    """A pipe that follows one wall at some height, with flanges and brackets; it ends where the wall does."""
    rng, builder = stations.rng, stations.builder
    side, up, radius = stations.side(), rng.uniform(0.5, 2.0), rng.uniform(0.04, 0.13)
    wall = stations.wall(side, up)
    aside = gaussian_filter1d(minimum_filter1d(wall, 5, mode="wrap"), 1.0, mode="wrap") - radius - 0.06
    aside = np.minimum(aside, wall - radius - 0.03)
    there = (aside > _FREE_SIDE_M + radius + 0.15) & (wall < stations.half_widths + 0.9)
    goes_on = there & np.roll(there, -1) & (np.abs(np.roll(aside, -1) - aside) < 0.6)
    stretch = stations.stretch(0.25, 0.7)
    for k in stretch:
        a, b = k % len(stations), (k + 1) % len(stations)
        if not goes_on[a]:
            continue
        start, end = (stations.at(j, side * aside[j], up) for j in (a, b))
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


def _hang_cable(stations: _Stations) -> None:
    """A cable from hook to hook under the roof, sagging between them."""
    side, share = stations.side(), stations.rng.uniform(0.5, 0.8)
    aside = side * np.minimum(share * stations.wall(side, 1.8), stations.half_widths)
    for k in stations.stretch(0.3, 0.9)[::3]:
        a, b = k % len(stations), (k + 3) % len(stations)
        ends = on_ground(np.stack([stations.at(j, aside[j], 0.0)[:2] for j in (a, b)]), stations.roof) - 0.06 * UP
        t, sag = np.linspace(0.0, 1.0, 4)[:, None], stations.rng.uniform(0.08, 0.2)
        points = ends[0] + t * (ends[1] - ends[0]) - 4.0 * sag * t * (1 - t) * UP
        over_way = points[:, 2].min() - max(stations.floor[a, 2], stations.floor[b, 2])
        if abs(aside[a] - aside[b]) <= 1.0 and over_way >= _FREE_HEIGHT_M + 0.15:
            for p, q in pairwise(points):
                stations.builder.cylinder(p, q, 0.025)


def _set_supports(stations: _Stations) -> None:
    """Frames of two props and a cap, of round timber or of steel, at even distances over a stretch."""
    rng, builder = stations.rng, stations.builder
    is_timber, every = rng.random() < 0.55, int(rng.integers(2, 5))
    walls, thick = stations.walls(1.0), rng.uniform(0.16, 0.24)
    for k in stations.stretch(0.08, 0.22)[::every]:
        j = k % len(stations)
        left, right = walls[1.0][j], walls[-1.0][j]
        asides = (left - 0.5 * thick, -(right - 0.5 * thick))
        is_wide = max(left, right) > stations.half_widths[j] + 0.6
        if is_wide or min(asides[0], -asides[1]) < _FREE_SIDE_M + thick:
            continue
        across = np.array([stations.at(j, a, 0.0) for a in np.linspace(asides[1] + 0.3, asides[0] - 0.3, 9)])
        roof = float(stations.roof.height_at(across[:, :2]).min())
        top = max(roof - 0.03, stations.floor[j, 2] + _FREE_HEIGHT_M + thick + 0.2)
        feet = [stations.on_ground(j, a) - 0.45 * UP for a in asides]
        heads = [np.array([*stations.at(j, 0.9 * a, 0.0)[:2], top - thick]) for a in asides]
        lift = 0.5 * thick * UP
        if is_timber:
            cap = 0.15 * (heads[0] - heads[1]) / np.linalg.norm(heads[0] - heads[1])
            for start, end in (*zip(feet, heads, strict=True), (heads[1] - cap + lift, heads[0] + cap + lift)):
                builder.cylinder(start, end, 0.5 * thick)
        else:
            for foot, head in zip(feet, heads, strict=True):
                builder.beam(foot, head, 0.8 * thick, 0.8 * thick)
            builder.beam(heads[1] + lift, heads[0] + lift, 0.8 * thick, thick)


def _lay_rails(stations: _Stations) -> None:
    """A narrow-gauge track over part of the loop, low enough to drive along."""
    gauge = stations.rng.uniform(0.5, 0.65)
    for k in stations.stretch(0.2, 0.6):
        for side in (-0.5, 0.5):
            a, b = (stations.on_ground(j, side * gauge) + 0.05 * UP for j in (k, k + 1))
            stations.builder.beam(a, b, 0.05, 0.09)
        stations.builder.beam(stations.on_ground(k, 0.5), stations.on_ground(k, -0.5), 0.16, 0.07)


def _hang_lamps(stations: _Stations) -> None:
    walls = stations.walls(2.0)
    for k in range(0, len(stations), int(stations.rng.integers(6, 11))):
        side = stations.side()
        aside = walls[side][k] - 0.02
        if _FREE_SIDE_M + 0.3 < aside < stations.half_widths[k] + 0.5:
            lamp = stations.at(k, side * aside, 2.0)
            stations.builder.box(lamp, (0.14, 0.32, 0.16), yaw=heading(stations.left[k]))


def _drop_rocks(stations: _Stations) -> None:
    """Single rocks at the foot of the walls, and heaps of them."""
    rng, n, walls = stations.rng, len(stations), stations.walls(0.25)
    heaps = [int(rng.integers(n)) for _ in range(n // 14)]
    for k in [*rng.integers(0, n, size=int(1.1 * n)), *np.repeat(heaps, 12)]:
        side, size = stations.side(), rng.uniform(0.1, 0.3) * rng.uniform(0.7, 2.0)
        inner, outer = _FREE_SIDE_M + 0.95 * size + 0.15, walls[side][k] - 0.3 * size
        if inner >= outer:
            continue
        spot = stations.on_ground(int(k), side * max(inner, outer - abs(rng.normal(0.0, 0.35))))
        spot[:2] += rng.uniform(-0.3, 0.3) * np.array([stations.left[k, 1], -stations.left[k, 0]])
        if stations.is_beside(spot, 0.95 * size):
            turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            turn[:, 0] *= np.sign(np.linalg.det(turn))
            stations.builder.box(spot + 0.22 * size * UP, size * rng.uniform(0.5, 1.1, 3), R=turn)


def _leave_things(stations: _Stations) -> None:
    rng, builder, walls = stations.rng, stations.builder, stations.walls(0.5)
    for k in rng.permutation(len(stations))[: len(stations) // 4]:
        side, size = stations.side(), rng.uniform(0.5, 0.75)
        aside = walls[side][k] - 0.5 * size
        foot = stations.on_ground(int(k), side * aside)
        if aside - 0.75 * size < _FREE_SIDE_M + 0.12 or not stations.is_beside(foot, 0.7 * size):
            continue
        if rng.random() < 0.5:
            builder.cylinder(foot - 0.4 * UP, foot + 0.85 * UP, 0.29)
        else:
            builder.box(foot + 0.3 * size * UP, (size, 0.8 * size, 1.4 * size), yaw=rng.uniform(0.0, np.pi))
