"""Registration of one scan to one map: from its prediction, or from the best of some start poses anywhere."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, transform_points
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import MotionState, Prediction
from lidarslam.mapping.registration.local_map import COARSE, LocalMap
from lidarslam.mapping.registration.registration import register, with_mean_velocity
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.tracking.budget import Budget, Steps
from lidarslam.mapping.tracking.fit import NO_FIT, measure_fit, translation_information
from lidarslam.mapping.tracking.mapped_scan import Attempt

# Covariance (6, 6) of a start without a prediction.
_ANYWHERE = np.diag([np.pi**2] * 3 + [10.0**2] * 3)
# Evidence below which a direction is held at the prediction, with an IMU or without rings, whose sparse strokes fit a
# corridor anywhere.
_HELD_EVIDENCE = 4.0
# Standard deviation to which an IMU has to predict a position that needs no support by the scan, cells, and one that is
# kept along a direction that the scan does not constrain, metres.
_HELD_CELLS, _KNOWN_M = 0.5, 0.3
# Reach of the displaced starts along that direction in standard deviations, and their spacing in cells.
_FOUND_SIGMAS, _FOUND_CELLS = 2.0, 2.0
# Points that score a start, and starts that are registered.
SCORED_POINTS = 600
_BEST = 3
# Distance, in finest cells, at which a point has half the weight.
_HALF_CELLS = 2.0
# Ridge of the information as a share of its trace, so that a direction without constraints is not decided by noise.
_RIDGE = 0.005


@dataclass(frozen=True, eq=False)
class ScanMatcher:
    """Registers one scan to one map."""

    scan: SampledScan
    last: MotionState  # of the scan before
    local_map: LocalMap
    config: MappingConfig
    budget: Budget  # of the scan

    def none(self, prediction: Prediction) -> Attempt:
        """The result without a registration."""
        return Attempt(prediction, self.local_map, None, NO_FIT, Status.LOST)

    def some(self, count: int) -> Sweep:
        """About as many of the keypoints."""
        keypoints = self.scan.keypoints
        return keypoints.take(np.arange(0, len(keypoints), max(1, len(keypoints) // count)))

    def register(self, prediction: Prediction, coarse_first: bool) -> Attempt:
        """Register from the prediction; where that does not fit, through coarser cells."""
        attempt = self.attempt(prediction, prediction, coarse_first)
        if coarse_first or attempt.status is Status.OK or self.budget.is_spent:
            return attempt
        again = self.attempt(prediction, prediction)
        return again if again.fit.inlier_share > attempt.fit.inlier_share else attempt

    def attempt_at(self, T_world_lidar: FloatArray, prediction: Prediction, keypoints: Sweep | None = None) -> Attempt:
        """Register from a pose (4, 4) that is not the predicted one."""
        covariance = np.zeros((12, 12))
        covariance[:6, :6], covariance[6:, 6:] = _ANYWHERE, prediction.covariance[6:, 6:]
        start = replace(prediction, T_world_lidar=T_world_lidar, covariance=covariance)
        return replace(self.attempt(prediction, start, patient=True, keypoints=keypoints), relocalised=True)

    def attempt(
        self, prediction: Prediction, start: Prediction, coarse_first: bool = True, patient: bool = False,
        keypoints: Sweep | None = None,
    ) -> Attempt:  # fmt: skip
        """Register the keypoints, or some, from a start with the prior's covariance.

        The result is compared with the prediction.
        """
        keypoints = keypoints or self.scan.keypoints
        attempt = self._registered(prediction, start, coarse_first, patient, keypoints)
        # Directions that are hardly constrained would be estimated from the errors of the normals.
        if attempt.registration is None or attempt.fit.weakest is None:
            return attempt
        evidence, direction = attempt.fit.evidence or 0.0, np.array(attempt.fit.weakest)
        is_held = (start.is_inertial or not self.scan.has_rings) and evidence < _HELD_EVIDENCE
        if not is_held or start.sigma_along(direction) > _KNOWN_M:
            return attempt
        found = self._found_along(prediction, start, direction, keypoints) if start.is_inertial else None
        if found is not None:
            return found
        held = self._registered(prediction, start.held_along(direction), coarse_first, patient, keypoints)
        if held.registration is None:
            return held
        return replace(held, registration=held.registration.without(direction, start))

    def displaced(self, start: Prediction, offsets_m: Iterable[float], direction: FloatArray) -> Iterator[Prediction]:
        """Starts displaced along a direction (3,) of the world, one after another while the budget lasts."""
        for offset_m in offsets_m:
            if self.budget.is_spent:
                return
            yield start.displaced(offset_m * direction)

    def _found_along(
        self, prediction: Prediction, start: Prediction, direction: FloatArray, keypoints: Sweep
    ) -> Attempt | None:
        """The best constrained attempt from starts displaced along a direction (3,), within the IMU's uncertainty.

        None where no attempt is constrained.
        """
        reach_m, spacing_m = _FOUND_SIGMAS * start.sigma_along(direction), _FOUND_CELLS * self.local_map.cell_m
        steps = range(1, int(reach_m / spacing_m) + 1)
        starts = self.displaced(start, [sign * n * spacing_m for n in steps for sign in (-1.0, 1.0)], direction)
        found = (self._registered(prediction, moved, False, False, keypoints) for moved in starts)
        constrained = (attempt for attempt in found if attempt.fit.is_constrained)
        return max(constrained, key=lambda attempt: attempt.fit.constraint, default=None)

    def _registered(
        self, prediction: Prediction, start: Prediction, coarse_first: bool, patient: bool, keypoints: Sweep
    ) -> Attempt:
        continuous, interval_s = self.config.continuous_time, self.scan.stamp - self.last.stamp
        registration = register(keypoints, start, self.local_map, continuous, coarse_first, patient)
        if registration is not None and not (continuous and keypoints.times is not None) and interval_s > 0.0:
            registration = with_mean_velocity(registration, keypoints, start, self.last, self.local_map, patient)
        if registration is None:
            return self.none(prediction)
        points = keypoints.compensated(registration.velocity)
        fit = measure_fit(points, registration.T_world_lidar, self.local_map, registration.matcher)
        held = start.holds(registration.T_world_lidar, _HELD_CELLS * self.local_map.cell_m)
        status = fit.status(self.config.tracking, self.local_map.is_young, held)
        return Attempt(prediction, self.local_map, registration, fit, status)


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
        normals, distances = _distances(points, start, local_map)
        sums.append(translation_information(normals, distances, np.ones(len(distances)))[:2])
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
    """Normals (M, 3) of the surfaces in the coarse cells, and distances (M,) in half-weight units."""
    world = transform_points(T_world_lidar, points)
    matches = local_map.match(world, T_world_lidar, COARSE)
    distances = matches.residuals(world.take(matches.index, axis=0))
    return matches.normals, distances / (_HALF_CELLS * local_map.cell_m)
