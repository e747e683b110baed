"""Time stamps of scans: read from text or file names, interpolated where they do not increase."""

import re
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.files import bounded_lines
from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults

# Clock readings count from 1970; a number outside these years is none.
_EPOCH_1990_S, _EPOCH_2100_S = 6.3e8, 4.1e9
# Larger numbers, thousands of years, are not in seconds, and float64 would lose their nanoseconds.
_LATEST_S = 1e11
# Nanoseconds since 1970 overflow 64 bits in the years 1677 and 2262.
_DATE = re.compile(r"((?:19|20)\d{2}-\d{2}-\d{2})[ T](\d{2}:\d{2}:\d{2})(\.\d*)?Z?", re.ASCII)
_SECONDS_NAME = re.compile(r"(.*\D)?(\d+)([._])(\d+)")
_INTEGER_NAME = re.compile(r"(?:.*\D)?(\d{12,19})")
T = TypeVar("T")
# A stamp this far ahead of the one before may be an outlier; this many scans, with it, decide.
_DOUBTFUL_STEP_S, _LOOKED_AT = 1.0, 6
# Among more stamps than this, one that is this many usual steps away from the middle one is an outlier.
_FEW, _FAR_STEPS = 2, 60
# This many scans in a row that are in order among themselves, but before the latest stamp, are no outliers.
_SET_BACK = 10
_NOT_AFTER = "scans were left out: their stamps are not after those of the scans before"
_AHEAD = "scans were left out: their stamps are ahead of those of the scans after"


def read_stamps(path: Path) -> FloatArray:
    """The stamps of a text file, one a line, as (N,) seconds; a blank line, a scan that is missing, is NaN.

    A line is a date and time (taken as UTC), seconds, or an integer count of milli-, micro- or nanoseconds since
    1970. Digits below about 0.2 microseconds are lost in clock readings, as float64 holds no more.
    """
    lines = [line for line in map(str.strip, bounded_lines(path)) if not line.startswith("#")]
    stamps = np.full(len(lines), np.nan)
    for row, line in enumerate(lines):
        if line:
            try:
                stamps[row] = _parse_stamp(line)
            except ValueError:
                raise InputError(
                    f"{path}: expected one stamp a line, got {line[:60]!r} at line {row + 1}; mend it, or move the file"
                    " away to use the rate"
                ) from None
    return stamps


def _parse_stamp(text: str) -> float:
    if match := _DATE.fullmatch(text):
        nanoseconds = (match[3] or "")[:10]
        return float(np.datetime64(f"{match[1]}T{match[2]}{nanoseconds}", "ns").astype(np.int64)) * 1e-9
    seconds = _clock_seconds(int(text)) if text.isdecimal() else None
    if seconds is None:
        seconds = float(text)
    if not abs(seconds) < _LATEST_S:
        raise ValueError(f"{text} is no stamp")
    return seconds


def _clock_seconds(count: int) -> float | None:
    """Seconds of an integer clock reading in ms, us or ns; None when it is none."""
    for units_per_second in (10**3, 10**6, 10**9):
        if _EPOCH_1990_S * units_per_second <= count < _EPOCH_2100_S * units_per_second:
            return count / units_per_second
    return None


def stamps_from_names(stems: Sequence[str]) -> FloatArray | None:
    """Stamps (N,) in seconds that the file names themselves are, or None when any name is none.

    Understood are seconds with decimals (1311868164.36), integer clock readings in milli-, micro- or nanoseconds
    (1311868164360000000), and seconds and nanoseconds with an underscore or a point between
    (cloud_1583836591_182590976); text before readings of a clock since 1970 is left out.
    """
    parts = [_SECONDS_NAME.fullmatch(stem) for stem in stems]
    in_ns = _count_nanoseconds([match[3] + match[4] for match in parts if match])
    stamps = np.array([_stamp_from_name(stem, in_ns) for stem in stems], dtype=np.float64)
    return None if np.isnan(stamps).any() else stamps


def _count_nanoseconds(fractions: Sequence[str]) -> bool:
    """Whether the digits behind seconds are counts of nanoseconds, rather than decimals.

    Decimals have as many digits in every name, or do not end in zeros, which are left out; behind an underscore they
    are not left out.
    """
    widths = {len(fraction) for fraction in fractions}
    ends = any(fraction[0] == "_" or (fraction[-1] == "0" and len(fraction) > 2) for fraction in fractions)
    return len(widths) > 1 and max(widths) <= 10 and ends


def _stamp_from_name(stem: str, in_ns: bool) -> float:
    match = _SECONDS_NAME.fullmatch(stem)
    if match and (match[3] == "." or len(match[4]) <= 9):
        seconds = int(match[2]) + 1e-9 * int(match[4]) if in_ns else float(f"{match[2]}.{match[4]}")
        is_clock = _EPOCH_1990_S <= seconds < _EPOCH_2100_S
        if is_clock or (seconds < _LATEST_S and match[3] == "." and not match[1]):
            return seconds
    match = _INTEGER_NAME.fullmatch(stem)
    return (_clock_seconds(int(match[1])) if match else None) or np.nan


def increasing_rows(stamps: FloatArray) -> FloatArray:
    """Mask (N,) of the largest set of rows whose stamps strictly increase; NaN never belongs to it.

    The longest increasing subsequence, so that one stray stamp, early or late, costs no other row its place.
    """
    tails: list[float] = []
    tail_rows: list[int] = []
    previous = np.full(len(stamps), -1, dtype=np.intp)
    for row, stamp in enumerate(stamps):
        if np.isnan(stamp):
            continue
        place = bisect_left(tails, stamp)
        if place < len(tails) and tails[place] == stamp:
            continue  # of equal stamps the first is kept
        previous[row] = tail_rows[place - 1] if place else -1
        tails[place : place + 1] = [float(stamp)]  # past the end this appends
        tail_rows[place : place + 1] = [row]
    kept = np.zeros(len(stamps), dtype=bool)
    row = tail_rows[-1] if tail_rows else -1
    while row >= 0:
        kept[row] = True
        row = int(previous[row])
    return kept


def mend_stamps(stamps: FloatArray, numbers: FloatArray) -> tuple[FloatArray, int]:
    """The stamps (N,), of which those that are missing or do not increase are replaced, and the number of these.

    They lie on a line over the scans' numbers (N,); ValueError where fewer than two stamps increase.
    """
    kept = increasing_rows(stamps)
    if kept.all():
        return stamps, 0
    if np.count_nonzero(kept) < 2:
        raise ValueError("fewer than two stamps increase")
    known, at = stamps[kept], numbers[kept]
    # Between two good stamps the line keeps the order; outside them it continues at the median rate.
    period = float(np.median(np.diff(known) / np.diff(at)))
    outside = np.minimum(numbers - at[0], 0.0) + np.maximum(numbers - at[-1], 0.0)
    return np.interp(numbers, at, known) + outside * period, int(len(stamps) - np.count_nonzero(kept))


def assumed_rate(missing: str, config: ReaderConfig) -> str:
    """The remark that scans without stamps are assumed to come at a rate, and how to set it unless it was set."""
    said = f"{missing}: {config.rate_hz:g} scans a second are assumed"
    if "rate_hz" in config.model_fields_set:
        return f"{said}, as set."
    return f"{said}, which may be wrong. Give the rate if you know it, such as --set reader.rate_hz=5."


def scan_rate(stamps: FloatArray) -> float | None:
    """Scans a second of increasing stamps (N,), from their median distance; None for fewer than two."""
    return 1.0 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else None


def in_stamp_order(
    items: Iterable[T], stamp_of: Callable[[T], float], faults: Faults, may_be_set_back: bool = False
) -> Iterator[T]:
    """The items whose stamps, in seconds, strictly increase; the others are counted.

    A stamp that jumps ahead is held back until the next few decide between a stray one, which would cost all that
    follow, and a pause. An error of the items' source is raised after the items before it.
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
                raise InputError(
                    f"the stamps run backwards from scan number {number - len(behind)} on, by {latest - behind[0]:.1f}"
                    " s, as if a clock had been set back; run what comes before and after apart, with --stop and"
                    " --start"
                )
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
