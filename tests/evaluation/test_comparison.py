"""What comparison.json holds, means over recordings, and intervals of lost tracking."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.comparison.comparison import (
    QUANTITIES,
    Comparison,
    LostInterval,
    MethodResult,
    MethodStatus,
    MissingRecording,
    Published,
    SequenceComparison,
    TableCell,
    TablePlan,
    TableRow,
    lost_intervals,
    mean_table,
)
from lidarslam.evaluation.report.tables import sequence_tables
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory

LOST = MethodResult(
    name="a",
    status="lost",
    message="first lost on scan 1",
    trajectory=Trajectory(10.0 + np.arange(6.0), np.tile(np.eye(4), (6, 1, 1))),
    lost=np.array([False, True, True, False, False, True]),
    lost_reasons=("covered", "kidnapped"),
)


@pytest.fixture
def result() -> MethodResult:
    """150 m, straight on, a metre every tenth of a second; by a method whose metres are one per cent too long."""
    steps = np.zeros((151, 6))
    steps[:, 3] = np.arange(151)
    truth, estimate = (Trajectory(0.1 * np.arange(151), exp(scale * steps)) for scale in (1.0, 1.01))
    found = {"trajectory": estimate, "lost": np.arange(151) < 2, "metrics": evaluate_trajectory(estimate, truth)}
    return MethodResult("kiss-icp", "ok", **found, ms_per_scan_median=20.0, stage_ms={"odometry": 15.0})


def _sequence(name: str, *results: MethodResult) -> SequenceComparison:
    return SequenceComparison(name, f"data/{name}", None, "ground truth", results)


def test_a_method_without_anything_is_null_and_never_0():
    content = MethodResult("kiss-icp", "failed", "aborted (signal 6)").to_json()
    assert content["status"] == "failed"
    assert content["message"] == "aborted (signal 6)"
    absent = ("metrics", "ms_per_scan_median", "ms_per_scan_p95", "lost_scans", "peak_rss_mb", "wall_s", "run")
    assert [content[key] for key in absent] == [None] * len(absent)


def test_one_recording_has_its_own_keys_and_several_a_list(result):
    one = Comparison("t", "c", [_sequence("04", result)], notes=["n"]).to_json()
    assert one["sequence"] == "04"
    assert set(one["methods"]) == {"kiss-icp"}
    assert one["notes"] == ["n"]
    missing = [MissingRecording("06", "data/06", "not there")]
    several = Comparison("t", "c", [_sequence("04", result), _sequence("05", result)], missing=missing)
    content = json.loads(json.dumps(several.to_json(), allow_nan=False))
    assert [sequence["sequence"] for sequence in content["sequences"]] == ["04", "05"]
    assert content["missing"] == [{"sequence": "06", "source": "data/06", "reason": "not there"}]
    assert "methods" not in content


def test_quantities_are_read_off_the_entry(result):
    assert QUANTITIES["kitti_translation_percent"].of(result) == pytest.approx(1.0, abs=0.02)
    assert QUANTITIES["segment_10_translation_percent"].of(result) == pytest.approx(1.0, abs=1e-6)
    assert QUANTITIES["odometry_ms_median"].of(result) == 15.0
    # Errors along a line of 150 m, which is also 150 m long for the truth, are evenly spread from -0.75 to 0.75 m.
    assert QUANTITIES["ate_percent_of_path"].of(result) == pytest.approx(100.0 * 1.5 / 12**0.5 / 150.0, rel=0.02)
    assert QUANTITIES["lost_scans"].of(result) == 2.0
    assert QUANTITIES["map_chamfer_m"].of(result) is None
    assert QUANTITIES["map_entropy"].of(replace(result, map_entropy=-4.5)) == -4.5
    mapped = replace(result, map_metrics={"f_score_percent": {"0.2": 80.0}, "coverage_percent": {"1.0": 90.0}})
    assert QUANTITIES["map_f_score_percent_0.2"].of(mapped) == 80.0
    assert QUANTITIES["map_coverage_percent_1.0"].of(mapped) == 90.0
    assert all(quantity.of(MethodResult("m", "failed")) is None for quantity in QUANTITIES.values())


def _timed(name: str, ms: float | None, status: MethodStatus = "ok") -> MethodResult:
    return MethodResult(name, status, ms_per_scan_median=ms)


def test_means_count_the_recordings_that_have_a_value():
    sequences = [
        _sequence("00", _timed("a", 10.0), _timed("b", 30.0)),
        _sequence("01", _timed("a", 20.0), _timed("b", None, "failed")),
        _sequence("02", _timed("a", 60.0, "lost"), _timed("b", 99.0, "stopped")),
    ]
    published = Published(method="p", values=(1.0, None), source="a paper")
    groups = {"all": ("00", "01", "02", "03"), "01": ("01",)}
    names = ("ms_per_scan_median",)
    plan = TablePlan(title="Time", groups=groups, quantities=names, published=(published,), note="note")
    table = mean_table(plan, sequences)
    assert [column.heading for column in table.columns] == ["all", "01"]
    assert list(table.columns[0].sequences) == ["00", "01", "02", "03"]
    assert [row.method for row in table.rows] == ["a", "b", "p"]
    assert list(table.rows[0].cells) == [TableCell(30.0, 3, "over 3 of 4", ranked=False), TableCell(20.0, 1)]
    assert list(table.rows[1].cells) == [TableCell(30.0, 1, "over 1 of 4", ranked=False), TableCell(None, 0)]
    assert table.rows[2] == TableRow("p", [TableCell(1.0, 4), TableCell(None, 1)], "a paper")
    content = json.loads(json.dumps(table.to_json()))
    assert content["rows"][0]["cells"][0] == {"value": 30.0, "averaged": 3}
    assert content["columns"][0]["sequences"] == ["00", "01", "02", "03"]


def test_a_time_of_the_registration_alone_is_no_best_and_the_note_says_what_it_contains():
    ours = MethodResult("ours", "ok", elapsed_ms_per_scan=30.0, peak_rss_mb=9.0)
    peer = MethodResult("peer", "ok", elapsed_ms_per_scan=10.0, peak_rss_mb=5.0, times_cover="registration")
    third = MethodResult("third", "ok", elapsed_ms_per_scan=40.0, peak_rss_mb=7.0)
    sequence = _sequence("00", ours, peer, third)
    plan = TablePlan(title="T", groups={"all": ("00",)}, quantities=("elapsed_ms_per_scan", "peak_rss_mb"))
    means = mean_table(plan, [sequence])
    tables = sequence_tables(sequence)
    for table in (means, *tables["summary"], *tables["time"]):
        columns = [column.label for column in table.columns]
        best = {(table.rows[row].method, columns[column]) for row, column in table.best()}
        assert best == {("ours", "elapsed"), ("peer", "memory")}
        assert "Times of peer: registration alone, without reading and map" in table.note
    assert peer.to_json()["times_cover"] == "registration"
    memory = plan.model_copy(update={"quantities": ("peak_rss_mb",)})
    assert "registration alone" not in mean_table(memory, [sequence]).note


def test_intervals_have_reasons_and_losses_less_than_a_second_apart_are_one():
    first, second = lost_intervals(LOST)
    assert first == LostInterval(1, 2, 1.0, 2.0, 2, "covered")
    assert second.reason == "kidnapped"
    assert [interval.reason for interval in lost_intervals(replace(LOST, lost_reasons=()))] == [LOST.message] * 2
    fast = Trajectory(0.1 * np.arange(6.0), np.tile(np.eye(4), (6, 1, 1)))
    (interval,) = lost_intervals(replace(LOST, trajectory=fast))
    assert (interval.first, interval.last, interval.scans) == (1, 5, 3)
    assert interval.reason == "covered, and 1 more"
    assert lost_intervals(replace(LOST, lost=np.zeros(6, dtype=np.bool_))) == []
    assert lost_intervals(replace(LOST, trajectory=None)) == []
