"""Registration of one scan to one map: from its prediction, or from a pose anywhere."""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import MotionState, Prediction
from lidarslam.mapping.registration.local_map import LocalMap, Matcher
from lidarslam.mapping.registration.registration import register, with_mean_velocity
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.tracking.budget import Budget
from lidarslam.mapping.tracking.fit import NO_FIT, Fit
from lidarslam.mapping.tracking.mapped_scan import Attempt

# Covariance (6, 6) of a start without a prediction.
_ANYWHERE = np.diag([np.pi**2] * 3 + [10.0**2] * 3)
# Evidence below which a direction is held at an IMU's prediction.
_HELD_EVIDENCE = 4.0
# Standard deviation to which an IMU has to predict a position that needs no support by the scan, cells, and one that is
# kept along a direction that the scan does not constrain, metres.
_HELD_CELLS, _KNOWN_M = 0.5, 0.3
# Reach of the displaced starts along that direction in standard deviations, and their spacing in cells.
_FOUND_SIGMAS, _FOUND_CELLS = 2.0, 2.0


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
        is_known = start.is_inertial and evidence < _HELD_EVIDENCE and start.sigma_along(direction) < _KNOWN_M
        if not is_known:
            return attempt
        if (found := self._found_along(prediction, start, direction, keypoints)) is not None:
            return found
        held = self._registered(prediction, start.held_along(direction), coarse_first, patient, keypoints)
        if held.registration is None:
            return held
        return replace(held, registration=held.registration.without(direction, start))

    def _found_along(
        self, prediction: Prediction, start: Prediction, direction: FloatArray, keypoints: Sweep
    ) -> Attempt | None:
        """The best constrained attempt from starts displaced along a direction (3,), within the IMU's uncertainty.

        None where no attempt is constrained.
        """
        reach_m, spacing_m = _FOUND_SIGMAS * start.sigma_along(direction), _FOUND_CELLS * self.local_map.cell_m
        best = None
        for steps in range(1, int(reach_m / spacing_m) + 1):
            for sign in (-1.0, 1.0):
                if self.budget.is_spent:
                    return best
                moved = start.displaced(sign * steps * spacing_m * direction)
                found = self._registered(prediction, moved, False, False, keypoints)
                if found.fit.is_constrained and (best is None or found.fit.constraint > best.fit.constraint):
                    best = found
        return best

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


def measure_fit(
    points: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap, matcher: Matcher | None = None
) -> Fit:
    """Fit of compensated points (N, 3) of the LiDAR frame at a pose (4, 4), with the matcher of a pose nearby."""
    matcher, world = matcher or local_map.matcher(Sweep(points)), transform_points(T_world_lidar, points)
    matcher.match(world, T_world_lidar)
    matches = matcher.correspondences(1)
    distances = np.abs(matches.residuals(world.take(matches.index, axis=0)))
    ranges = np.linalg.norm(points.take(matches.index, axis=0), axis=1)
    surfaces = matches.thickness_m, matches.tilt
    return Fit.of(distances, matches.normals, ranges, len(points), local_map.cell_m, *surfaces)
