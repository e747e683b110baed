"""Reception for a live run: published topics, messages in a queue of bounded length, IMU samples; rate and latency."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.text import count
from lidarslam.datasets.ros.bag_imu import ACCELERATION, ANGULAR_VELOCITY, imu_numbers
from lidarslam.datasets.ros.bag_message import read_header
from lidarslam.pipeline.imu_stream import ImuStream

logger = logging.getLogger(__name__)

# Discovery of a running system is done within a second or two; after the second span the topics seen are printed.
_SETTLED_S, _PATIENCE_S, _POLL_S = 2.0, 5.0, 0.1
# How long the publisher of an IMU may take to appear, beside that of the clouds.
IMU_WITHIN_S = 5.0
# How long to wait for a message before checking for the end of the run.
_RECEIVE_S = 0.2
# Samples of an IMU that may be queued in a reader: a second of a fast one.
IMU_DEPTH = 1000
# Longest wait of a scan for the samples of its sweep, seconds.
_SWEEP_PATIENCE_S, _STEP_S = 0.05, 0.002
# A stamp this far ahead, seconds, is accepted when this many in a row are.
_FAR_S, _STRAYS = 5.0, 10


@dataclass(frozen=True, order=True)
class PublishedTopic:
    """A published topic of ROS."""

    name: str  # as in ROS, such as /points
    message_type: str  # as in ROS, such as sensor_msgs/msg/PointCloud2
    is_reliable: bool = True  # whether all its publishers send lost messages again


Published = Callable[[], Iterable[PublishedTopic]]
"""The topics that are published now."""


def find_topic(
    published: Published, wanted: str | None, kinds: Collection[str], option: str, within_s: float | None = None
) -> PublishedTopic:
    """Wait for the publisher of a topic of some message types, for a limited time; without a name, for the only one.

    InputError where there are several and none is named, the named one is of another type, or none appeared in time.
    """
    begin, is_told = time.monotonic(), False
    while True:
        topics = list(published())
        waited_s = time.monotonic() - begin
        fitting = [topic for topic in topics if topic.message_type in kinds]
        names = ", ".join(topic.name for topic in fitting)
        for topic in topics:
            if wanted is not None and topic.name.lstrip("/") == wanted.lstrip("/"):
                if topic not in fitting:
                    raise InputError(f"{topic.name}: holds {topic.message_type}, not {' or '.join(kinds)}")
                return topic
        if wanted is None and fitting and waited_s > _SETTLED_S:
            if len(fitting) > 1:
                raise InputError(f"several are published, {names}; choose one with {option}")
            return fitting[0]
        seen = (
            f"waiting for {wanted or ' or '.join(kinds)}; {len(topics)} topics are seen, of that type"
            f" {names or 'none: check ROS_DOMAIN_ID, and the network interface (CYCLONEDDS_URI)'}"
        )
        if within_s is not None and waited_s > within_s:
            raise InputError(f"{within_s:g} s are over, {seen}")
        if waited_s > _PATIENCE_S and not is_told:
            logger.warning(seen)
            is_told = True
        time.sleep(_POLL_S)


@dataclass(frozen=True)
class Received:
    """A message as the middleware delivers it."""

    raw: bytes  # CDR, with its four bytes of encapsulation
    published_ns: int  # when it was published, by the publisher's clock
    arrived_s: float = field(default_factory=time.monotonic)  # when it arrived, by `time.monotonic`


class IncomingQueue:
    """Receives from its beginning to its end; where messages arrive faster than they are taken, some are dropped.

    The message that leaves the shortest gap is dropped: tracking tolerates half the rate better than a second without
    scans. `on_arrival` is called on the thread that receives.
    """

    def __init__(
        self,
        receive: Callable[[float], Iterable[Received]],
        longest: int,
        on_arrival: Callable[[Received], None] = lambda _: None,
    ) -> None:
        self.dropped = 0  # messages
        self.is_ended = False  # whether nothing more is received; messages may still be queued
        self._receive, self._longest, self._on_arrival = receive, longest, on_arrival
        self._waiting: deque[Received] = deque()
        self._taken_ns = 0  # when the last message that was taken was published
        self._changed = threading.Condition()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="receive", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        self._thread.join()

    def end(self) -> None:
        """Receive nothing more; queued messages can still be taken."""
        with self._changed:
            self.is_ended = True
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Received | None:
        """The oldest message in the queue; None when none arrived in time.

        An error of receiving is raised after the messages before it.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self.is_ended, timeout_s)
            if self._waiting:
                message = self._waiting.popleft()
                self._taken_ns = message.published_ns
                return message
            if self._error is not None:
                raise self._error
            return None

    def _run(self) -> None:
        try:
            while not self.is_ended:
                for message in self._receive(_RECEIVE_S):
                    self._add(message)
        except Exception as error:
            self._error = error
            self.end()

    def _add(self, message: Received) -> None:
        self._on_arrival(message)
        with self._changed:
            self._waiting.append(message)
            if len(self._waiting) > self._longest:
                del self._waiting[self._most_dispensable()]
                self.dropped += 1
            self._changed.notify_all()

    def _most_dispensable(self) -> int:
        """Index of the message whose absence leaves the shortest gap: the oldest of equal ones, never the newest."""
        times = [self._taken_ns, *(message.published_ns for message in self._waiting)]
        gaps = [after - before for before, after in zip(times, times[2:], strict=False)]
        return min(range(len(gaps)), key=gaps.__getitem__, default=0)


class ImuReceiver:
    """Gives the messages of an IMU to a stream, on a thread of its own; a context manager."""

    def __init__(self, receive: Callable[[float], Iterable[Received]], stream: ImuStream) -> None:
        self._receive, self.stream = receive, stream
        self._is_ended, self._strays = False, 0
        self._thread = threading.Thread(target=self._run, name="imu", daemon=True)
        self.frame_id: str | None = None  # of the first message

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_ended = True
        self._thread.join()

    def wait_for(self, stamp: float) -> None:
        """Wait for the sample at a stamp of the scans' clock, for 50 ms and the delay of the IMU's clock at most."""
        late_s = self.stream.offset_s
        end = time.monotonic() + _SWEEP_PATIENCE_S + max(0.0, late_s)
        while self.stream.last_s - late_s < stamp and time.monotonic() < end:
            time.sleep(_STEP_S)

    def _run(self) -> None:
        while not self._is_ended:
            for message in self._receive(_POLL_S):
                self._take(message)

    def _take(self, message: Received) -> None:
        """Give a message to the stream; one that is damaged or late is left out, as a gap between samples."""
        try:
            stamp_ns, frame_id = read_header(message.raw, ros2=True)
            numbers = imu_numbers(message.raw, ros2=True)
        except ValueError:
            return
        stamp = (stamp_ns or message.published_ns) / 10**9
        if numbers is None or stamp <= self.stream.last_s or self._is_stray(stamp):
            return
        rates, forces = numbers[ANGULAR_VELOCITY], numbers[ACCELERATION]
        if np.isfinite(rates).all() and np.isfinite(forces).all():
            self.stream.add(stamp, rates, forces)
            self.frame_id = self.frame_id or frame_id

    def _is_stray(self, stamp: float) -> bool:
        """Whether a stamp is an outlier, far ahead of the last one; several in a row mean that the clock was set."""
        self._strays = self._strays + 1 if stamp > self.stream.last_s + _FAR_S else 0
        return np.isfinite(self.stream.last_s) and 0 < self._strays < _STRAYS


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
            (self.missing, "missing between the stamps of those received; net.core.rmem_max bounds the network"),
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
        with self._lock:
            self._arrived.append((stamp_s, arrived_s))

    def registered(self, stamp_s: float, arrived_s: float) -> None:
        since_arrival_s, since_stamp_s = time.monotonic() - arrived_s, time.time() - stamp_s
        with self._lock:
            self._from_arrival.append(since_arrival_s)
            if abs(since_stamp_s) < _SAME_CLOCK_S:
                self._from_stamp.append(since_stamp_s)

    def counts(self, dropped: int) -> LiveCounts:
        """The counts up to now; the queue dropped `dropped` messages."""
        with self._lock:
            stamps, arrivals = np.array(self._arrived).reshape(-1, 2).T
            registered, recent = len(self._from_arrival), arrivals[arrivals > time.monotonic() - _RATE_OVER_S]
            return LiveCounts(
                received=len(arrivals),
                missing=count_missing(stamps, arrivals),
                dropped=dropped,
                registered=registered,
                rate_hz=float((len(recent) - 1) / np.ptp(recent)) if len(recent) > 1 and np.ptp(recent) > 0.0 else 0.0,
                from_arrival=_latency(self._from_arrival),
                from_stamp=_latency(self._from_stamp) if 2 * len(self._from_stamp) > registered else None,
            )


def _latency(seconds: list[float]) -> Latency | None:
    return Latency(*(1e3 * np.quantile(seconds, [0.5, 0.99])).tolist()) if seconds else None


def count_missing(stamps: FloatArray, arrivals: FloatArray) -> int:
    """The number of scans missing in the gaps between stamps (N,), seconds, by their median interval.

    No more than fit into the whole time: a stamp that is late by an interval is followed by a shorter one. A gap that
    is longer by seconds than that between the arrivals (N,) is of an outlier, or of a clock that was set.
    """
    stamps, first = np.unique(stamps, return_index=True)
    steps, waited_s = np.diff(stamps), np.abs(np.diff(arrivals[first]))
    steps = steps[steps < waited_s + _FAR_S]
    if not len(steps):
        return 0
    intervals = steps / np.median(steps)
    in_gaps = np.round(intervals[intervals > _GAP_INTERVALS] - 1.0).sum()
    return int(min(in_gaps, max(0.0, np.round(intervals.sum()) - len(intervals))))
