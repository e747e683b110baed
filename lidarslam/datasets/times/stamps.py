"""Time stamps of scans: read from text or file names, interpolated where they do not increase."""

import re
from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarslam.core.bounded_lines import bounded_lines
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.config import ReaderConfig

# Clock readings count from 1970; a number outside these years is none.
_EPOCH_1990_S, _EPOCH_2100_S = 6.3e8, 4.1e9
# Thousands of years are no time in seconds, and nanoseconds would be lost on them.
_LATEST_S = 1e11
_DATE = re.compile(r"(\d{4}-\d{2}-\d{2})[ T](\d{2}:\d{2}:\d{2}(?:\.\d*)?)Z?", re.ASCII)
_SECONDS_NAME = re.compile(r"\d+\.\d+")
_INTEGER_NAME = re.compile(r"\d{12,19}")
_SECONDS_NANOSECONDS_NAME = re.compile(r"(?:.*\D)?(\d{9,10})_(\d{1,9})")


def read_stamps(path: Path) -> FloatArray:
    """The stamps of a text file, one a line, as (N,) seconds; a blank line, a scan that is missing, is NaN.

    A line is a date and time (taken as UTC), seconds, or an integer count of milli-, micro- or nanoseconds since
    1970. Digits below about 0.2 microseconds are lost in clock readings, as float64 holds no more.

    Raises:
        InputError: the file cannot be read or a line is no stamp.
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
        return float(np.datetime64(f"{match[1]}T{match[2]}", "ns").astype(np.int64)) * 1e-9
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
    (1311868164360000000), and seconds and nanoseconds with an underscore between (cloud_1583836591_182590976).
    """
    stamps = np.array([_stamp_from_name(stem) for stem in stems], dtype=np.float64)
    return None if np.isnan(stamps).any() else stamps


def _stamp_from_name(stem: str) -> float:
    """NaN where it is none."""
    if _SECONDS_NAME.fullmatch(stem):
        return seconds if (seconds := float(stem)) < _LATEST_S else np.nan
    if _INTEGER_NAME.fullmatch(stem):
        return _clock_seconds(int(stem)) or np.nan
    match = _SECONDS_NANOSECONDS_NAME.fullmatch(stem)
    if match and _EPOCH_1990_S <= int(match[1]) < _EPOCH_2100_S:
        return int(match[1]) + int(match[2]) * 1e-9
    return np.nan


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
    """Replace stamps (N,) that are missing or do not increase, on a line over the scans' numbers (N,).

    Returns:
        The strictly increasing stamps and how many were replaced.

    Raises:
        ValueError: fewer than two stamps increase, so that there is no line.
    """
    kept = increasing_rows(stamps)
    if kept.all():
        return stamps, 0
    if np.count_nonzero(kept) < 2:
        raise ValueError("fewer than two stamps increase")
    known, at = stamps[kept], numbers[kept]
    # Between two good stamps the line keeps the order; outside them it goes on at the median rate.
    period = float(np.median(np.diff(known) / np.diff(at)))
    outside = np.minimum(numbers - at[0], 0.0) + np.maximum(numbers - at[-1], 0.0)
    return np.interp(numbers, at, known) + outside * period, int(len(stamps) - np.count_nonzero(kept))


def assumed_rate(missing: str, config: ReaderConfig) -> str:
    """That scans without stamps are taken to come at a rate, and how to give another unless it was given."""
    said = f"{missing}: {config.rate_hz:g} scans a second are assumed"
    if "rate_hz" in config.model_fields_set:
        return f"{said}, as set."
    return f"{said}, which may be wrong. Give the rate if you know it, such as --set reader.rate_hz=5."


def scan_rate(stamps: FloatArray) -> float | None:
    """Scans a second of increasing stamps (N,), from their median distance; None for fewer than two."""
    return 1.0 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else None
