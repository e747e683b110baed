"""Where a method lost track, and why."""

from dataclasses import replace

import numpy as np

from evaluation.comparison.comparison import MethodResult
from evaluation.trajectory.lost_stretches import lost_stretches
from lidarslam.core.trajectory import Trajectory

LOST = MethodResult(
    name="a",
    status="lost",
    message="first lost on scan 1",
    trajectory=Trajectory(np.arange(6.0), np.tile(np.eye(4), (6, 1, 1))),
    lost=np.array([False, True, True, False, False, True]),
    lost_reasons=("covered", "kidnapped"),
)


def test_every_stretch_has_its_own_reason() -> None:
    first, second = lost_stretches(LOST)
    assert (first.first, first.last, first.scans, first.begin_s, first.end_s) == (1, 2, 2, 1.0, 2.0)
    assert (first.reason, second.reason) == ("covered", "kidnapped")


def test_without_reasons_the_message_has_to_do() -> None:
    assert [stretch.reason for stretch in lost_stretches(replace(LOST, lost_reasons=()))] == [LOST.message] * 2


def test_nothing_lost_is_no_stretch() -> None:
    assert lost_stretches(replace(LOST, lost=np.zeros(6, dtype=np.bool_))) == []
    assert lost_stretches(replace(LOST, trajectory=None)) == []
