"""Tracking policy: which registrations of a scan are attempted, and whether their best result is accepted.

Where none near the prediction is, the scan is relocalised: searched for at any yaw there, anywhere in the map, and in
the maps that were given up.
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, displacement_m, exp, inverse
from lidarslam.core.state import Stateful
from lidarslam.core.tracking import AXES, Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.prediction import FADING, LOST_MOTION, MotionState, Prediction, Prior, corrected_by_motion
from lidarslam.mapping.registration.local_map import LocalMap
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.tracking.birds_eye_map import BirdsEyeMap
from lidarslam.mapping.tracking.budget import Budget, Steps, complete
from lidarslam.mapping.tracking.fit import Fit
from lidarslam.mapping.tracking.mapped_scan import Attempt, MappedScan, best_of, judge
from lidarslam.mapping.tracking.near_search import WEAK_CAUTION, NearSearch
from lidarslam.mapping.tracking.scan_matcher import ScanMatcher, best_starts, turned_poses
from lidarslam.mapping.tracking.tracking_state import TrackingState

_YAW_STEP_DEG = 15.0
# Radius of a scan's bird's-eye view in median ranges, its cell in cells of the map, and the places that are tried.
_VIEW_RANGES, _VIEW_CELLS, _PLACES = 3.0, 4.0, 24
# Points that are registered first from a pose found by search, and the share of the best quality above which all are.
_FEW_POINTS, _LIKELY = 800, 0.5
# An archived map of fewer scans is not worth a search.
_LEAST_SCANS = 5
# A search takes a second: scans until the first, growth of the intervals, and the longest.
_FIRST_WAIT, _WAIT_GROWTH, _LONGEST_WAIT = 5, 1.5, 60
# How many times as well a scan has to fit elsewhere as where it follows from a relocalisation.
_CLEARLY = 1.3
# Share of inliers that a scan needs at its prediction after a lost one.
_PLAUSIBLE_SHARE = 0.5


def search_nearby(matcher: ScanMatcher, prediction: Prediction, whole_map: bool) -> Steps[Attempt | None]:
    """Search at any yaw at the predicted and the last position and, if that finds nothing and it is wanted, anywhere.

    None where no result is reliable.
    """
    up = matcher.local_map.vertical()
    poses = (prediction.T_world_lidar, matcher.last.T_world_lidar)
    starts = np.concatenate([turned_poses(T_world_lidar, up, _YAW_STEP_DEG) for T_world_lidar in poses])
    attempts = yield from _attempts_from(starts, matcher, prediction)
    found = best_of(attempt for attempt in attempts if attempt.is_reliable)
    return found if found is not None or not whole_map else (yield from search_map(matcher, prediction))


def search_map(matcher: ScanMatcher, prediction: Prediction) -> Steps[Attempt | None]:
    """Search anywhere in the map at any yaw; None where no result is reliable, or two places fit equally."""
    local_map = matcher.local_map
    view = BirdsEyeMap.of(local_map.means(), local_map.vertical(), _VIEW_CELLS * local_map.cell_m)
    yield
    points, reach_m = matcher.scan.sweep.compensated(prediction.velocity), _VIEW_RANGES * matcher.scan.range_m
    starts = yield from view.find(points, matcher.last.T_world_lidar, reach_m, _PLACES)
    attempts = yield from _attempts_from(starts, matcher, prediction)
    best = best_of(attempts)
    return best if best is not None and best.is_reliable and best.rival_of(attempts) is None else None


def _attempts_from(starts: FloatArray, matcher: ScanMatcher, prediction: Prediction) -> Steps[list[Attempt]]:
    """Attempts with status ok from the best of the poses (K, 4, 4)."""
    points, rough, attempts = matcher.scan.keypoints.compensated(prediction.velocity), [], []
    for start in (yield from best_starts(points, starts, matcher.local_map)):
        rough.append(matcher.attempt_at(start, prediction, matcher.some(_FEW_POINTS)))
        yield
    least = _LIKELY * max((attempt.quality for attempt in rough), default=0.0)
    for attempt in rough:
        if attempt.quality >= least:
            attempts.append(matcher.attempt_at(attempt.T_world_lidar, prediction))
            yield
    return [attempt for attempt in attempts if attempt.status is Status.OK]


@dataclass(eq=False)
class SpreadSearch:
    """A search that goes on with later scans; its result is carried on to the present scan by the motion since.

    It is no part of a saved state: a new one begins after a resumption.
    """

    begun: Prediction  # of the scan that is searched for
    steps: Steps[Attempt | None] | None  # None: it is done
    found: Attempt | None = None
    is_done: bool = False  # the result was delivered

    def go_on(self, matcher: ScanMatcher, prediction: Prediction) -> Attempt | None:
        """Search until the budget is spent; the present scan, relocalised, if that succeeds."""
        budget, is_later = matcher.budget, prediction.stamp != self.begun.stamp
        if not budget.lets_search_on():
            return None
        if self.steps is not None:
            done = budget.run(self.steps)
            if done is None:
                return None
            (self.found,), self.steps = done, None
            if self.found is not None and is_later and budget.is_spent:
                return None
        self.is_done = True
        if self.found is None or not is_later:
            return self.found
        # By the predicted motion and by the earlier sweep's velocity: without an odometry, a standstill was predicted.
        assert self.found.registration is not None
        predicted = inverse(self.begun.T_world_lidar) @ prediction.T_world_lidar
        moved = exp((prediction.stamp - self.begun.stamp) * self.found.registration.velocity)
        starts = self.found.T_world_lidar @ np.array([predicted, moved])
        matcher = replace(matcher, local_map=self.found.local_map)
        points = matcher.scan.keypoints.compensated(prediction.velocity)
        attempt = matcher.attempt_at(complete(best_starts(points, starts, matcher.local_map))[0], prediction)
        return attempt if attempt.is_reliable else None


class ArchivedMaps(Stateful):
    """The first and the last of the maps that were given up, searched now and then for the sensor's return."""

    _maps: list[LocalMap]
    _scans_until_search: int
    _wait: float

    def __init__(self) -> None:
        self._maps = []
        self._scans_until_search = 0
        self._wait = float(_FIRST_WAIT)
        self._search: SpreadSearch | None = None

    def __len__(self) -> int:
        return len(self._maps)

    def add(self, local_map: LocalMap) -> None:
        """Archive a map that was given up; memory stays bounded."""
        if local_map.scans < _LEAST_SCANS:
            return
        self._maps = [*self._maps[:1], local_map]
        self._wait = float(_FIRST_WAIT)
        self._scans_until_search = _FIRST_WAIT
        self._search = None

    def relocalise(self, matcher: ScanMatcher, prediction: Prediction) -> Attempt | None:
        """Relocalise a scan in the archived maps, the latest first; None when no search is due, or it finds none.

        The map and all archived after it leave the archive.
        """
        self._scans_until_search -= 1
        if self._search is None:
            if not self._maps or self._scans_until_search > 0:
                return None
            self._wait = min(self._wait * _WAIT_GROWTH, _LONGEST_WAIT)
            self._scans_until_search = round(self._wait)
            self._search = SpreadSearch(prediction, self._searching(matcher, prediction))
        attempt = self._search.go_on(matcher, prediction)
        if self._search.is_done:
            self._search = None
        if attempt is not None:
            self._maps = self._maps[: self._maps.index(attempt.local_map)]
        return attempt

    def _searching(self, matcher: ScanMatcher, prediction: Prediction) -> Steps[Attempt | None]:
        for local_map in reversed(self._maps):
            attempt = yield from search_map(replace(matcher, local_map=local_map), prediction)
            if attempt is not None:
                return attempt
        return None


class Tracker(Stateful):
    """Tracks the sensor through one local map after another."""

    tracking: TrackingState
    _archive: ArchivedMaps

    def __init__(self, config: MappingConfig, budget: Budget | None = None) -> None:
        self._config = config
        self._budget = budget or Budget()
        self._search: SpreadSearch | None = None  # that continues with the next scan
        self._map_is_due = False  # whether the next search is one of the whole map
        self.in_vain = False  # whether the last scan ended a search of several scans that found nothing
        self.tracking = TrackingState()
        self._archive = ArchivedMaps()

    @property
    def is_searching(self) -> bool:
        """Whether a search is in progress that continues with the next scan."""
        return self._search is not None

    def begin_at(self, stamp: float, quality: float) -> None:
        """Begin with a scan whose pose was found and whose velocity is known; the next scans must confirm it."""
        begun = self.tracking.registered(Status.OK, relocalised=True, quality=quality, stamp=stamp)
        self.tracking = replace(begun, velocity_known=True, prediction_error_m=0.0)

    def register(
        self, scan: SampledScan, prior: Prior, prediction: Prediction, last: MotionState, local_map: LocalMap
    ) -> Attempt:
        """Register a scan near its prediction, else relocalise it; the status is lost where neither is reliable."""
        is_measured = self.tracking.is_measured and self.tracking.odometry_noise.is_proven(prior)
        state = self.tracking = replace(self.tracking, is_measured=is_measured)
        matcher = ScanMatcher(scan, last, local_map, self._config, self._budget)
        nearby = NearSearch(matcher, state, prior, prediction)
        if state.is_lost and self.is_searching:  # which has all the time of a lost scan
            found = self._found(matcher, prediction)
            self.in_vain = found is None and not self.is_searching
            return found or matcher.none(nearby.continued(prediction))
        uncertain, unconfirmed = state.is_uncertain(scan.stamp - last.stamp), state.is_unconfirmed
        best: Attempt | None
        best = near = nearby.at_prediction() if uncertain else nearby.best()
        if near.status is Status.LOST or ((uncertain or unconfirmed) and not near.is_reliable):
            best = self._relocalise(matcher, near)
        elif near.status is Status.DEGRADED and state.was_degraded:
            found = self._found(matcher, near.prediction, nearby=True)
            best = near if found is None or nearby.contradicts(found) else best_of((near, found))
        elif near.status is Status.OK and not unconfirmed:
            best = self._archive.relocalise(matcher, near.prediction) or near
        # After a relocalisation an improbable motion contradicts that.
        is_improbable = near.has_jumped or nearby.contradicts(near, prior.caution)
        if best is None or (best is near and unconfirmed and is_improbable):
            return replace(near, status=Status.LOST, prediction=nearby.continued(near.prediction))
        return best

    def register_near(
        self, scan: SampledScan, prior: Prior, prediction: Prediction, last: MotionState, local_map: LocalMap
    ) -> Attempt:
        """Register a scan from its prediction alone."""
        matcher = ScanMatcher(scan, last, local_map, self._config, self._budget)
        return NearSearch(matcher, self.tracking, prior, prediction).at_prediction()

    def accept(
        self, attempt: Attempt, scan: SampledScan, prior: Prior, prediction: Prediction, last: MotionState
    ) -> MappedScan:
        """Judge a registration, and update the tracking state with it."""
        registration, jumped, relocalised = attempt.registration, attempt.has_jumped, attempt.relocalised
        assert registration is not None
        is_timed = scan.sweep.times is not None and self._config.continuous_time
        unexpected = not relocalised and self._is_unexpected(attempt, scan, prior, prediction, last)
        if attempt.status is Status.OK or relocalised:
            self._end_search()
        T_world_lidar, velocity, covariance = registration.T_world_lidar, registration.velocity, registration.covariance
        state = MotionState(scan.stamp, T_world_lidar, velocity, covariance, scan.seen_until_s)
        tracking = self.tracking.registered(attempt.status, relocalised, attempt.quality, scan.stamp)
        velocity_known = not (jumped or relocalised)
        if is_timed and velocity_known and tracking.velocity_known and prior.inertial is None:
            state = corrected_by_motion(state, last, scan.seen_from_s, registration.observed)
        motion = inverse(last.T_world_lidar) @ state.T_world_lidar
        if not relocalised:
            tracking = tracking.moved(last, state, motion, prior, self._config)
        tracking = tracking.with_prediction_error(displacement_m(attempt.correction, scan.range_m))
        self.tracking = tracking = replace(tracking, velocity_known=velocity_known)
        if not velocity_known:
            velocity = attempt.uncertain_velocity(scan, last, self._config.continuous_time)
            state = MotionState(scan.stamp, T_world_lidar, velocity, LOST_MOTION)
        # A young map that is not added to would stay one; and in one that ends, as at the next flight of stairs, scans
        # fit ever worse.
        cautious = replace(prior, caution=WEAK_CAUTION)
        fits = attempt.status is Status.OK or attempt.local_map.is_young
        fits = fits or tracking.odometry_noise.agrees(cautious, motion, self._config) is True
        unconfirmed, adrift = tracking.is_unconfirmed, len(self._archive) > 0
        conflict = None if relocalised else tracking.lasting_conflict
        status, message = judge(attempt, unconfirmed, unexpected, adrift, conflict, self._config.tracking)
        return MappedScan(
            state=state,
            T_world_predicted=attempt.prediction.T_world_lidar,
            measured=None if prior.inertial is None else registration.measured,
            registered=True,
            status=status,
            message=message,
            fit=attempt.fit,
            degenerate=tuple(name for name in AXES if name in (*attempt.uncertain, conflict)),
            iterations=registration.iterations,
            added=fits and not jumped and not unconfirmed,
            is_connected=not relocalised,
            elsewhere=attempt.elsewhere,
            turn_rate=registration.velocity[:3] if is_timed and prior.inertial is None else None,
        )

    def lose(self, prediction: Prediction, reason: str, fit: Fit | None = None) -> MappedScan:
        """A scan that was not registered stays at its prediction; without a fit, it has too few points.

        That of a proven odometry keeps its covariance; any other may be far off.
        """
        self.tracking = self.tracking.lost(has_points=fit is not None)
        if not self.tracking.is_measured:
            prediction = replace(prediction, velocity=FADING * prediction.velocity, covariance=LOST_MOTION)
        return MappedScan.lost(prediction, reason, fit)

    @property
    def gives_up(self) -> bool:
        """Whether the scan just lost was one too many, so that a new map must begin."""
        return self.tracking.gives_up and not self.is_searching

    def archive(self, local_map: LocalMap) -> None:
        """Give a map up: another one begins."""
        self._archive.add(local_map)
        self._end_search()
        self.tracking = self.tracking.in_new_map()

    def rewind(self, earlier: TrackingState) -> None:
        """Take the last registration back, but for the observed error of the predictions."""
        self.tracking = replace(earlier, prediction_error_m=self.tracking.prediction_error_m)
        self._end_search()

    def _is_unexpected(
        self, attempt: Attempt, scan: SampledScan, prior: Prior, prediction: Prediction, last: MotionState
    ) -> bool:
        """Whether a pose is improbable by its prediction, and by that of the last motion without an odometry."""
        if not replace(attempt, prediction=prediction).is_unexpected:
            return False
        alone = self.tracking.predict(scan, Prior(inertial=prior.inertial), last, self._config)
        return replace(attempt, prediction=alone).is_unexpected

    def _relocalise(self, matcher: ScanMatcher, near: Attempt) -> Attempt | None:
        """The best of the nearby attempt, a yaw search and, where it is due, a search of the map; None of none.

        The nearby attempt does not count before a search is done.
        """
        sufficient = near.is_reliable if self.tracking.is_unconfirmed else near.fit.inlier_share > _PLAUSIBLE_SHARE
        counts, in_vain = near.status is not Status.LOST and sufficient, self.in_vain
        self.in_vain = False
        if counts and in_vain:
            return near
        found = self._found(matcher, near.prediction)
        follows = self.tracking.is_unconfirmed and near.status is Status.OK
        if found is not None and follows and found.quality < _CLEARLY * near.quality:
            return near
        return best_of(filter(None, (near if counts and not self.is_searching else None, found)))

    def _found(self, matcher: ScanMatcher, prediction: Prediction, nearby: bool = False) -> Attempt | None:
        """The scan, relocalised by the search in progress or a new one; None where that is not finished or fails.

        A place out of reach of the motion since the sensor was tracked is a similar one, and is rejected.
        """
        state = self.tracking
        self._map_is_due |= state.searches_map and not nearby
        if self._search is None:
            self._search = SpreadSearch(prediction, search_nearby(matcher, prediction, self._map_is_due))
            self._map_is_due = False
        found = self._search.go_on(matcher, prediction)
        if self._search.is_done:
            self._search = None
        return found if found and found.is_reachable(state.tracked_s, state.is_measured) else None

    def _end_search(self) -> None:
        self._search = None
        self._map_is_due = self.in_vain = False
