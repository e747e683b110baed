"""Relocalisation: the search for a scan's place at any yaw, anywhere in the map, and in the maps it was lost in."""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.core.state import Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.registration.local_map import LocalMap
from lidarslam.mapping.tracking.birds_eye_map import BirdsEyeMap
from lidarslam.mapping.tracking.budget import Steps, complete
from lidarslam.mapping.tracking.mapped_scan import Attempt, best_of
from lidarslam.mapping.tracking.scan_matcher import ScanMatcher, best_starts, turned_poses

_YAW_STEP_DEG = 15.0
# Radius of a scan's bird's-eye view in median ranges, its cell in cells of the map, and the places that are tried.
_VIEW_RANGES, _VIEW_CELLS, _PLACES = 3.0, 4.0, 24
# Points that are registered first from a pose found by search, and the share of the best quality above which all are.
_FEW_POINTS, _LIKELY = 800, 0.5
# An archived map of fewer scans is not worth a search.
_LEAST_SCANS = 5
# A search takes a second: scans until the first, growth of the intervals, and the longest.
_FIRST_WAIT, _WAIT_GROWTH, _LONGEST_WAIT = 5, 1.5, 60


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
