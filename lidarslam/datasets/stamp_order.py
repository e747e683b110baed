"""Scans in the order of time, whatever their clock did: stray stamps are left out."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.stamps import increasing_rows

T = TypeVar("T")

# A stamp that far ahead of the one before may be a stray one: the scans after it tell.
_DOUBTFUL_STEP_S = 1.0
# How many scans are looked at to tell.
_LOOKED_AT = 6
# Of more than so many, one that is so many usual steps away from the middle one is a stray one.
_FEW, _FAR_STEPS = 2, 60
# So many scans in a row that are in order among themselves, but before what was reached, are no strays.
_SET_BACK = 10

_NOT_AFTER = "scans were left out: their stamps are not after those of the scans before"
_AHEAD = "scans were left out: their stamps are ahead of those of the scans after"


def in_stamp_order(
    items: Iterable[T], stamp_of: Callable[[T], float], faults: Faults, may_be_set_back: bool = False
) -> Iterator[T]:
    """The items whose stamps, in seconds, strictly increase; the others are counted.

    A stamp that jumps ahead is held back until the next few tell whether it is a stray one, which would cost all
    that follow, or a pause. An error of the items' source is raised after the items before it.

    Raises:
        InputError: the clock was set back for good, unless it may be; then what follows is left out.
    """
    order, waiting, source = _Order(faults, may_be_set_back), deque[tuple[float, T]](), iter(items)
    error: Exception | None = None
    ended = False
    while not ended or waiting:
        if not ended and len(waiting) < (_LOOKED_AT if waiting and order.doubts(waiting[0][0]) else 1):
            try:
                item = next(source)
                waiting.append((stamp_of(item), item))
            except StopIteration:
                ended = True
            except Exception as reason:
                error, ended = reason, True
        elif order.takes([stamp for stamp, _ in waiting]):
            yield waiting.popleft()[1]
        else:
            waiting.popleft()
    if error is not None:
        raise error


class _Order:
    """The stamp reached so far, and those in a row that lie before it."""

    def __init__(self, faults: Faults, may_be_set_back: bool) -> None:
        self._faults = faults
        self._may_be_set_back = may_be_set_back
        self._latest = -np.inf
        self._seen = 0
        self._behind: list[float] = []

    def doubts(self, stamp: float) -> bool:
        """Whether the stamps after this one must tell what becomes of it."""
        return stamp - self._latest > _DOUBTFUL_STEP_S

    def takes(self, stamps: list[float]) -> bool:
        """Whether the first of these stamps is in order; those after it are not judged yet."""
        stamp, where = stamps[0], f"number {self._seen}, stamped {stamps[0]:.9f}"
        self._seen += 1
        if stamp <= self._latest:
            self._faults.leave_out(_NOT_AFTER, f"{where}, after {self._latest:.9f}")
            self._see_behind(stamp)
            return False
        self._behind.clear()
        if self.doubts(stamp) and not self._leads_on(stamps):
            self._faults.leave_out(_AHEAD, f"{where}, before {stamps[1]:.9f}")
            return False
        self._latest = stamp
        return True

    def _leads_on(self, stamps: list[float]) -> bool:
        """Whether the first is near most of these stamps, and belongs to the most that can follow one another."""
        ahead = np.array(stamps)
        if len(ahead) > _FEW:
            ordered = np.sort(ahead)
            far_s = _DOUBTFUL_STEP_S + _FAR_STEPS * float(np.median(np.diff(ordered)))
            ahead[np.abs(ahead - ordered[(len(ordered) - 1) // 2]) > far_s] = np.nan
        ahead[ahead <= self._latest] = np.nan
        return bool(increasing_rows(ahead)[0])

    def _see_behind(self, stamp: float) -> None:
        """Notice a clock that was set back for good."""
        if self._behind and stamp <= self._behind[-1]:
            self._behind.clear()
        self._behind.append(stamp)
        if self._may_be_set_back or len(self._behind) < _SET_BACK or self._latest - stamp <= _DOUBTFUL_STEP_S:
            return
        first = self._seen - len(self._behind)
        raise InputError(
            f"the stamps run backwards from scan number {first} on, by {self._latest - self._behind[0]:.1f} s, as if a"
            " clock had been set back; run what comes before and after apart, with --stop and --start"
        )
