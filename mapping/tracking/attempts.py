"""Registration attempts of one scan with one map: from the prediction, from displaced and turned starts, anywhere."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, log, transform_points
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import body_velocity
from lidarslam.mapping.motion.prediction import UNKNOWN_VELOCITY, MotionState, Prediction, Prior, ProcessNoise, predict
from lidarslam.mapping.surfels.matching import Matcher
from lidarslam.mapping.surfels.registration import Registration, register, with_mean_velocity
from lidarslam.mapping.surfels.sampling import SampledScan
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.birds_eye_map import BirdsEyeMap
from lidarslam.mapping.tracking.fit import NO_FIT, Fit
from lidarslam.mapping.tracking.start_poses import (
    best_starts,
    best_supported,
    best_velocity,
    positions_around,
    turned_poses,
)

# Covariance (6, 6) of a start without a prediction.
_ANYWHERE = np.diag([np.pi**2] * 3 + [10.0**2] * 3)
# A correction beyond so many standard deviations of the prediction, and beyond degrees and metres, is a jump.
_MOST_SIGMAS = 5.0
_LEAST_JUMP = np.array([np.deg2rad(10.0)] * 3 + [0.5] * 3)
# Share of inliers that a scan needs at its prediction after a lost one.
_PLAUSIBLE_SHARE = 0.5
# A scan that may be anywhere needs a much better fit, and a clearly better one than at the next best place so many
# cells away. On simulated recordings the inlier ratio was 57 to 74 % at wrong places, at right ones 94 % and more; the
# share of inliers depends on how much of the view is new.
_RELIABLE_RATIO, _RELIABLE_SHARE, _RELIABLE_SUPPORT = 0.85, 0.4, 0.6
_RIVAL_QUALITY, _RIVAL_CELLS = 1.2, 4.0
# Radius of a scan's bird's-eye view in median ranges, its cell in cells of the map, and the places that are tried.
_VIEW_RANGES, _VIEW_CELLS, _PLACES = 3.0, 4.0, 24
# Changes of the yaw rate tried on a scan that fits poorly, rad/s: from full speed one way to full speed the other.
_YAW_RATES = np.deg2rad(np.arange(-400.0, 401.0, 50.0))
_YAW_STEP_DEG = 15.0
# Displacements tried where the velocity is unknown: the speed of a car, at most the median range, and their spacing in
# cells, within reach of the coarse cells.
_FASTEST_M_S = 50.0
_DISPLACED_CELLS = 3.0


@dataclass(frozen=True, eq=False)
class Attempt:
    """A registration attempt."""

    prediction: Prediction  # that the result is compared with
    surfel_map: SurfelMap  # that the scan was registered to
    registration: Registration | None  # None where there were too few correspondences
    fit: Fit  # of the scan to the map
    status: Status  # by the fit
    relocalised: bool = False  # whether it began elsewhere than at the prediction
    ambiguous: bool = False  # whether another displacement fits nearly as well while the velocity is unknown

    @property
    def is_plausible(self) -> bool:
        """Whether the fit suffices at the prediction after a lost scan."""
        return self.fit.inlier_share > _PLAUSIBLE_SHARE

    @property
    def is_reliable(self) -> bool:
        """Whether the fit suffices without a prediction."""
        ratio, share, support = self.fit.inlier_ratio or 0.0, self.fit.inlier_share, self.fit.support or 0.0
        fits = ratio > _RELIABLE_RATIO and share > _RELIABLE_SHARE and support > _RELIABLE_SUPPORT
        return self.status is Status.OK and fits

    @property
    def quality(self) -> float:
        """Score among attempts: share of inliers times directional support."""
        return self.fit.inlier_share * (self.fit.support or 0.0)

    @property
    def T_world_lidar(self) -> FloatArray:
        """(4, 4) the registered pose; the predicted one without a registration."""
        return (self.registration or self.prediction).T_world_lidar

    @property
    def correction(self) -> FloatArray:
        """(6,) from the predicted pose to the registered one."""
        return log(inverse(self.prediction.T_world_lidar) @ self.T_world_lidar)

    @property
    def has_jumped(self) -> bool:
        """Whether the correction exceeds every motion that the prediction allows for."""
        sigmas = np.sqrt(np.diag(self.prediction.covariance)[:6])
        return bool((np.abs(self.correction) > np.maximum(_MOST_SIGMAS * sigmas, _LEAST_JUMP)).any())

    def has_rivals(self, others: Iterable["Attempt"]) -> bool:
        """Whether the scan fits nearly as well at another place."""
        apart_m = _RIVAL_CELLS * self.surfel_map.cell_m
        return any(
            np.linalg.norm(other.T_world_lidar[:3, 3] - self.T_world_lidar[:3, 3]) > apart_m
            and _RIVAL_QUALITY * other.quality > self.quality
            for other in others
        )


def best_of(attempts: Iterable[Attempt]) -> Attempt | None:
    """The attempt of highest quality; None of none."""
    return max(attempts, key=lambda attempt: attempt.quality, default=None)


class ScanMatcher:
    """Registers one scan to one map.

    Args:
        scan: sampled.
        last: state of the scan before.
        surfel_map: local map.
        config: of the mapping.
    """

    def __init__(self, scan: SampledScan, last: MotionState, surfel_map: SurfelMap, config: MappingConfig) -> None:
        self.scan = scan
        self.last = last
        self._map = surfel_map
        self._config = config

    def register(self, prediction: Prediction, coarse_first: bool) -> Attempt:
        """Register from the prediction; where that does not fit, by way of coarser cells."""
        attempt = self._attempt(prediction, prediction, coarse_first)
        if coarse_first or attempt.status is Status.OK:
            return attempt
        again = self._attempt(prediction, prediction, coarse_first=True)
        return again if again.fit.inlier_share > attempt.fit.inlier_share else attempt

    def register_turning(self, prediction: Prediction) -> Attempt:
        """Register patiently from the prediction, and from that with the best of several yaw rates."""
        keypoints, starts = self.scan.keypoints, [prediction]
        if self._config.continuous_time and keypoints.times is not None:
            up = prediction.T_world_lidar[:3, :3].T @ self._map.vertical()
            velocities = prediction.velocity + np.outer(_YAW_RATES, np.concatenate([up, np.zeros(3)]))
            velocity = best_velocity(keypoints, velocities, prediction.T_world_lidar, self._map)
            if not np.array_equal(velocity, prediction.velocity):
                starts.append(replace(prediction, velocity=velocity))
        attempts = [self._attempt(prediction, start, patient=True) for start in starts]
        return max(attempts, key=lambda attempt: attempt.quality)

    def register_displaced(self, rotations: Sequence[FloatArray]) -> list[Attempt]:
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
        points, attempts = self.scan.keypoints.compensated(last.velocity), []
        for start in best_supported(points, np.concatenate(starts), self._map):
            velocity = body_velocity(inverse(last.T_world_lidar) @ start, interval_s)
            moving = replace(last, velocity=velocity, covariance=UNKNOWN_VELOCITY)
            prediction = predict(moving, self.scan.stamp, Prior(), ProcessNoise(), self._config, self.scan.seen_from_s)
            attempts.append(self._attempt(prediction, prediction, patient=True))
        return [attempt for attempt in attempts if attempt.status is Status.OK]

    def search_yaw(self, prediction: Prediction) -> Attempt | None:
        """Relocalise by yaw search at the predicted and the last position; None where no result is reliable."""
        up = self._map.vertical()
        poses = (prediction.T_world_lidar, self.last.T_world_lidar)
        starts = np.concatenate([turned_poses(T_world_lidar, up, _YAW_STEP_DEG) for T_world_lidar in poses])
        return best_of(attempt for attempt in self._from(starts, prediction) if attempt.is_reliable)

    def search_map(self, prediction: Prediction) -> Attempt | None:
        """Relocalise anywhere in the map at any yaw; None where no result is reliable, or two places fit alike."""
        view = BirdsEyeMap.of(self._map.means(), self._map.vertical(), _VIEW_CELLS * self._map.cell_m)
        points = self.scan.sweep.compensated(prediction.velocity)
        starts = view.find(points, self.last.T_world_lidar, _VIEW_RANGES * self.scan.range_m, _PLACES)
        attempts = self._from(starts, prediction)
        best = best_of(attempts)
        return best if best is not None and best.is_reliable and not best.has_rivals(attempts) else None

    def _from(self, starts: FloatArray, prediction: Prediction) -> list[Attempt]:
        """Attempts with status ok from the best of the poses (K, 4, 4)."""
        points = self.scan.keypoints.compensated(prediction.velocity)
        covariance = np.zeros((12, 12))
        covariance[:6, :6], covariance[6:, 6:] = _ANYWHERE, prediction.covariance[6:, 6:]
        attempts = [
            self._attempt(prediction, replace(prediction, T_world_lidar=start, covariance=covariance), patient=True)
            for start in best_starts(points, starts, self._map)
        ]
        return [replace(attempt, relocalised=True) for attempt in attempts if attempt.status is Status.OK]

    def _attempt(
        self, prediction: Prediction, start: Prediction, coarse_first: bool = True, patient: bool = False
    ) -> Attempt:
        keypoints, interval_s = self.scan.keypoints, self.scan.stamp - self.last.stamp
        continuous = self._config.continuous_time
        registration = register(keypoints, start, self._map, continuous, coarse_first, patient)
        if registration is not None and not (continuous and keypoints.times is not None) and interval_s > 0.0:
            registration = with_mean_velocity(registration, keypoints, start, self.last, self._map, patient)
        if registration is None:
            return Attempt(prediction, self._map, None, NO_FIT, Status.LOST)
        points = keypoints.compensated(registration.velocity)
        fit = measure_fit(points, registration.T_world_lidar, self._map, registration.matcher)
        return Attempt(prediction, self._map, registration, fit, fit.status(self._config.tracking))


def measure_fit(
    points: FloatArray, T_world_lidar: FloatArray, surfel_map: SurfelMap, matcher: Matcher | None = None
) -> Fit:
    """Fit of compensated points (N, 3) of the LiDAR frame at a pose (4, 4), with the matcher of a pose nearby."""
    matcher, world = matcher or surfel_map.matcher(len(points)), transform_points(T_world_lidar, points)
    matcher.match(world, T_world_lidar)
    matches = matcher.correspondences().first_of_each_point()
    distances = np.abs(matches.residuals(world.take(matches.index, axis=0)))
    ranges = np.linalg.norm(points.take(matches.index, axis=0), axis=1)
    return Fit.of(distances, matches.normals, ranges, len(points), surfel_map.cell_m)
