"""Scan-to-map registration: the pose, and the velocity during the sweep, that lay a scan on the map.

Each point is pulled towards a plane of the map, each edge point towards a line. The pulls are linearised and solved
(Gauss-Newton on the manifold), the surfaces looked up again, until nothing moves: LOAM's scan matching (Zhang and
Singh, RSS 2014) with robust weights. A sweep is no snapshot, so the sensor's velocity during it is estimated together
with the pose at its stamp, as begin and end of a scan are in CT-ICP (Dellenbach et al., ICRA 2022).
"""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.degeneracy import Degeneracy
from lidarslam.core.geometry import FloatArray, displacement_m, exp, inverse, log, orthonormalize, transform_points
from mapping.config import RefinementConfig
from mapping.degeneracy import find_degeneracy
from mapping.deskew import move
from mapping.prediction import Prediction
from mapping.surfels.surfel_map import LEVELS, LocalMap, Matches

# Standard deviation of a range measurement: no surface is known better than that.
_RANGE_NOISE_M = 0.02
# The kernel's scale follows the residuals: this many times their median, within bounds in cells.
_SCALE_PER_MEDIAN = 1.5
_LEAST_SCALE = 0.03
# A step of less than this share of a cell makes the next finer cells the better ones.
_SETTLED = 0.1
# Farther from its surface than this, in cells, a point belongs to something else.
_GATE = 6.0
# How firmly the prior is kept along directions that the matches leave open: as if measured to a tenth of a millimetre.
_HELD = 1e8
# Neighbouring points err together, and count for as much less; compared with true errors on simulated recordings.
_CORRELATION = 25.0


@dataclass(frozen=True, eq=False)
class Sweep:
    """The points of a scan that are registered, as measured: each in the LiDAR frame of its own instant.

    Attributes:
        points: (N, 3).
        times: (N,) seconds from the stamp; None when the scan is motion compensated already.
    """

    points: FloatArray
    times: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Refined:
    """A registered scan.

    Attributes:
        T_world_lidar: (4, 4) at the stamp.
        velocity: (6,) during the sweep, in the LiDAR frame, rotation first.
        covariance: (12, 12) of pose and velocity. The pose's error is `xi` in `T_true = T_world_lidar @ exp(xi)`:
            rotation first, in the LiDAR frame, as GTSAM has it.
        degeneracy: the directions along which the prediction was kept.
        iterations: how many it took.
    """

    T_world_lidar: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    degeneracy: Degeneracy
    iterations: int


def refine(
    sweep: Sweep,
    prediction: Prediction,
    local_map: LocalMap,
    config: RefinementConfig,
    coarse_first: bool,
    with_velocity: bool,
) -> Refined | None:
    """Register a sweep to the map, from a prediction.

    Args:
        sweep: the points.
        prediction: where to start, and what is kept where the map does not tell.
        local_map: what is registered to.
        config: limits of the iteration.
        coarse_first: whether the prediction may be off by more than a cell.
        with_velocity: whether the velocity during the sweep is estimated too.

    Returns:
        None when too few points meet a surface.
    """
    T_world_lidar, velocity = prediction.T_world_lidar, prediction.velocity
    times = sweep.times if with_velocity else None
    schedule = _Schedule(config, local_map.cell_m, coarse_first)
    while True:
        points = compensated(sweep.points, sweep.times, velocity)
        world = transform_points(T_world_lidar, points)
        matches = local_map.match_planes(world, T_world_lidar, first_level=schedule.level)
        if len(matches) < config.min_matches:
            return None
        system = _Linearised.at(T_world_lidar, points, matches, schedule.cell_m)
        try:
            matched_times = None if times is None else times.take(matches.index)
            solution = _solve(system, matched_times, prediction, T_world_lidar, velocity)
        except np.linalg.LinAlgError:  # nothing holds the pose, not even the prediction
            return None
        T_world_lidar = T_world_lidar @ exp(solution.pose_step)
        velocity = velocity + solution.velocity_step
        if schedule.is_done_after(solution.pose_step, system.lever_m):
            break
    return Refined(
        orthonormalize(T_world_lidar), velocity, solution.covariance, solution.degeneracy, schedule.iterations
    )


def compensated(points: FloatArray, times: FloatArray | None, velocity: FloatArray) -> FloatArray:
    """Points (N, 3) as they would have been seen at the stamp."""
    return points if times is None or not len(points) else move(points, times, velocity)


class _Schedule:
    """Which cells the next step looks at: coarse ones until the pose is within the next finer ones' reach."""

    def __init__(self, config: RefinementConfig, finest_m: float, coarse_first: bool) -> None:
        self._config = config
        self._finest_m = finest_m
        self.level = len(LEVELS) - 1 if coarse_first and config.coarse_iterations else 0
        self._steps_at_level = 0
        self.iterations = 0

    @property
    def cell_m(self) -> float:
        """The cells' size at the present level."""
        return self._finest_m * LEVELS[self.level]

    def is_done_after(self, step: FloatArray, lever_m: float) -> bool:
        """Take note of a step (6,); whether it was the last."""
        self.iterations += 1
        self._steps_at_level += 1
        if self.level == 0:
            return self.iterations >= self._config.max_iterations or self._has_converged(step)
        has_settled = displacement_m(step, lever_m) < _SETTLED * self.cell_m
        if self._steps_at_level >= self._config.coarse_iterations or has_settled:
            self.level -= 1
            self._steps_at_level = 0
        return False

    def _has_converged(self, step: FloatArray) -> bool:
        return bool(
            np.linalg.norm(step[:3]) < np.deg2rad(self._config.converged_rotation_deg)
            and np.linalg.norm(step[3:]) < self._config.converged_translation_m
        )


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Residuals (M,) of the matches at a pose, and their change (M, 6) with a motion in the LiDAR frame."""

    residuals: FloatArray
    jacobian: FloatArray
    weights: FloatArray
    tilt: FloatArray
    lever_m: float

    @classmethod
    def at(cls, T_world_lidar: FloatArray, points: FloatArray, matches: Matches, cell_m: float) -> "_Linearised":
        p = points.take(matches.index, axis=0)
        residuals = matches.residuals(transform_points(T_world_lidar, p))
        normals = matches.normals @ T_world_lidar[:3, :3]
        lever_m = float(np.sqrt(np.einsum("ij,ij->", p, p) / max(len(p), 1)))
        return cls(
            residuals,
            np.concatenate([_cross(p, normals), normals], axis=1),
            _weights(residuals, matches.thickness_m, cell_m),
            matches.tilt,
            lever_m,
        )


def _weights(residuals: FloatArray, thickness_m: FloatArray, cell_m: float) -> FloatArray:
    """Information of each residual, under the kernel of Geman and McClure with a scale that follows the residuals."""
    size = np.abs(residuals)
    variances = thickness_m**2 + _RANGE_NOISE_M**2
    scale = max(_SCALE_PER_MEDIAN * float(np.median(size)), _LEAST_SCALE * cell_m)
    weights = 1.0 / ((1.0 + size**2 / (scale**2 + thickness_m**2)) ** 2 * variances)
    weights[size > _GATE * cell_m] = 0.0
    return np.asarray(weights, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Solution:
    pose_step: FloatArray
    velocity_step: FloatArray
    covariance: FloatArray
    degeneracy: Degeneracy


def _solve(
    system: _Linearised,
    times: FloatArray | None,
    prediction: Prediction,
    T_world_lidar: FloatArray,
    velocity: FloatArray,
) -> _Solution:
    """One Gauss-Newton step of pose and, where `times` (M,) are given, velocity.

    A point seen at time t moves with the velocity's change as with t times the pose's, to first order.
    """
    J, r = system.jacobian, system.residuals
    degeneracy = find_degeneracy(J, system.weights, system.tilt, system.lever_m)
    held = _HELD * degeneracy.projector()
    prior: FloatArray = np.asarray(np.linalg.inv(prediction.covariance), dtype=np.float64)
    away = np.concatenate([log(inverse(prediction.T_world_lidar) @ T_world_lidar), velocity - prediction.velocity])
    JW = J * (system.weights / _CORRELATION)[:, None]
    matched, b = np.zeros((12, 12)), -prior @ away
    matched[:6, :6] = JW.T @ J
    b[:6] -= JW.T @ r + held @ away[:6]
    holding = np.zeros((12, 12))
    holding[:6, :6] = held
    if times is not None:
        Jt = J * times[:, None]
        JWt = JW * times[:, None]
        matched[:6, 6:] = JW.T @ Jt
        matched[6:, :6] = matched[:6, 6:].T
        matched[6:, 6:] = JWt.T @ Jt
        holding[6:, 6:] = held * float(np.mean(times**2))
        b[6:] -= JWt.T @ r + holding[6:, 6:] @ away[6:]
    step: FloatArray = np.asarray(np.linalg.solve(matched + prior + holding, b), dtype=np.float64)
    return _Solution(step[:6], step[6:], _covariance(matched, prior, degeneracy), degeneracy)


def _covariance(matched: FloatArray, prior: FloatArray, degeneracy: Degeneracy) -> FloatArray:
    """The inverse of the information; along directions that were kept, the matches' share of it does not count."""
    scale = np.array([degeneracy.lever_m] * 3 + [1.0] * 3)
    D = degeneracy.directions
    held_by_matches = np.kron(np.eye(2), np.eye(6) - (D / scale).T @ (D * scale))
    return np.asarray(np.linalg.inv(held_by_matches.T @ matched @ held_by_matches + prior), dtype=np.float64)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (N, 3), several times as fast as NumPy's."""
    out = np.empty_like(a)
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out
