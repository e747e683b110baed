"""Tracking policy: which registrations of a scan are attempted, and whether their best result is accepted."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import FloatArray, displacement_m, inverse
from lidarslam.core.state import Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.prediction import (
    LARGEST_PROCESS_NOISE,
    LOST_MOTION,
    MotionState,
    OdometryNoise,
    Prediction,
    Prior,
    ProcessNoise,
    predict,
)
from lidarslam.mapping.motion.velocity_bias import VelocityBias
from lidarslam.mapping.registration.local_map import LocalMap
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.tracking.archived_maps import ArchivedMaps
from lidarslam.mapping.tracking.attempt import Attempt, best_of
from lidarslam.mapping.tracking.attempts import ScanMatcher
from lidarslam.mapping.tracking.budget import Budget
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.pose_status import judge
from lidarslam.mapping.tracking.spread_search import SpreadSearch
from lidarslam.mapping.tracking.tracking_state import TrackingState

# Registration begins on coarse cells unless the predictions were off by less than this share of a cell lately; their
# error is forgotten by a factor per scan.
_FINE_ERROR_CELLS, _ERROR_DECAY, _UNKNOWN_ERROR_M = 0.5, 0.8, 10.0
# A scan constrains its weakest direction poorly below this support or evidence: a fifth of the scans on stairs, in
# offices, streets and crowds none. There an odometry counts with at most this many times its own standard deviations,
# after motions of fewer cells than this: after longer ones it may itself be off by a step.
_WEAK_SUPPORT, _WEAK_EVIDENCE, _WEAK_CAUTION, _WEAK_CELLS = 0.65, 40.0, 2.0, 2.0
# Where even less constrains it, as in a corridor, only the prediction does: evidence in units of the least.
_LEAST_CONSTRAINT = 2.0
# Factors by which the quality of a result with any acceleration, and with any displacement, must be better.
_BETTER, _CLEARLY_BETTER = 1.05, 1.1


class Tracker(Stateful):
    """Tracks the sensor through one local map after another."""

    _state: TrackingState
    _archive: ArchivedMaps
    _process_noise: ProcessNoise
    _odometry_noise: OdometryNoise
    _velocity_bias: VelocityBias
    _prediction_error_m: float
    _is_measured: bool  # whether a consistent odometry measured every motion since the sensor was tracked

    def __init__(self, config: MappingConfig, budget: Budget | None = None) -> None:
        self._config = config
        self._budget = budget or Budget()
        self._search = SpreadSearch()
        self._map_is_due = False  # whether the next search is one of the whole map
        self._in_vain = False  # whether the last scan ended a search that found nothing
        self._state = TrackingState()
        self._archive = ArchivedMaps()
        self._process_noise = ProcessNoise()
        self._odometry_noise = OdometryNoise()
        self._velocity_bias = VelocityBias()
        self._prediction_error_m = _UNKNOWN_ERROR_M
        self._is_measured = False

    @property
    def is_unconfirmed(self) -> bool:
        """Whether the sensor was relocalised, and the next scans have not confirmed it yet."""
        return self._state.is_unconfirmed

    @property
    def is_searching(self) -> bool:
        """Whether a search is in progress that continues with the next scan."""
        return self._search.is_under_way

    def begin_at(self, stamp: float, quality: float) -> None:
        """Begin with a scan whose pose was found and whose velocity is known; the next scans must confirm it."""
        self._state.registered(Status.OK, relocalised=True, quality=quality, stamp=stamp)
        self._state.velocity_known = True
        self._prediction_error_m = 0.0

    def predict(
        self, scan: SampledScan, prior: Prior, last: MotionState, process_noise: ProcessNoise | None = None
    ) -> Prediction:
        """Predict a scan's state from the last one and the odometry."""
        noise = process_noise or self._process_noise
        return predict(last, scan.stamp, prior, noise, self._config, scan.seen_from_s, self._odometry_noise)

    def register(
        self, scan: SampledScan, prior: Prior, prediction: Prediction, last: MotionState, local_map: LocalMap
    ) -> Attempt:
        """Register a scan near its prediction, else relocalise it; the status is lost where neither is reliable."""
        matcher = ScanMatcher(scan, last, local_map, self._config, self._budget)
        self._is_measured &= self._odometry_noise.is_proven(prior)
        if self._state.is_lost and self.is_searching:  # which has all the time of a lost scan
            found = self._found(matcher, prediction, prior)
            self._in_vain = found is None and not self.is_searching
            return found or matcher.none(prediction)
        uncertain = self._state.is_uncertain(scan.stamp - last.stamp)
        near = matcher.register(prediction, self._begins_coarse(scan, prediction))
        if not (uncertain or self._budget.is_spent):
            near = self._improve(matcher, prior, prediction, near)
        unconfirmed = self._state.is_unconfirmed
        if near.status is Status.LOST or ((uncertain or unconfirmed) and not near.is_reliable):
            best = self._relocalise(matcher, near, prior)
        elif near.status is Status.DEGRADED and self._state.searches_nearby:
            found = self._found(matcher, near.prediction, prior, nearby=True)
            best = near if found is None or self._contradicts(prior, found, last) else best_of((near, found))
        elif near.status is Status.OK and not unconfirmed:
            best = self._archive.relocalise(matcher, near.prediction, self._budget) or near
        else:
            best = near
        # After a relocalisation an improbable motion contradicts that.
        motion = inverse(last.T_world_lidar) @ near.T_world_lidar
        improbable = near.has_jumped or self._odometry_noise.rejects(prior, motion, self._config)
        rejected = best is near and unconfirmed and improbable
        return replace(near, status=Status.LOST) if best is None or rejected else best

    def accept(
        self, attempt: Attempt, scan: SampledScan, prior: Prior, prediction: Prediction, last: MotionState
    ) -> MappedScan:
        """Judge a registration, and update noise and tracking state with it."""
        registration, jumped = attempt.registration, attempt.has_jumped
        assert registration is not None
        is_timed = scan.sweep.times is not None and self._config.continuous_time
        T_world_lidar, velocity, covariance = registration.T_world_lidar, registration.velocity, registration.covariance
        state = MotionState(scan.stamp, T_world_lidar, velocity, covariance, scan.seen_until_s)
        self._state.registered(attempt.status, attempt.relocalised, attempt.quality, scan.stamp)
        self._is_measured |= not self._state.is_unconfirmed
        if attempt.status is Status.OK or attempt.relocalised:
            self._end_search()
        if attempt.relocalised or jumped or not self._state.velocity_known or prior.inertial is not None:
            self._velocity_bias = VelocityBias()
        elif is_timed:
            self._velocity_bias = self._velocity_bias.updated(last, state, scan.seen_from_s)
            state = self._velocity_bias.corrected(state)
        motion = inverse(last.T_world_lidar) @ state.T_world_lidar
        if not attempt.relocalised:
            self._update_noise(state, motion, prior, last)
        error_m = displacement_m(attempt.correction, scan.range_m)
        self._prediction_error_m = max(_ERROR_DECAY * self._prediction_error_m, error_m)
        self._state.velocity_known = not (jumped or attempt.relocalised)
        if not self._state.velocity_known:
            velocity = attempt.uncertain_velocity(scan, last, self._config.continuous_time)
            state = MotionState(scan.stamp, T_world_lidar, velocity, LOST_MOTION)
        unexpected = not attempt.relocalised and replace(attempt, prediction=prediction).has_jumped
        # A young map that is not added to would stay one; and in one that ends, as at the next flight of stairs, scans
        # fit ever worse.
        fits = attempt.status is Status.OK or attempt.local_map.is_young
        fits = fits or self._odometry_noise.confirms(replace(prior, caution=_WEAK_CAUTION), motion, self._config)
        status, message = judge(attempt, self._state, unexpected, len(self._archive) > 0, self._config.tracking)
        return MappedScan(
            state=state,
            T_world_predicted=attempt.prediction.T_world_lidar,
            measured=None if prior.inertial is None else registration.measured,
            registered=True,
            status=status,
            message=message,
            fit=attempt.fit,
            degenerate=attempt.unconstrained,
            iterations=registration.iterations,
            added=fits and not jumped and not self._state.is_unconfirmed,
            is_connected=not attempt.relocalised,
            turn_rate=registration.velocity[:3] if is_timed and prior.inertial is None else None,
        )

    def lose(self, local_map: LocalMap, has_points: bool) -> bool:
        """Update with a scan that was not registered; true where the map is archived and a new one must begin."""
        if not self.loses(has_points):
            return False
        self._archive.add(local_map)
        self._end_search()
        self._state.map_restarted()
        return True

    def loses(self, has_points: bool) -> bool:
        """Update with a scan that was not registered; true after enough of them to give the map up."""
        self._prediction_error_m = _UNKNOWN_ERROR_M
        self._is_measured &= has_points
        self._state.lost(has_points)
        return has_points and self._state.gives_up and not self.is_searching

    def snapshot(self) -> "Tracker":
        """A copy to `rewind` to."""
        copied = copy(self)
        copied._state = copy(self._state)
        return copied

    def rewind(self, earlier: "Tracker") -> None:
        """Take the last registration back, but for the observed error of the predictions."""
        self._state = copy(earlier._state)
        self._process_noise, self._odometry_noise = earlier._process_noise, earlier._odometry_noise
        self._velocity_bias, self._is_measured = earlier._velocity_bias, earlier._is_measured
        self._end_search()

    def _begins_coarse(self, scan: SampledScan, prediction: Prediction) -> bool:
        within_m = _FINE_ERROR_CELLS * scan.cell_m
        return self._prediction_error_m > within_m and not prediction.is_held_within(within_m)

    def _contradicts(self, prior: Prior, found: Attempt, last: MotionState) -> bool:
        """Whether a place found by search contradicts an odometry that was consistent, as the next step of stairs."""
        motion = inverse(last.T_world_lidar) @ found.T_world_lidar
        return self._odometry_noise.rejects(replace(prior, caution=_WEAK_CAUTION), motion, self._config)

    def _improve(self, matcher: ScanMatcher, prior: Prior, prediction: Prediction, near: Attempt) -> Attempt:
        """The best of a registration and others: any acceleration, without a contradicted odometry, displacements."""
        near = self._or_held_by_odometry(matcher, prior, near)
        best, has_odometry = self._or_turning(matcher, prior, prediction, near), prior.T_prev_curr is not None
        is_poor = has_odometry and best.status is not Status.OK
        if (prediction.contradicted or is_poor) and self._state.velocity_known and not self._budget.is_spent:
            inertial = prior.without_odometry()
            alone = self.predict(matcher.scan, inertial, matcher.last)
            other = matcher.register(alone, self._begins_coarse(matcher.scan, alone))
            other = self._or_turning(matcher, inertial, alone, other)
            # Where odometry and last motion agree, another pose is that of a similar place, as the next flight.
            if other.quality > best.quality:
                is_similar = not prediction.contradicted and self._contradicts(prior, other, matcher.last)
                best = best if is_similar else other
            is_poor = has_odometry and best.status is not Status.OK
        if (is_poor or not self._state.velocity_known) and not self._budget.is_spent:
            rotations = prediction.T_world_lidar, matcher.last.T_world_lidar
            displaced = self._budget.run(matcher.register_displaced(rotations))
            best = best if displaced is None else self._or_displaced(best, displaced[0])
        best = best if self._budget.is_spent else matcher.or_from_odometry(best, prior)
        return best if self._budget.is_spent else matcher.or_along_weakest(best)

    def _or_held_by_odometry(self, matcher: ScanMatcher, prior: Prior, near: Attempt) -> Attempt:
        """A registration, or where the scan constrains a direction poorly, one held closer to the odometry's motion.

        Errors of an odometry are correlated in time, but so are those of the few surfaces that constrain the scan.
        """
        if prior.covariance is None or prior.T_prev_curr is None or prior.inertial is not None:
            return near
        fit, moved_m = near.fit, float(np.linalg.norm(prior.T_prev_curr[:3, 3]))
        is_weak = (fit.support or 0.0) < _WEAK_SUPPORT or (fit.evidence or 0.0) < _WEAK_EVIDENCE
        if not is_weak or fit.constraint < _LEAST_CONSTRAINT or self._budget.is_spent:
            return near
        if moved_m > _WEAK_CELLS * matcher.scan.cell_m:
            return near
        closer = replace(prior, caution=_WEAK_CAUTION)
        held = matcher.register(self.predict(matcher.scan, closer, matcher.last), coarse_first=False)
        return replace(held, prediction=near.prediction) if _BETTER * held.quality > near.quality else near

    def _or_turning(self, matcher: ScanMatcher, prior: Prior, prediction: Prediction, near: Attempt) -> Attempt:
        """A registration, or where it fits poorly and that is better, one with any acceleration.

        An unexpected motion bends the sweep, which then fits halfway at a wrong pose and velocity.
        """
        if not self._state.fits_poorly(near.status, near.quality) or self._budget.is_spent:
            return near
        turning = matcher.register_turning(self.predict(matcher.scan, prior, matcher.last, LARGEST_PROCESS_NOISE))
        away_m = float(np.linalg.norm(turning.T_world_lidar[:3, 3] - near.T_world_lidar[:3, 3]))
        is_near = near.status is not Status.LOST and away_m < matcher.scan.cell_m  # the same optimum
        is_better = (turning.is_reliable or is_near) and turning.quality > _BETTER * near.quality
        return replace(turning, prediction=prediction) if is_better else near

    def _or_displaced(self, best: Attempt, others: Sequence[Attempt]) -> Attempt:
        """The best of an attempt and those from displacements, marked as ambiguous where another fits as well."""
        for other in filter(lambda other: other.is_reliable or not self._state.velocity_known, others):
            best = other if other.quality > _CLEARLY_BETTER * best.quality else best
        is_settled = best.registration is None or self._state.velocity_known
        return best if is_settled else replace(best, ambiguous=best.has_rivals(others))

    def _relocalise(self, matcher: ScanMatcher, near: Attempt, prior: Prior) -> Attempt | None:
        """The best of the nearby attempt, a yaw search and, where it is due, a search of the map; None of none.

        The nearby attempt does not count before a search is done.
        """
        sufficient = near.is_reliable if self._state.is_unconfirmed else near.is_plausible
        counts, in_vain = near.status is not Status.LOST and sufficient, self._in_vain
        self._in_vain = False
        if counts and in_vain:
            return near
        found = self._found(matcher, near.prediction, prior)
        return best_of(filter(None, (near if counts and not self.is_searching else None, found)))

    def _found(
        self, matcher: ScanMatcher, prediction: Prediction, prior: Prior, nearby: bool = False
    ) -> Attempt | None:
        """The scan, relocalised by the search in progress or a new one; None where that is not finished or fails.

        A place out of reach of the motion since the sensor was tracked is a similar one, and is rejected.
        """
        self._map_is_due |= self._state.searches_map and not nearby
        if not self._search.is_under_way:
            self._search.begin(matcher.search(prediction, self._map_is_due), prediction)
            self._map_is_due = False
        found, tracked_s = self._search.go_on(matcher, prediction, self._budget), self._state.tracked_s
        is_inertial = prior.inertial is not None
        return found if found and found.is_reachable(tracked_s, is_inertial, self._is_measured) else None

    def _end_search(self) -> None:
        self._search.drop()
        self._map_is_due = self._in_vain = False

    def _update_noise(self, state: MotionState, motion: FloatArray, prior: Prior, last: MotionState) -> None:
        interval_s = state.stamp - last.stamp
        if interval_s > 0.0 and self._state.velocity_known:
            variance = np.diag(state.covariance + last.covariance)[6:]
            self._process_noise = self._process_noise.updated(state.velocity - last.velocity, interval_s, variance)
        self._odometry_noise = self._odometry_noise.updated(prior, motion, self._config)
