"""Finding the way back: a scan that fits nowhere near its prediction is tried all around."""

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, transform_points
from mapping.deskew import move
from mapping.surfels.surfel_map import LocalMap
from mapping.tracking.fit import constrained

# Points of the scan that each start is judged by, and how many starts are worth refining.
_SCORED_POINTS = 600
_BEST = 3
_COARSEST = 2
# Distance, in finest cells, at which a point counts half.
_HALF_CELLS = 2.0
# Part of all that is felt, added in every direction, so that one which nothing constrains does not decide by noise.
_LITTLE = 0.005


def start_poses(T_world_lidar: FloatArray, up: FloatArray, yaw_step_deg: float) -> FloatArray:
    """Poses (K, 4, 4) at one place, turned in even steps around `up` (3,), the vertical of the world.

    The given one comes first, then those turned by little."""
    count = max(1, round(360.0 / yaw_step_deg))
    steps = np.arange(count)
    signed = np.where(steps % 2 == 1, (steps + 1) // 2, -(steps // 2))
    turns = np.zeros((count, 6))
    turns[:, :3] = np.deg2rad(360.0 / count) * signed[:, None] * up
    turned: FloatArray = np.tile(T_world_lidar, (count, 1, 1))
    turned[:, :3, :3] = exp(turns)[:, :3, :3] @ T_world_lidar[:3, :3]
    return turned


def best_starts(points: FloatArray, starts: FloatArray, local_map: LocalMap) -> FloatArray:
    """The few of the poses (K, 4, 4) at which compensated points (N, 3) of the LiDAR frame lie nearest to the map."""
    few = points[:: max(1, len(points) // _SCORED_POINTS)]
    scores = [_score(few, start, local_map) for start in starts]
    return np.asarray(starts[np.argsort(scores)[::-1][:_BEST]], dtype=np.float64)


def positions_around(T_world_lidar: FloatArray, up: FloatArray, radius_m: float, step_m: float) -> FloatArray:
    """Poses (K, 4, 4) turned alike, at the points of a grid on a disc perpendicular to `up` (3,)."""
    count = int(radius_m / step_m)
    i, j = (part.ravel() * step_m for part in np.mgrid[-count : count + 1, -count : count + 1])
    inside = i**2 + j**2 <= radius_m**2
    across = np.linalg.svd(up[None])[2][1:]
    moved: FloatArray = np.tile(T_world_lidar, (int(inside.sum()), 1, 1))
    moved[:, :3, 3] += i[inside, None] * across[0] + j[inside, None] * across[1]
    return moved


def best_supported(points: FloatArray, starts: FloatArray, local_map: LocalMap) -> FloatArray:
    """The few of the poses (K, 4, 4), near one another, at which compensated points (N, 3) of the LiDAR frame are best
    supported in all directions of translation.

    Each direction counts alike, however few points constrain it: `tr(A^-1 B)` with A the mean over the poses of the
    sums of `n n^T` over the matched points, and B that with inlier weights.
    """
    few = points[:: max(1, len(points) // _SCORED_POINTS)]
    felt, held = zip(*(_felt_and_held(few, start, local_map) for start in starts), strict=True)
    mean = np.mean(felt, axis=0)
    scale = np.linalg.inv(mean + _LITTLE * max(float(np.trace(mean)), 1e-9) * np.eye(3))
    scores = np.einsum("ij,kji->k", scale, np.array(held))
    return np.asarray(starts[np.argsort(scores)[::-1][:_BEST]], dtype=np.float64)


def _felt_and_held(points: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap) -> tuple[FloatArray, FloatArray]:
    """Sums (3, 3) of `n n^T` over the matched points, without and with inlier weights."""
    world = transform_points(T_world_lidar, points)
    matches = local_map.match_planes(world, T_world_lidar, first_level=_COARSEST)
    distances = matches.residuals(world.take(matches.index, axis=0))
    felt, held, _ = constrained(matches.normals, distances / (_HALF_CELLS * local_map.cell_m))
    return felt, held


def best_velocity(
    points: FloatArray, times: FloatArray, velocities: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap
) -> FloatArray:
    """Of velocities (K, 6) the one with which points (N, 3), measured at times (N,), lie nearest to the map."""
    step = max(1, len(points) // _SCORED_POINTS)
    few, when = points[::step], times[::step]
    scores = [_score(move(few, when, velocity), T_world_lidar, local_map) for velocity in velocities]
    return np.asarray(velocities[int(np.argmax(scores))], dtype=np.float64)


def _score(points: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap) -> float:
    world = transform_points(T_world_lidar, points)
    matches = local_map.match_planes(world, T_world_lidar, first_level=_COARSEST)
    distances = matches.residuals(world.take(matches.index, axis=0))
    return float((1.0 / (1.0 + (distances / (_HALF_CELLS * local_map.cell_m)) ** 2)).sum())
