"""A running graph is optimised at once while it is small, and ever more rarely as it grows."""

import numpy as np

from lidarslam.core.geometry import exp
from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.mapping.pose_graph.optimizer import RelaxSchedule


def closure(second: int, off_m: float, reason: str = "") -> LoopClosure:
    T = exp(np.array([0.0, 0.0, 0.0, off_m, 0.0, 0.0]))
    return LoopClosure(0, second, T, 1e-4 * np.eye(6), 0.9, 0.01, 0.9, False, 2, reason)


def dues(keyframes: range, off_m: float = 1.0, reason: str = "") -> list[int]:
    """The numbers of keyframes at which it is due, with a closure at each."""
    schedule = RelaxSchedule()
    return [n for n in keyframes if schedule.is_due([closure(n - 1, off_m, reason)], [np.eye(4)] * n)]


def test_a_small_graph_is_optimised_at_every_closure_that_contradicts_it():
    assert dues(range(50, 100)) == list(range(50, 100))
    assert dues(range(50, 100), off_m=0.005) == []
    assert dues(range(50, 100), reason="overlap") == []


def test_the_wait_grows_with_the_graph():
    found = dues(range(4000, 4200))
    assert found[0] == 4000
    assert set(np.diff(found).tolist()) <= {41, 42}


def test_a_closure_that_had_to_wait_is_not_forgotten():
    schedule, poses = RelaxSchedule(), [np.eye(4)] * 4100
    assert schedule.is_due([closure(3999, 1.0)], poses[:4000])
    assert not schedule.is_due([closure(4000, 1.0)], poses[:4001])
    due = [n for n in range(4002, 4100) if schedule.is_due([], poses[:n])]
    assert due == [4041]
