"""Messages on their way to registration: received on a thread of their own, in a queue of bounded length."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Self

_POLL_S = 0.2


@dataclass(frozen=True)
class Received:
    """A message as the middleware gives it."""

    raw: bytes  # CDR, with its four bytes of encapsulation
    published_ns: int  # when it was published, by the publisher's clock


@dataclass(frozen=True)
class Arrived(Received):
    """A message with its time of arrival."""

    arrived_s: float  # when it came, by this machine's clock


class IncomingQueue:
    """Receives from its beginning to its end; where messages come faster than they are taken, some are dropped.

    Dropped is what leaves the shortest gap: tracking bears half the rate better than a second without scans.

    Attributes:
        dropped: number of messages that were dropped.
        is_ended: whether nothing more is received; messages may wait still.

    Args:
        receive: the next messages, waiting for so many seconds at most.
        longest: number of messages that may wait.
        on_arrival: called on the thread that receives, with each message.
    """

    def __init__(
        self,
        receive: Callable[[float], Iterable[Received]],
        longest: int,
        on_arrival: Callable[[Arrived], None] = lambda _: None,
    ) -> None:
        self.dropped = 0
        self.is_ended = False
        self._receive = receive
        self._on_arrival = on_arrival
        self._waiting: deque[Arrived] = deque()
        self._longest = longest
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
        """Receive nothing more; what waits can still be taken."""
        with self._changed:
            self.is_ended = True
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Arrived | None:
        """The oldest message that waits; None when none came in time.

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
                for message in self._receive(_POLL_S):
                    self._add(Arrived(message.raw, message.published_ns, time.time()))
        except Exception as error:
            self._error = error
            self.end()

    def _add(self, message: Arrived) -> None:
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
