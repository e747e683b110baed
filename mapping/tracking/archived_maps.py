"""Archived maps: maps that tracking was lost in, searched now and then for the sensor's return."""

from lidarslam.core.state import Stateful
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.registration.local_map import LocalMap
from lidarslam.mapping.tracking.attempt import Attempt
from lidarslam.mapping.tracking.attempts import ScanMatcher
from lidarslam.mapping.tracking.budget import Budget, Steps
from lidarslam.mapping.tracking.spread_search import SpreadSearch

# A map of fewer scans is not worth a search.
_LEAST_SCANS = 5
# A search takes a second: scans until the first, growth of the intervals, and the longest.
_FIRST_WAIT, _WAIT_GROWTH, _LONGEST_WAIT = 5, 1.5, 60


class ArchivedMaps(Stateful):
    """Keeps the first and the last of the maps that were given up."""

    _maps: list[LocalMap]
    _scans_until_search: int
    _wait: float

    def __init__(self) -> None:
        self._maps = []
        self._scans_until_search = 0
        self._wait = float(_FIRST_WAIT)
        self._search = SpreadSearch()

    def __len__(self) -> int:
        return len(self._maps)

    def add(self, local_map: LocalMap) -> None:
        """Archive a map that was given up; memory stays bounded."""
        if local_map.scans < _LEAST_SCANS:
            return
        self._maps = [*self._maps[:1], local_map]
        self._wait = float(_FIRST_WAIT)
        self._scans_until_search = _FIRST_WAIT
        self._search.drop()

    def relocalise(self, matcher: ScanMatcher, prediction: Prediction, budget: Budget) -> Attempt | None:
        """Relocalise a scan in the archived maps, the latest first; None when no search is due, or it finds none.

        The map and all archived after it leave the archive.
        """
        self._scans_until_search -= 1
        if not self._search.is_under_way:
            if not self._maps or self._scans_until_search > 0:
                return None
            self._wait = min(self._wait * _WAIT_GROWTH, _LONGEST_WAIT)
            self._scans_until_search = round(self._wait)
            self._search.begin(self._searching(matcher, prediction), prediction)
        attempt = self._search.go_on(matcher, prediction, budget)
        if attempt is not None:
            self._maps = self._maps[: self._maps.index(attempt.local_map)]
        return attempt

    def _searching(self, matcher: ScanMatcher, prediction: Prediction) -> Steps[Attempt | None]:
        for local_map in reversed(self._maps):
            attempt = yield from matcher.on(local_map).search_map(prediction)
            if attempt is not None:
                return attempt
        return None
