"""Which runs there are, and how they are judged."""

import numpy as np
import pytest
from real_starts import DEFAULT_METHODS, METHODS, OPTIONS, Ended, Judged, judge, length_error, row, starts_of

from lidarslam.commands.runs import run
from lidarslam.core.geometry import make_transform
from lidarslam.core.trajectory import Trajectory


def _straight(speed_mps: float, scans: int = 21) -> Trajectory:
    stamps = 0.1 * np.arange(scans)
    return Trajectory(stamps, make_transform(np.eye(3), stamps[:, None] * np.array([speed_mps, 0.0, 0.0])))


def _judged(start: int, ate_m: float | None, length_percent: float | None, status: int = 0) -> Judged:
    return Judged(start, 50, ate_m, length_percent, 0, 1, status)


@pytest.mark.parametrize("method", OPTIONS)
def test_our_methods_are_runs_of_the_program(method: str) -> None:
    context = run.make_context("run", ["recording", "--out", "run", *OPTIONS[method]])
    assert (context.params["mapping"] == "loam") == method.endswith("+loam")
    assert set(DEFAULT_METHODS) <= set(METHODS)


def test_runs_near_the_end_are_as_short_as_half_of_what_is_wanted() -> None:
    runs = starts_of(scans=100, every=10, wanted=50, step=1)
    assert [run.start for run in runs] == [0, 10, 20, 30, 40, 50, 60, 70]
    assert [len(run) for run in runs] == [50] * 6 + [40, 30]


def test_a_run_of_every_third_scan_has_as_many_scans_and_a_short_recording_one_run() -> None:
    assert starts_of(scans=400, every=200, wanted=50, step=3) == [range(0, 150, 3), range(200, 350, 3)]
    assert starts_of(scans=12, every=10, wanted=50, step=1) == [range(12)]


@pytest.mark.parametrize(("found_mps", "true_mps"), [(55.0, 50.0), (0.5, 0.0)], ids=["too long", "standing"])
def test_an_error_of_the_length_is_in_percent_of_the_true_or_the_shortest_one(found_mps, true_mps) -> None:
    assert length_error(_straight(found_mps), _straight(true_mps)) == pytest.approx(10.0)


def test_without_truth_there_is_no_ate_but_a_length() -> None:
    judged = judge(Ended(_straight(4.5), 0, 0, 0), range(21), None, _straight(5.0))
    assert judged.ate_m is None
    assert judged.length_error_percent == pytest.approx(-10.0)


def test_a_run_without_a_trajectory_is_the_worst_one() -> None:
    judged = judge(Ended(None, None, None, 1, "it died"), range(40, 60), _straight(5.0), _straight(5.0))
    cells = row("drive", "CT-ICP", 1, [_judged(0, 0.5, 1.0), judged])
    assert cells[3:7] == ["2", "0.500", "0.500", "40"]


def test_only_runs_that_end_ok_can_be_ok_but_wrong() -> None:
    runs = [_judged(0, 0.1, -3.5), _judged(10, 0.2, 50.0, status=3), _judged(20, 0.1, 2.0)]
    cells = row("drive", "learned+map", 1, runs)
    assert cells[-2:] == ["2", "1"]
    assert cells[6:8] == ["10", "+50.0"]
