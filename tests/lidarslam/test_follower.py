"""A follower is told everything in order, on another thread, and never falls far behind."""

import threading

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.pipeline import background_worker as follower
from lidarslam.pipeline.background_worker import Behind
from mapping.pose_graph.graph_scan import GraphScan

POINTS = np.zeros((1, 3))


def scan(x: float) -> GraphScan:
    pose = np.eye(4)
    pose[0, 3] = x
    return GraphScan(pose, POINTS, None, None, None, lost=False, belongs_in_map=True)


class Slow:
    """Goes on when it may, and notes what it was told."""

    def __init__(self) -> None:
        self.may = threading.Event()
        self.told: list[str] = []
        self.threads: set[str] = set()

    def draw(self, points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float) -> None:  # noqa: ARG002
        self._note(f"draw {T_world_lidar[0, 3]:.0f}")

    def add(self, scan: GraphScan) -> None:
        self._note(f"add {scan.T_world_lidar[0, 3]:.0f}")

    def _note(self, what: str) -> None:
        assert self.may.wait(10.0)
        self.told.append(what)
        self.threads.add(threading.current_thread().name)


def test_all_is_told_in_order_on_a_thread_of_its_own() -> None:
    slow = Slow()
    behind = Behind(slow)
    for x in range(5):
        behind.add(scan(x))
        behind.draw(POINTS, scan(x).T_world_lidar, 0.1)
    assert not slow.told
    slow.may.set()
    behind.finish()
    assert slow.told == [f"{what} {x}" for x in range(5) for what in ("add", "draw")]
    assert slow.threads == {"graph_0"}


def test_whoever_tells_waits_for_one_that_is_far_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follower, "_MAX_BEHIND", 2)
    slow = Slow()
    behind = Behind(slow)
    behind.add(scan(0))
    behind.add(scan(1))
    third = threading.Thread(target=behind.add, args=(scan(2),))
    third.start()
    third.join(0.2)
    assert third.is_alive()
    slow.may.set()
    third.join(10.0)
    assert not third.is_alive()
    behind.finish()
    assert slow.told == ["add 0", "add 1", "add 2"]


class Failing(Slow):
    def add(self, scan: GraphScan) -> None:  # noqa: ARG002
        raise ValueError("no memory")


@pytest.mark.parametrize("wait", ["catch_up", "finish"])
def test_an_error_of_the_follower_is_raised(wait: str) -> None:
    behind = Behind(Failing())
    behind.add(scan(0))
    with pytest.raises(ValueError, match="no memory"):
        getattr(behind, wait)()
