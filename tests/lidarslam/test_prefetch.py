"""Reading ahead: the same items, the same errors, and no thread left behind."""

import threading
from collections.abc import Iterator

import pytest

from lidarslam.pipeline.threads import prefetch


def test_items_come_in_order() -> None:
    assert list(prefetch(range(100))) == list(range(100))


def test_an_error_comes_after_the_items_before_it() -> None:
    def items() -> Iterator[int]:
        yield 1
        yield 2
        raise OSError("disk")

    seen = []
    with pytest.raises(OSError, match="disk"):
        for item in prefetch(items()):
            seen.append(item)
    assert seen == [1, 2]


def test_reads_no_further_ahead_than_it_may() -> None:
    made = []

    def items() -> Iterator[int]:
        for item in range(1000):
            made.append(item)
            yield item

    reader = prefetch(items(), ahead=2)
    assert next(reader) == 0
    reader.close()  # type: ignore[attr-defined]
    assert len(made) <= 5


def test_leaving_early_ends_the_thread() -> None:
    reader = prefetch(iter(int, 1))  # endless
    next(reader)
    reader.close()  # type: ignore[attr-defined]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]
