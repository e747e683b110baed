"""Helper threads of the pipeline: scans are read ahead, calls carried out in order, free memory returned."""

import ctypes
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.times.stamps import in_stamp_order

T = TypeVar("T")


def in_order(scans: Iterable[Scan]) -> Iterator[Scan]:
    """The scans whose stamps increase; the others have no place in a trajectory and are not counted."""
    return in_stamp_order(scans, lambda scan: scan.stamp, Faults(), may_be_set_back=True)


def prefetch(items: Iterable[T], ahead: int = 3) -> Iterator[T]:
    """The same items in the same order, up to `ahead` of them read and decoded while the caller works.

    An exception of the source is raised here, after the items that came before it. Closing the iterator ends the
    thread.
    """
    source, end = iter(items), object()
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch")
    try:
        pending = deque(pool.submit(next, source, end) for _ in range(ahead))
        while (item := pending.popleft().result()) is not end:
            pending.append(pool.submit(next, source, end))
            yield item  # type: ignore[misc]
    finally:
        pool.shutdown(cancel_futures=True)


class BackgroundWorker:
    """One thread, and a queue of calls; `submit` waits while more than `max_pending` do, to bound their memory."""

    def __init__(self, name: str, max_pending: int) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
        self._pending: deque[Future[Any]] = deque()
        self._max_pending = max_pending

    def submit(self, call: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Queue a call, which will have a result; an error of an earlier one may be raised here."""
        future = self._pool.submit(call, *arguments)
        self._pending.append(future)
        while len(self._pending) > self._max_pending:
            self._pending.popleft().result()
        return future

    def wait(self) -> None:
        """Wait until all calls are done, and raise the first error among them."""
        while self._pending:
            self._pending.popleft().result()

    def close(self) -> None:
        """Wait for all calls and end the thread."""
        try:
            self.wait()
        finally:
            self._pool.shutdown(cancel_futures=True)


# Scans between two returns, which take some milliseconds.
EVERY_SCANS = 100


def return_free_memory() -> None:
    """Return all pages without a block in use; does nothing where the C library cannot."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's alone
    if trim is not None:
        trim(0)
