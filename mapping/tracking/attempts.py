"""Registration attempts of one scan with one map: from the prediction, from displaced and turned starts, anywhere."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, transform_points
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep, body_velocity
from lidarslam.mapping.motion.prediction import UNKNOWN_VELOCITY, MotionState, Prediction, Prior, ProcessNoise, predict
from lidarslam.mapping.registration.local_map import LocalMap
from lidarslam.mapping.registration.registration import register, with_mean_velocity
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.registration.surfaces import Matcher
from lidarslam.mapping.surfels.stability import constraining_points
from lidarslam.mapping.tracking.attempt import Attempt, best_of
from lidarslam.mapping.tracking.birds_eye_map import BirdsEyeMap
from lidarslam.mapping.tracking.budget import Budget, Steps, complete
from lidarslam.mapping.tracking.fit import NO_FIT, Fit
from lidarslam.mapping.tracking.start_poses import (
    SCORED_POINTS,
    best_starts,
    best_supported,
    best_velocity,
    positions_around,
    turned_poses,
)

# Covariance (6, 6) of a start without a prediction.
_ANYWHERE = np.diag([np.pi**2] * 3 + [10.0**2] * 3)
# Radius of a scan's bird's-eye view in median ranges, its cell in cells of the map, and the places that are tried.
_VIEW_RANGES, _VIEW_CELLS, _PLACES = 3.0, 4.0, 24
# Changes of the yaw rate tried on a scan that fits poorly, rad/s: from full speed one way to full speed the other.
_YAW_RATES = np.deg2rad(np.arange(-400.0, 401.0, 50.0))
_YAW_STEP_DEG = 15.0
# Points that are registered first from a pose found by search, and the share of the best quality above which all are.
_FEW_POINTS, _LIKELY = 800, 0.5
# Displacements tried where the velocity is unknown: the speed of a car, at most the median range, and their spacing in
# cells, within reach of the coarse cells.
_FASTEST_M_S = 50.0
_DISPLACED_CELLS = 3.0
# Most points that constrain directions that few others do, by which a displacement is chosen.
_MOST_CONSTRAINING = 600
# Displacements tried along the least constrained direction, and the largest that is taken, cells; a factor by which
# the quality must be better.
_ALONG_CELLS, _MOST_ALONG_CELLS = (-2.0, -1.0, 1.0, 2.0), 3.0
_CLEARLY_BETTER = 1.1
# Distance of another optimum, cells.
_APART_CELLS = 1.0
# Evidence below which the first sweeps without rings are held along a direction: their strokes seldom cross.
_STROKES_EVIDENCE = 10.0
# Evidence below which a direction is held at an IMU's prediction.
_HELD_EVIDENCE = 4.0
# Standard deviation to which an IMU has to predict a position that needs no support by the scan, cells, and one that is
# kept along a direction that the scan does not constrain, metres.
_HELD_CELLS, _KNOWN_M = 0.5, 0.3
# Reach of the displaced starts along that direction in standard deviations, and their spacing in cells.
_FOUND_SIGMAS, _FOUND_CELLS = 2.0, 2.0


class ScanMatcher:
    """Registers one scan to one map.

    Args:
        scan: sampled.
        last: state of the scan before.
        local_map: local map.
        config: of the mapping.
        budget: of the scan.
    """

    def __init__(
        self, scan: SampledScan, last: MotionState, local_map: LocalMap, config: MappingConfig, budget: Budget
    ) -> None:
        self.scan = scan
        self.last = last
        self._map = local_map
        self._config = config
        self._budget = budget

    def on(self, local_map: LocalMap) -> "ScanMatcher":
        """The matcher of the scan with another map."""
        return ScanMatcher(self.scan, self.last, local_map, self._config, self._budget)

    def none(self, prediction: Prediction) -> Attempt:
        """The result without a registration."""
        return Attempt(prediction, self._map, None, NO_FIT, Status.LOST)

    def register(self, prediction: Prediction, coarse_first: bool) -> Attempt:
        """Register from the prediction; where that does not fit, through coarser cells."""
        attempt = self._attempt(prediction, prediction, coarse_first)
        if coarse_first or attempt.status is Status.OK or self._budget.is_spent:
            return attempt
        again = self._attempt(prediction, prediction, coarse_first=True)
        return again if again.fit.inlier_share > attempt.fit.inlier_share else attempt

    def register_turning(self, prediction: Prediction) -> Attempt:
        """Register patiently from the prediction, and from that with the best of several yaw rates."""
        keypoints, attempts = self.scan.keypoints, [self._attempt(prediction, prediction, patient=True)]
        if self._config.continuous_time and keypoints.times is not None and not self._budget.is_spent:
            up = prediction.T_world_lidar[:3, :3].T @ self._map.vertical()
            velocities = prediction.velocity + np.outer(_YAW_RATES, np.concatenate([up, np.zeros(3)]))
            velocity = best_velocity(keypoints, velocities, prediction.T_world_lidar, self._map)
            if not (np.array_equal(velocity, prediction.velocity) or self._budget.is_spent):
                attempts.append(self._attempt(prediction, replace(prediction, velocity=velocity), patient=True))
        return max(attempts, key=lambda attempt: attempt.quality)

    def register_displaced(self, rotations: Sequence[FloatArray]) -> Steps[list[Attempt]]:
        """Attempts with status ok from displacements since the last scan in every horizontal direction.

        A sensor at speed at the first scan, or with a wrong odometry, is out of reach of the predicted pose, and most
        of a street fits there too. The rotations are taken from the given poses (4, 4).
        """
        last, interval_s = self.last, self.scan.stamp - self.last.stamp
        if interval_s <= 0.0:
            return []
        radius_m, up = min(_FASTEST_M_S * interval_s, self.scan.range_m), self._map.vertical()
        starts = []
        for rotation in rotations:
            T = last.T_world_lidar.copy()
            T[:3, :3] = rotation[:3, :3]
            starts.append(positions_around(T, up, radius_m, _DISPLACED_CELLS * self._map.cell_m))
        sweep = self.scan.sweep
        few = constraining_points(sweep.points, self.scan.elevations, self._map.cell_m, _MOST_CONSTRAINING)
        points = np.concatenate(
            [part.compensated(last.velocity) for part in (self._some(SCORED_POINTS), sweep.take(few))]
        )
        attempts = []
        best = yield from best_supported(points, np.concatenate(starts), self._map)
        for start in {start.tobytes(): start for start in best}.values():
            yield
            velocity = body_velocity(inverse(last.T_world_lidar) @ start, interval_s)
            moving = replace(last, velocity=velocity, covariance=UNKNOWN_VELOCITY)
            prediction = predict(moving, self.scan.stamp, Prior(), ProcessNoise(), self._config, self.scan.seen_from_s)
            attempts.append(self._attempt(prediction, prediction, patient=True))
        return [attempt for attempt in attempts if attempt.status is Status.OK]

    def or_along_weakest(self, near: Attempt) -> Attempt:
        """An attempt; where it fits poorly, a clearly better one a few cells away along its weakest direction, if any.

        Steps and boxes make several optima, and coarse cells merge them; farther away, another step looks the same.
        """
        if near.status is Status.OK or near.fit.weakest is None or not near.fit.is_constrained:
            return near
        best = near
        for cells in _ALONG_CELLS:
            if self._budget.is_spent:
                break
            away = cells * self._map.cell_m * np.array(near.fit.weakest)
            start = replace(near.prediction, T_world_lidar=_displaced(near.T_world_lidar, away))
            other = self._attempt(near.prediction, start, coarse_first=False)
            away_m = float(np.linalg.norm(other.T_world_lidar[:3, 3] - near.T_world_lidar[:3, 3]))
            if away_m < _MOST_ALONG_CELLS * self._map.cell_m and other.quality > _CLEARLY_BETTER * near.quality:
                best = max(best, other, key=lambda attempt: attempt.quality)
        return best

    def or_from_odometry(self, near: Attempt, prior: Prior) -> Attempt:
        """An attempt, or a clearly better one from the odometry's motion where the prediction is uncertain.

        Of several optima along the weakest direction, as on stairs, the prediction's may be the next step's.
        """
        if prior.T_prev_curr is None or near.prediction.is_inertial:  # an IMU's prediction is better
            return near
        if near.fit.weakest is None or not near.fit.is_constrained:
            return near
        direction, apart_m = np.array(near.fit.weakest), _APART_CELLS * self._map.cell_m
        T_world_lidar = self.last.T_world_lidar @ prior.T_prev_curr
        away_m = abs(float(direction @ (T_world_lidar - near.T_world_lidar)[:3, 3]))
        if near.prediction.sigma_along(direction) < apart_m or away_m < apart_m:
            return near
        start = replace(near.prediction, T_world_lidar=T_world_lidar)
        other = self._attempt(near.prediction, start, coarse_first=False)
        return other if other.quality > _CLEARLY_BETTER * near.quality else near

    def search(self, prediction: Prediction, whole_map: bool) -> Steps[Attempt | None]:
        """Relocalise by yaw search and, if that finds nothing and it is wanted, anywhere; None where neither does."""
        found = yield from self.search_yaw(prediction)
        return found if found is not None or not whole_map else (yield from self.search_map(prediction))

    def search_yaw(self, prediction: Prediction) -> Steps[Attempt | None]:
        """Relocalise by yaw search at the predicted and the last position; None where no result is reliable."""
        up = self._map.vertical()
        poses = (prediction.T_world_lidar, self.last.T_world_lidar)
        starts = np.concatenate([turned_poses(T_world_lidar, up, _YAW_STEP_DEG) for T_world_lidar in poses])
        attempts = yield from self._from(starts, prediction)
        return best_of(attempt for attempt in attempts if attempt.is_reliable)

    def search_map(self, prediction: Prediction) -> Steps[Attempt | None]:
        """Relocalise anywhere in the map at any yaw; None where no result is reliable, or two places fit equally."""
        view = BirdsEyeMap.of(self._map.means(), self._map.vertical(), _VIEW_CELLS * self._map.cell_m)
        yield
        points, reach_m = self.scan.sweep.compensated(prediction.velocity), _VIEW_RANGES * self.scan.range_m
        starts = yield from view.find(points, self.last.T_world_lidar, reach_m, _PLACES)
        attempts = yield from self._from(starts, prediction)
        best = best_of(attempts)
        return best if best is not None and best.is_reliable and not best.has_rivals(attempts) else None

    def relocalise_along(self, found: Attempt, begun: Prediction, prediction: Prediction) -> Attempt | None:
        """Relocalise by the place of an earlier scan and the motion since; None where that is not reliable.

        Args:
            found: the earlier scan, relocalised.
            begun, prediction: of the earlier scan and of this one.
        """
        assert found.registration is not None
        # By the predicted motion and by the earlier sweep's velocity: without an odometry, a standstill was predicted.
        predicted = inverse(begun.T_world_lidar) @ prediction.T_world_lidar
        moved = exp((prediction.stamp - begun.stamp) * found.registration.velocity)
        starts = found.T_world_lidar @ np.array([predicted, moved])
        points = self.scan.keypoints.compensated(prediction.velocity)
        attempt = self._attempt_at(complete(best_starts(points, starts, self._map))[0], prediction)
        return attempt if attempt.is_reliable else None

    def _from(self, starts: FloatArray, prediction: Prediction) -> Steps[list[Attempt]]:
        """Attempts with status ok from the best of the poses (K, 4, 4)."""
        points, rough, attempts = self.scan.keypoints.compensated(prediction.velocity), [], []
        for start in (yield from best_starts(points, starts, self._map)):
            rough.append(self._attempt_at(start, prediction, self._some(_FEW_POINTS)))
            yield
        least = _LIKELY * max((attempt.quality for attempt in rough), default=0.0)
        for attempt in rough:
            if attempt.quality >= least:
                attempts.append(self._attempt_at(attempt.T_world_lidar, prediction))
                yield
        return [attempt for attempt in attempts if attempt.status is Status.OK]

    def _some(self, count: int) -> Sweep:
        """About as many of the keypoints."""
        keypoints = self.scan.keypoints
        return keypoints.take(np.arange(0, len(keypoints), max(1, len(keypoints) // count)))

    def _attempt_at(self, T_world_lidar: FloatArray, prediction: Prediction, keypoints: Sweep | None = None) -> Attempt:
        """An attempt from a pose (4, 4) that is not the predicted one."""
        covariance = np.zeros((12, 12))
        covariance[:6, :6], covariance[6:, 6:] = _ANYWHERE, prediction.covariance[6:, 6:]
        start = replace(prediction, T_world_lidar=T_world_lidar, covariance=covariance)
        return replace(self._attempt(prediction, start, patient=True, keypoints=keypoints), relocalised=True)

    def _attempt(
        self,
        prediction: Prediction,
        start: Prediction,
        coarse_first: bool = True,
        patient: bool = False,
        keypoints: Sweep | None = None,
    ) -> Attempt:
        keypoints = keypoints or self.scan.keypoints
        attempt = self._registered(prediction, start, coarse_first, patient, keypoints)
        # Directions that are hardly constrained would be estimated from the errors of the normals.
        if attempt.registration is None or attempt.fit.weakest is None:
            return attempt
        evidence, direction = attempt.fit.evidence or 0.0, np.array(attempt.fit.weakest)
        if evidence < _HELD_EVIDENCE and start.is_known_along(direction, _KNOWN_M):
            if (found := self._found_along(prediction, start, direction, keypoints)) is not None:
                return found
            held = self._registered(prediction, start.held_along(direction), coarse_first, patient, keypoints)
            return replace(held, registration=held.registration and held.registration.without(direction, start))
        if self.scan.has_rings or not self._map.is_young or evidence > _STROKES_EVIDENCE:
            return attempt
        return self._registered(prediction, start.held_along(direction), coarse_first, patient, keypoints)

    def _found_along(
        self, prediction: Prediction, start: Prediction, direction: FloatArray, keypoints: Sweep
    ) -> Attempt | None:
        """The best constrained attempt from starts displaced along a direction (3,), within the IMU's uncertainty.

        None where no attempt is constrained.
        """
        reach_m, spacing_m = _FOUND_SIGMAS * start.sigma_along(direction), _FOUND_CELLS * self._map.cell_m
        best = None
        for steps in range(1, int(reach_m / spacing_m) + 1):
            for sign in (-1.0, 1.0):
                if self._budget.is_spent:
                    return best
                moved = _displaced(start.T_world_lidar, sign * steps * spacing_m * direction)
                found = self._registered(prediction, replace(start, T_world_lidar=moved), False, False, keypoints)
                if found.fit.is_constrained and (best is None or found.fit.constraint > best.fit.constraint):
                    best = found
        return best

    def _registered(
        self, prediction: Prediction, start: Prediction, coarse_first: bool, patient: bool, keypoints: Sweep
    ) -> Attempt:
        continuous, interval_s = self._config.continuous_time, self.scan.stamp - self.last.stamp
        registration = register(keypoints, start, self._map, continuous, coarse_first, patient)
        if registration is not None and not (continuous and keypoints.times is not None) and interval_s > 0.0:
            registration = with_mean_velocity(registration, keypoints, start, self.last, self._map, patient)
        if registration is None:
            return self.none(prediction)
        points = keypoints.compensated(registration.velocity)
        fit = measure_fit(points, registration.T_world_lidar, self._map, registration.matcher)
        held = start.holds(registration.T_world_lidar, _HELD_CELLS * self._map.cell_m)
        status = fit.status(self._config.tracking, self._map.is_young, held)
        return Attempt(prediction, self._map, registration, fit, status)


def _displaced(T_world_lidar: FloatArray, away: FloatArray) -> FloatArray:
    """A pose (4, 4) displaced by a vector (3,) of the world."""
    displaced = T_world_lidar.copy()
    displaced[:3, 3] += away
    return displaced


def measure_fit(
    points: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap, matcher: Matcher | None = None
) -> Fit:
    """Fit of compensated points (N, 3) of the LiDAR frame at a pose (4, 4), with the matcher of a pose nearby."""
    matcher, world = matcher or local_map.matcher(Sweep(points)), transform_points(T_world_lidar, points)
    matcher.match(world, T_world_lidar)
    matches = matcher.first_correspondences()
    distances = np.abs(matches.residuals(world.take(matches.index, axis=0)))
    ranges = np.linalg.norm(points.take(matches.index, axis=0), axis=1)
    surfaces = matches.thickness_m, matches.tilt
    return Fit.of(distances, matches.normals, ranges, len(points), local_map.cell_m, *surfaces)
