"""Start poses and velocities of registration attempts, and the best few of them by the distances of some points."""

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, transform_points
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.local_map import LEVELS, LocalMap
from lidarslam.mapping.tracking.budget import Steps
from lidarslam.mapping.tracking.fit import translation_information

# Points that score a start, and starts that are registered.
SCORED_POINTS = 600
_BEST = 3
# Distance, in finest cells, at which a point has half the weight.
_HALF_CELLS = 2.0
# Ridge of the information as a share of its trace, so that a direction without constraints is not decided by noise.
_RIDGE = 0.005


def turned_poses(T_world_lidar: FloatArray, up: FloatArray, yaw_step_deg: float) -> FloatArray:
    """Poses (K, 4, 4) at one position, in even steps of yaw around the vertical `up` (3,), small angles first."""
    count = max(1, round(360.0 / yaw_step_deg))
    steps = np.arange(count)
    signed = np.where(steps % 2 == 1, (steps + 1) // 2, -(steps // 2))
    turns = np.zeros((count, 6))
    turns[:, :3] = np.deg2rad(360.0 / count) * signed[:, None] * up
    turned: FloatArray = np.tile(T_world_lidar, (count, 1, 1))
    turned[:, :3, :3] = exp(turns)[:, :3, :3] @ T_world_lidar[:3, :3]
    return turned


def best_starts(points: FloatArray, starts: FloatArray, local_map: LocalMap) -> Steps[FloatArray]:
    """The few of the poses (K, 4, 4) at which compensated points (N, 3) of the LiDAR frame are nearest to the map."""
    few = points[:: max(1, len(points) // SCORED_POINTS)]
    scores = []
    for start in starts:
        scores.append(start_score(few, start, local_map))
        yield
    return np.asarray(starts[np.argsort(scores)[::-1][:_BEST]], dtype=np.float64)


def positions_around(T_world_lidar: FloatArray, up: FloatArray, radius_m: float, step_m: float) -> FloatArray:
    """Poses (K, 4, 4) of one rotation, at the points of a grid on a disc perpendicular to `up` (3,)."""
    count = int(radius_m / step_m)
    i, j = (part.ravel() * step_m for part in np.mgrid[-count : count + 1, -count : count + 1])
    inside = i**2 + j**2 <= radius_m**2
    across = np.linalg.svd(up[None])[2][1:]
    moved: FloatArray = np.tile(T_world_lidar, (int(inside.sum()), 1, 1))
    moved[:, :3, 3] += i[inside, None] * across[0] + j[inside, None] * across[1]
    return moved


def best_supported(points: FloatArray, starts: FloatArray, local_map: LocalMap) -> Steps[FloatArray]:
    """The few of neighbouring poses (K, 4, 4) with the best directional support of some compensated points (N, 3).

    Directions of translation have equal weight, however few points constrain them: `tr(A^-1 B)` with A the mean over
    the poses of the sums of `n n^T` over the matched points, and B the sum with inlier weights.
    """
    # Rotations that are equal, as without an odometry, make every pose come twice.
    distinct, inverse = np.unique(starts.reshape(-1, 16), axis=0, return_inverse=True)
    sums = []
    for start in distinct.reshape(-1, 4, 4):
        sums.append(translation_information(*_distances(points, start, local_map))[:2])
        yield
    information, supported = (np.array(parts)[inverse.reshape(-1)] for parts in zip(*sums, strict=True))
    mean = np.mean(information, axis=0)
    scale = np.linalg.inv(mean + _RIDGE * max(float(np.trace(mean)), 1e-9) * np.eye(3))
    scores = np.einsum("ij,kji->k", scale, supported)
    return np.asarray(starts[np.argsort(scores)[::-1][:_BEST]], dtype=np.float64)


def best_velocity(sweep: Sweep, velocities: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap) -> FloatArray:
    """The one of the velocities (K, 6) whose compensated sweep is nearest to the map."""
    few = sweep.take(np.arange(0, len(sweep), max(1, len(sweep) // SCORED_POINTS)))
    scores = [start_score(few.compensated(velocity), T_world_lidar, local_map) for velocity in velocities]
    return np.asarray(velocities[int(np.argmax(scores))], dtype=np.float64)


def start_score(points: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap) -> float:
    """Sum of the inlier weights of compensated points (N, 3) of the LiDAR frame at a pose (4, 4)."""
    _, distances = _distances(points, T_world_lidar, local_map)
    return float((1.0 / (1.0 + distances**2)).sum())


def _distances(points: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap) -> tuple[FloatArray, FloatArray]:
    """Normals (M, 3) of the surfaces in the coarsest cells, and distances (M,) in half-weight units."""
    world = transform_points(T_world_lidar, points)
    matches = local_map.match(world, T_world_lidar, len(LEVELS) - 1)
    distances = matches.residuals(world.take(matches.index, axis=0))
    return matches.normals, distances / (_HALF_CELLS * local_map.cell_m)
