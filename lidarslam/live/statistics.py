"""Rate, latency and losses of a live run."""

import threading
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.text import count

# A stamp farther from this machine's clock is the reading of another one.
_SAME_CLOCK_S = 60.0
_RATE_OVER_S = 5.0
# An interval longer than this many usual ones contains missing scans.
_GAP_INTERVALS = 1.5


class Latency(NamedTuple):
    """Median and 99th percentile, milliseconds."""

    median_ms: float
    p99_ms: float

    def __str__(self) -> str:
        return f"median {self.median_ms:.0f} ms, 99 % under {self.p99_ms:.0f} ms"


@dataclass(frozen=True)
class LiveCounts:
    """Counts of the published scans: received, missing, dropped; their rate and latency."""

    received: int  # messages that arrived
    missing: int  # that did not arrive, by the gaps between the stamps of those that did
    dropped: int  # that arrived and waited too long for registration
    registered: int
    rate_hz: float  # of the messages of the last seconds
    # from_arrival, from_stamp: until the pose was published; from_stamp is None where the stamps are of another clock
    from_arrival: Latency | None
    from_stamp: Latency | None

    def line(self) -> str:
        """A line during the run."""
        latency = "" if self.from_arrival is None else f", latency: {self.from_arrival}"
        lost = f"{self.missing} missing, {self.dropped} dropped"
        return f"{count(self.registered, 'scan')}, {self.rate_hz:.1f} Hz{latency}, {lost}"

    def text(self) -> str:
        """Lines for its end."""
        received = f"{count(self.received, 'message')} received, {self.missing} missing between their stamps"
        latencies = (("arrival", self.from_arrival), ("stamp", self.from_stamp))
        lines = (f"latency from the {of} of a scan to its pose: {ms}" for of, ms in latencies if ms is not None)
        return "\n".join([f"{received}, {self.dropped} dropped because registration was behind", *lines])

    def warnings(self) -> list[str]:
        """Sentences about losses."""
        losses = (
            (
                self.missing,
                "missing between the stamps of those received; net.core.rmem_max bounds the network",
            ),
            (self.dropped, "dropped, as registration was slower than the sensor: take --odometry constant-velocity"),
        )
        return [f"{count(number, 'scan')} {remedy}" for number, remedy in losses if number]


class LiveStatistics:
    """Counts scans; may be called from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._arrived: list[tuple[float, float]] = []  # stamp and arrival of each message
        self._from_arrival: list[float] = []
        self._from_stamp: list[float] = []

    def arrived(self, stamp_s: float, arrived_s: float) -> None:
        """Count a message that has arrived."""
        with self._lock:
            self._arrived.append((stamp_s, arrived_s))

    def registered(self, stamp_s: float, arrived_s: float) -> None:
        """Count a scan whose pose is published."""
        now = time.time()
        with self._lock:
            self._from_arrival.append(now - arrived_s)
            if abs(now - stamp_s) < _SAME_CLOCK_S:
                self._from_stamp.append(now - stamp_s)

    def counts(self, dropped: int) -> LiveCounts:
        """The counts up to now; the queue dropped `dropped` messages."""
        with self._lock:
            stamps, arrivals = np.array(self._arrived).reshape(-1, 2).T
            registered = len(self._from_arrival)
            return LiveCounts(
                received=len(arrivals),
                missing=count_missing(stamps),
                dropped=dropped,
                registered=registered,
                rate_hz=_rate(arrivals),
                from_arrival=_latency(self._from_arrival),
                from_stamp=_latency(self._from_stamp) if 2 * len(self._from_stamp) > registered else None,
            )


def _latency(seconds: list[float]) -> Latency | None:
    return Latency(*(1e3 * np.quantile(seconds, [0.5, 0.99])).tolist()) if seconds else None


def count_missing(stamps: FloatArray) -> int:
    """The number of scans missing in the gaps between stamps (N,), seconds, by their median interval.

    No more than fit into the whole time: a stamp that is late by an interval is followed by a shorter one.
    """
    steps = np.diff(np.unique(stamps))
    if not len(steps):
        return 0
    intervals = steps / np.median(steps)
    in_gaps = np.round(intervals[intervals > _GAP_INTERVALS] - 1.0).sum()
    return int(min(in_gaps, max(0.0, np.round(intervals.sum()) - len(intervals))))


def _rate(arrivals: FloatArray) -> float:
    recent = arrivals[arrivals > time.time() - _RATE_OVER_S]
    return float((len(recent) - 1) / np.ptp(recent)) if len(recent) > 1 and np.ptp(recent) > 0.0 else 0.0
