"""Rough rock around galleries: a ground and a roof that meet in the walls, and stations along the loop between them."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField
from lidarslam.simulation.worlds.building import UP, smooth_noise
from lidarslam.simulation.worlds.paths import grid_nodes
from lidarslam.simulation.worlds.tunnel.plan import SPACING_M, Gallery, MinePlan, loop_lefts

_CELL_M = 0.2
_BORDER_M = 8.0
# Walls lean: steeper than this and the grid would show as teeth.
_WALL_SLOPE = 3.2
# Half the width that is left open along the loop whatever the roughness, and the headroom over half of it.
_CORE_M, _HEADROOM_M = 1.75, 2.35
_BEND_M = 0.12
# Further than this from a gallery, its rock is solid whatever its width and roughness.
_REACH_M = 10.0
_STATION_M = 1.0


@dataclass(frozen=True)
class Rock:
    """The two surfaces; solid below the ground, above the roof, and where they have crossed."""

    ground: HeightField
    roof: HeightField

    def is_solid(self, points: FloatArray) -> FloatArray:
        """(N,) bool for points (N, 3)."""
        xy = points[:, :2]
        return np.asarray((points[:, 2] < self.ground.height_at(xy)) | (points[:, 2] > self.roof.height_at(xy)))

    def reach(self, origins: FloatArray, directions: FloatArray, furthest: float = 6.0) -> FloatArray:
        """Level distance (N,) from points (N, 3) in air along (N, 2) unit vectors to the rock, at most `furthest`."""
        steps = np.arange(0.0, furthest, 0.05)
        points = np.repeat(origins[:, None], len(steps), axis=1)
        points[:, :, :2] += steps[:, None] * directions[:, None]
        solid = self.is_solid(points.reshape(-1, 3)).reshape(len(origins), len(steps))
        return np.asarray(np.where(solid.any(axis=1), steps[solid.argmax(axis=1)], furthest))


def carve(plan: MinePlan, rng: np.random.Generator) -> Rock:
    """The rock around the galleries, the ground first."""
    lines = np.concatenate([gallery.line for gallery in plan.galleries])
    low = lines[:, :2].min(axis=0) - _BORDER_M
    nodes = grid_nodes(low, lines[:, :2].max(axis=0) + _BORDER_M, _CELL_M)
    shape = nodes.shape[:2]
    depth, floor, height, to_loop = _blend(plan, nodes)
    warp = np.zeros(shape)
    for size, scale in ((0.24, 9.0), (0.13, 3.5), (0.06, 1.3)):
        warp += size * smooth_noise(rng, shape, scale)
    depth = np.maximum(np.clip(depth + warp, -3.0, None), _CORE_M - to_loop)
    for x, y, radius in plan.pillars:
        depth = np.minimum(depth, np.hypot(nodes[..., 0] - x, nodes[..., 1] - y) - radius + 0.5 * warp)
    ground = floor + _floor_roughness(depth, to_loop, rng) + _rise(0.5 - depth)
    bumps = 0.12 * smooth_noise(rng, shape, 6.0) + 0.08 * smooth_noise(rng, shape, 2.2)
    arch = 0.3 * height * np.clip(1.0 - depth / 1.9, 0.0, 1.0) ** 2
    roof = floor + height + bumps - arch - _rise(0.35 - depth)
    headroom = floor + _HEADROOM_M - _WALL_SLOPE * np.maximum(to_loop - 1.05, 0.0)
    return Rock(HeightField(low, _CELL_M, ground), HeightField(low, _CELL_M, np.maximum(roof, headroom)))


def _blend(plan: MinePlan, nodes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """For nodes (X, Y, 2): depth inside the galleries, floor, height, and distance from the loop's line, each (X, Y).

    Where galleries meet, each counts by how deep inside of it a node is.
    """
    parts = []
    for gallery in plan.galleries:
        distance, nearest = cKDTree(gallery.line[:, :2]).query(nodes, distance_upper_bound=_REACH_M)
        distance, nearest = np.minimum(distance, _REACH_M), np.minimum(nearest, len(gallery.line) - 1)
        depth = gallery.half_widths[nearest] - distance
        parts.append((distance, depth, gallery.line[nearest, 2], gallery.heights[nearest]))
    distances, depths, floors, heights = (np.stack(part) for part in zip(*parts, strict=True))
    to_loop, deepest = distances[0], depths.max(axis=0)
    weights = np.exp((depths - deepest) / 0.5)
    weights /= weights.sum(axis=0)
    floor, height = (weights * floors).sum(axis=0), (weights * heights).sum(axis=0)
    # On the loop the floor is the loop's own, so that the way does not jerk at junctions.
    share = np.exp(-((to_loop / 1.5) ** 4))
    floor = share * floors[0] + (1.0 - share) * floor
    return deepest, gaussian_filter(floor, 2.0), gaussian_filter(height, 3.0), to_loop


def _floor_roughness(depth: FloatArray, to_loop: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Trodden flat along the way, rubble towards the walls."""
    trodden = np.clip((to_loop - 0.9) / 0.8, 0.15, 1.0)
    rubble = np.exp(-np.clip(depth, 0.0, None) / 0.6)
    fine, coarse = smooth_noise(rng, depth.shape, 1.5), smooth_noise(rng, depth.shape, 7.0)
    return np.asarray(trodden * (0.05 * coarse + 0.03 * fine + 0.12 * rubble * np.abs(fine)))


def _rise(x: FloatArray) -> FloatArray:
    """0 for x well below 0, a slope of `_WALL_SLOPE` above, with a short bend between."""
    return np.asarray(_WALL_SLOPE * _BEND_M * np.logaddexp(0.0, x / _BEND_M))


@dataclass(frozen=True)
class Stations:
    """Places along the loop, `_STATION_M` apart."""

    floor: FloatArray  # (N, 3) on the ground in the middle
    left: FloatArray  # (N, 2) unit vectors to the left
    half_widths: FloatArray  # (N,) as planned
    rock: Rock  # around them
    free_side_m: float  # to be kept free of fittings, as is the height
    free_height_m: float

    def __len__(self) -> int:
        return len(self.floor)

    def at(self, k: int, aside: float, up: float) -> FloatArray:
        """A point (3,) that far to the left of station k (counted round and round) and above its floor."""
        k %= len(self)
        return np.append(self.floor[k, :2] + aside * self.left[k], self.floor[k, 2] + up)

    def on_ground(self, k: int, aside: float) -> FloatArray:
        """A point (3,) on the ground that far to the left of station k."""
        point = self.at(k, aside, 0.0)
        point[2] = float(self.rock.ground.height_at(point[None, :2])[0])
        return point

    def is_beside(self, point: FloatArray, reach: float) -> bool:
        """Whether what reaches that far around a point (3,) keeps out of the free space along the way."""
        nearest = float(np.linalg.norm(self.floor[:, :2] - point[:2], axis=1).min())
        # Between two stations the way is up to this much closer.
        return nearest > float(np.hypot(self.free_side_m + reach + 0.05, 0.5 * _STATION_M))

    def wall(self, side: float, up: float) -> FloatArray:
        """(N,) distance to the wall on one side (+1 left, -1 right), at a height above the floor."""
        return self.rock.reach(self.floor + up * UP, side * self.left)


def place_stations(loop: Gallery, rock: Rock, free_side_m: float, free_height_m: float) -> Stations:
    """Stations along the loop, on the carved ground."""
    every = round(_STATION_M / SPACING_M)
    line, left = loop.line[::every].copy(), loop_lefts(loop.line)[::every]
    line[:, 2] = rock.ground.height_at(line[:, :2])
    return Stations(line, left, loop.half_widths[::every], rock, free_side_m, free_height_m)
