"""Calls that are carried out in order on a thread of its own, so that the caller need not wait for them."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


class BackgroundWorker:
    """One thread, a bounded queue of calls.

    Args:
        name: of the thread.
        max_pending: calls that may wait; `submit` waits while there are more, to bound the memory they hold.
    """

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
