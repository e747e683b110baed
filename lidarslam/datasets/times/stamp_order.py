"""Scans in strictly increasing order of their stamps; stray stamps are left out."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import TypeVar

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.times.stamps import increasing_rows

T = TypeVar("T")

# A stamp so far ahead of the one before may be a stray one; the next scans decide, this many with it.
_DOUBTFUL_STEP_S, _LOOKED_AT = 1.0, 6
# Of more than so many, one that is so many usual steps away from the middle one is a stray one.
_FEW, _FAR_STEPS = 2, 60
# So many scans in a row that are in order among themselves, but before the latest stamp, are no strays.
_SET_BACK = 10

_NOT_AFTER = "scans were left out: their stamps are not after those of the scans before"
_AHEAD = "scans were left out: their stamps are ahead of those of the scans after"


def in_stamp_order(
    items: Iterable[T], stamp_of: Callable[[T], float], faults: Faults, may_be_set_back: bool = False
) -> Iterator[T]:
    """The items whose stamps, in seconds, strictly increase; the others are counted.

    A stamp that jumps ahead is held back until the next few decide between a stray one, which would cost all that
    follow, and a pause. An error of the items' source is raised after the items before it.

    Raises:
        InputError: the clock was set back for good, unless it may be; then all that follow are left out.
    """
    errors: list[Exception] = []
    source = _stamped(items, stamp_of, errors)
    waiting, behind = deque[tuple[float, T]](), list[float]()
    latest, number = -np.inf, 0
    while waiting or (waiting := deque(islice(source, 1))):
        doubtful = waiting[0][0] - latest > _DOUBTFUL_STEP_S
        if doubtful:
            waiting.extend(islice(source, _LOOKED_AT - len(waiting)))
        ahead = np.array([stamp for stamp, _ in waiting])
        stamp, item = waiting.popleft()
        where = f"number {number}, stamped {stamp:.9f}"
        number += 1
        if stamp <= latest:
            faults.leave_out(_NOT_AFTER, f"{where}, after {latest:.9f}")
            behind = [*(behind if behind and stamp > behind[-1] else []), stamp]
            if len(behind) >= _SET_BACK and latest - stamp > _DOUBTFUL_STEP_S and not may_be_set_back:
                raise _set_back(number - len(behind), latest - behind[0])
            continue
        behind = []
        if doubtful and not _leads_on(ahead, latest):
            faults.leave_out(_AHEAD, f"{where}, before {ahead[1]:.9f}")
            continue
        latest = stamp
        yield item
    if errors:
        raise errors[0]


def _stamped(items: Iterable[T], stamp_of: Callable[[T], float], errors: list[Exception]) -> Iterator[tuple[float, T]]:
    """The items with their stamps; an error ends them and is put into the list."""
    try:
        for item in items:
            yield stamp_of(item), item
    except Exception as error:
        errors.append(error)


def _leads_on(ahead: FloatArray, latest: float) -> bool:
    """Whether the first is near most of these stamps, and belongs to the largest set that increases."""
    if len(ahead) > _FEW:
        ordered = np.sort(ahead)
        far_s = _DOUBTFUL_STEP_S + _FAR_STEPS * float(np.median(np.diff(ordered)))
        ahead[np.abs(ahead - ordered[(len(ordered) - 1) // 2]) > far_s] = np.nan
    ahead[ahead <= latest] = np.nan
    return bool(increasing_rows(ahead)[0])


def _set_back(first: int, by_s: float) -> InputError:
    return InputError(
        f"the stamps run backwards from scan number {first} on, by {by_s:.1f} s, as if a clock had been set back; run"
        " what comes before and after apart, with --stop and --start"
    )
