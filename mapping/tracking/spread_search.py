"""A search for the place of a scan that may continue with later scans."""

from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.tracking.attempt import Attempt
from lidarslam.mapping.tracking.attempts import ScanMatcher
from lidarslam.mapping.tracking.budget import Budget, Steps


class SpreadSearch:
    """A search in progress, or none; its result is carried on to the present scan by the motion since.

    It is no part of a saved state: a new one begins after a resumption.
    """

    def __init__(self) -> None:
        self._steps: Steps[Attempt | None] | None = None
        self._begun: Prediction | None = None
        self._found: Attempt | None = None

    @property
    def is_under_way(self) -> bool:
        """Whether a search was begun and is not finished."""
        return self._begun is not None

    def begin(self, steps: Steps[Attempt | None], prediction: Prediction) -> None:
        """Begin a search for a scan of this prediction."""
        self._steps, self._begun = steps, prediction

    def drop(self) -> None:
        """End the search without a result."""
        self._steps = self._begun = self._found = None

    def go_on(self, matcher: ScanMatcher, prediction: Prediction, budget: Budget) -> Attempt | None:
        """Search until the budget is spent; the present scan, relocalised, if that succeeds."""
        assert self._begun is not None
        if not budget.lets_search_on():
            return None
        if self._steps is not None:
            done = budget.run(self._steps)
            if done is None:
                return None
            self._found, self._steps = done[0], None
            if self._found is not None and prediction.stamp != self._begun.stamp and budget.is_spent:
                return None
        found, begun = self._found, self._begun
        self.drop()
        if found is None or prediction.stamp == begun.stamp:
            return found
        return matcher.on(found.local_map).relocalise_along(found, begun, prediction)
