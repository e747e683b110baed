"""Reading ahead, and calls on a thread of their own: in order, bounded, no thread left behind."""

import itertools
import threading

import pytest

from lidarslam.pipeline.threads import BackgroundWorker, prefetch


def test_reads_no_further_ahead_than_it_may_and_leaving_early_ends_the_thread() -> None:
    made = []
    reader = prefetch((made.append(item) for item in itertools.count()), ahead=2)
    next(reader)
    reader.close()  # type: ignore[attr-defined]
    assert len(made) <= 5
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]


class Slow:
    """Goes on when it may, and notes its calls."""

    def __init__(self) -> None:
        self.may = threading.Event()
        self.calls: list[int] = []
        self.threads: set[str] = set()

    def call(self, number: int) -> None:
        assert self.may.wait(10.0)
        self.calls.append(number)
        self.threads.add(threading.current_thread().name)


def test_calls_are_carried_out_in_order_on_a_thread_of_their_own() -> None:
    slow, worker = Slow(), BackgroundWorker("graph", max_pending=20)
    for number in range(10):
        worker.submit(slow.call, number)
    assert not slow.calls
    slow.may.set()
    worker.close()
    assert slow.calls == list(range(10))
    assert slow.threads == {"graph_0"}


def test_the_caller_waits_when_too_many_calls_are_pending() -> None:
    slow, worker = Slow(), BackgroundWorker("graph", max_pending=2)
    worker.submit(slow.call, 0)
    worker.submit(slow.call, 1)
    third = threading.Thread(target=worker.submit, args=(slow.call, 2))
    third.start()
    third.join(0.2)
    assert third.is_alive()
    slow.may.set()
    third.join(10.0)
    assert not third.is_alive()
    worker.close()
    assert slow.calls == [0, 1, 2]


def fail() -> None:
    raise ValueError("no memory")


@pytest.mark.parametrize("wait", ["wait", "close"])
def test_an_error_is_raised(wait: str) -> None:
    worker = BackgroundWorker("graph", max_pending=2)
    worker.submit(fail)
    with pytest.raises(ValueError, match="no memory"):
        getattr(worker, wait)()
