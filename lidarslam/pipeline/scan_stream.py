"""Streams of scans: in the order of their stamps, and read ahead on a thread of its own."""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.times.stamps import in_stamp_order

T = TypeVar("T")


def in_order(scans: Iterable[Scan]) -> Iterator[Scan]:
    """The scans whose stamps increase; the others have no place in a trajectory and are not counted."""
    return in_stamp_order(scans, lambda scan: scan.stamp, Faults(), may_be_set_back=True)


def prefetch(items: Iterable[T], ahead: int = 3) -> Iterator[T]:
    """The same items in the same order, up to `ahead` of them read and decoded while the caller is at work.

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
