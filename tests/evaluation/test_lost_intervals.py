"""Intervals of lost tracking, and their reasons."""

from dataclasses import replace

import numpy as np

from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.comparison.comparison import MethodResult
from lidarslam.evaluation.comparison.lost import lost_intervals

LOST = MethodResult(
    name="a",
    status="lost",
    message="first lost on scan 1",
    trajectory=Trajectory(10.0 + np.arange(6.0), np.tile(np.eye(4), (6, 1, 1))),
    lost=np.array([False, True, True, False, False, True]),
    lost_reasons=("covered", "kidnapped"),
)


def test_every_interval_has_its_own_reason() -> None:
    first, second = lost_intervals(LOST)
    assert (first.first, first.last, first.scans, first.begin_s, first.end_s) == (1, 2, 2, 1.0, 2.0)
    assert (first.reason, second.reason) == ("covered", "kidnapped")


def test_without_reasons_the_message_has_to_do() -> None:
    assert [interval.reason for interval in lost_intervals(replace(LOST, lost_reasons=()))] == [LOST.message] * 2


def test_losses_less_than_a_second_apart_are_one_interval() -> None:
    fast = Trajectory(0.1 * np.arange(6.0), np.tile(np.eye(4), (6, 1, 1)))
    (interval,) = lost_intervals(replace(LOST, trajectory=fast))
    assert (interval.first, interval.last, interval.scans) == (1, 5, 3)
    assert interval.reason == "covered, and 1 more"


def test_nothing_lost_is_no_interval() -> None:
    assert lost_intervals(replace(LOST, lost=np.zeros(6, dtype=np.bool_))) == []
    assert lost_intervals(replace(LOST, trajectory=None)) == []
