"""SIGTERM and SIGHUP, as `kill`, `timeout` and a closed terminal send them, act like Ctrl-C: results are written."""

import contextlib
import signal
import threading
from collections.abc import Iterator

_REQUESTS = (signal.SIGTERM, signal.SIGHUP)


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
