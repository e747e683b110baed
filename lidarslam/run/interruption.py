"""Ctrl-C, and SIGTERM and SIGHUP as `kill`, `timeout` and a closed terminal send them: results are written."""

import contextlib
import logging
import os
import signal
import threading
import time
import weakref
from collections.abc import Callable, Container, Iterator
from types import FrameType
from typing import Any

logger = logging.getLogger(__name__)

_REQUESTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Requests while results are written: this many, each at least this long after the last, abandon them. A key that is
# held down or hit repeatedly is one request.
_INSISTENT = 3
_APART_S = 0.5
# A request that arrives in a finaliser is handled after this time.
_AFTER_FINALISER_S = 0.05


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, as a handler of signals; where Python would drop it, a moment later.

    Exceptions of finalisers (`__del__`, callbacks of weak references) are printed and forgotten, requests to end among
    them.
    """
    if not _is_postponed(number, frame):
        signal.default_int_handler(number, frame)


def _is_postponed(number: int, frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_name == "__del__" or frame.f_code.co_filename == weakref.__file__:
            again = threading.Timer(_AFTER_FINALISER_S, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()
            return True
        frame = frame.f_back
    return False


@contextlib.contextmanager
def handling(handle: Callable[[int, FrameType | None], Any], replaced: Container[Any] | None = None) -> Iterator[None]:
    """Handle requests to end during the block, in place of these handlers, or of any.

    A signal that is ignored, as with `nohup`, stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():  # signals go to the main thread
        yield
        return
    earlier = {number: signal.getsignal(number) for number in _REQUESTS}
    taken = {
        number: handler
        for number, handler in earlier.items()
        if handler is not signal.SIG_IGN and (replaced is None or handler in replaced)
    }
    for number in taken:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in taken.items():
            signal.signal(number, handler)


def ended_like_interrupted() -> contextlib.AbstractContextManager[None]:
    """During the block, all requests raise KeyboardInterrupt."""
    return handling(interrupt, (signal.SIG_DFL, signal.default_int_handler))  # of a program that does not handle them


class Interruptions:
    """Requests to end a run: the first ends the scans, by KeyboardInterrupt; then the results are written.

    A context manager. A second request does not wait where the run still saves its state. Later ones are answered with
    a line; only an insistent user abandons the results.
    """

    def __init__(self) -> None:
        # Whether the run saves its state and ends by itself where `is_requested`, and whether it is.
        self.takes_requests = self.is_requested = self._is_writing = False
        self._insisted, self._last_s = 0, -_APART_S
        self._handling = handling(self._handle, (interrupt, signal.default_int_handler))

    def __enter__(self) -> "Interruptions":
        self._handling.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._handling.__exit__(None, None, None)

    def protect_results(self) -> None:
        """From here on no request ends anything, unless it is insistent."""
        self._is_writing = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if _is_postponed(number, frame):
            return
        recent, self._last_s = time.monotonic() - self._last_s < _APART_S, time.monotonic()
        if self.takes_requests and not self._is_writing and (recent or not self.is_requested):
            self.is_requested = True
            return
        first, self._is_writing = not self._is_writing, True
        if first:
            signal.default_int_handler(number, frame)
        if recent:
            return
        self._insisted += 1
        if self._insisted >= _INSISTENT:
            signal.default_int_handler(number, frame)
        left = _INSISTENT - self._insisted
        with contextlib.suppress(RuntimeError):  # the signal arrived while a line was written
            logger.warning(
                "the results so far are being written; %s more Ctrl-C, half a second apart, abandon%s them",
                left,
                "s" if left == 1 else "",
            )
