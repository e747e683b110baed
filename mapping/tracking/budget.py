"""The time that the mapping of a scan may take, and computations that are paused when it is spent."""

import time
from collections.abc import Callable, Generator
from typing import TypeAlias, TypeVar

from lidarslam.mapping.config import BudgetMs

T = TypeVar("T")
Steps: TypeAlias = Generator[None, None, T]
"""A computation that pauses after each step; no step takes longer than a registration."""

# Share of the time between two scans that `auto` is: the odometry needs the other part.
_AUTO_SHARE = 0.5
# A search that continues has this share of the budget at least.
_LEAST_SHARE = 0.2
# The velocity is unknown at first, and nothing waits yet: this many scans are not bounded.
_FREE_SCANS = 2


class Budget:
    """The time of a scan, and whether it is spent; see `BudgetMs`. The clock is in seconds."""

    def __init__(self, budget_ms: BudgetMs = None, clock: Callable[[], float] = time.perf_counter) -> None:
        self._budget_ms = budget_ms
        self._clock = clock
        self._length_s = self._until_s = float("inf")
        self._last_interval_s = float("inf")
        self._scans = 0
        self._was_spent = False  # before a search could continue, at the last scan with one

    @property
    def is_spent(self) -> bool:
        """Whether no further attempt is to begin; false before the first `begin`."""
        return self._clock() >= self._until_s

    def begin(self, interval_s: float) -> None:
        """Begin with a scan, `interval_s` after the one before; a gap between scans makes the budget no larger."""
        self._scans += 1
        if self._budget_ms == "auto":
            self._length_s = _AUTO_SHARE * min(interval_s, self._last_interval_s)
        elif self._budget_ms is not None:
            self._length_s = 1e-3 * self._budget_ms
        self._last_interval_s = interval_s
        self._until_s = self._clock() + self._length_s if self._scans > _FREE_SCANS else float("inf")

    def lets_search_on(self) -> bool:
        """Whether a scan's search may continue; true as well where nothing was left for it at the scan before."""
        self._was_spent = self.is_spent and not self._was_spent
        return not self._was_spent

    def run(self, steps: Steps[T]) -> tuple[T] | None:
        """Continue a computation until it is done or the time is spent; its result, None where it is not done."""
        until_s = self._until_s
        if until_s < float("inf"):
            until_s = max(until_s, self._clock() + _LEAST_SHARE * self._length_s)
        try:
            next(steps)
            while self._clock() < until_s:
                next(steps)
        except StopIteration as end:
            return (end.value,)
        return None


def complete(steps: Steps[T]) -> T:
    """The result of a computation that is not to pause."""
    done = Budget().run(steps)
    assert done is not None
    return done[0]
