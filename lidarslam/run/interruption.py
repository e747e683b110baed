"""Ctrl-C, and SIGTERM and SIGHUP as `kill`, `timeout` and a closed terminal send them: results are written."""

import contextlib
import logging
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType

logger = logging.getLogger(__name__)

_REQUESTS = (signal.SIGTERM, signal.SIGHUP)
# Requests while results are written: so many, each at least so long after the one before, abandon them. A key that is
# held down or hit repeatedly is one request.
_INSISTENT = 3
_APART_S = 0.5


@contextlib.contextmanager
def ended_like_interrupted() -> Iterator[None]:
    """For the time of the block; a signal that is ignored, as with `nohup`, stays ignored."""
    if threading.current_thread() is not threading.main_thread():  # signals go to the main thread
        yield
        return
    earlier = [(number, signal.getsignal(number)) for number in _REQUESTS]
    taken = [(number, handler) for number, handler in earlier if handler is signal.SIG_DFL]
    for number, _ in taken:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in taken:
            signal.signal(number, handler)


class Interruptions:
    """Requests to end a run: the first ends the scans, by KeyboardInterrupt; then the results are written.

    A context manager. Later requests are answered with a line; only an insistent user abandons the results.
    """

    def __init__(self) -> None:
        self._is_writing = False
        self._insisted, self._last_s = 0, -_APART_S
        self._taken: list[int] = []

    def __enter__(self) -> "Interruptions":
        if threading.current_thread() is threading.main_thread():
            numbers = (signal.SIGINT, *_REQUESTS)
            self._taken = [number for number in numbers if signal.getsignal(number) is signal.default_int_handler]
            for number in self._taken:
                signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number in self._taken:
            signal.signal(number, signal.default_int_handler)

    def protect_results(self) -> None:
        """From here on no request ends anything, unless it is insistent."""
        self._is_writing = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        first, self._is_writing = not self._is_writing, True
        recent, self._last_s = time.monotonic() - self._last_s < _APART_S, time.monotonic()
        if first:
            signal.default_int_handler(number, frame)
        if recent:
            return
        self._insisted += 1
        if self._insisted >= _INSISTENT:
            signal.default_int_handler(number, frame)
        left = _INSISTENT - self._insisted
        with contextlib.suppress(RuntimeError):  # the signal came while a line was written
            logger.warning(
                "the results so far are being written; %s more Ctrl-C, half a second apart, abandon%s them",
                left,
                "s" if left == 1 else "",
            )
