"""What is printed at the end of a run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.pipeline.estimates import STAGES
from lidarslam.run.loop_closing import LoopReport
from lidarslam.run.results import RunOutcome
from lidarslam.run.summary import GraphSummary, LostStretch, Milliseconds, RunSummary, SlowestScan, WrittenMap
from lidarslam.run.summary_text import format_map, format_outcome


def summary_of(graph: GraphSummary | None = None, moved: int = 0) -> RunSummary:
    return RunSummary(
        scans=1,
        length_m=0.0,
        duration_s=0.0,
        elapsed_s=0.1,
        ms_per_scan={"total": Milliseconds(1.0, 1.0, 1.0)},
        latency_ms=Milliseconds(40.0, 80.0, 90.0),
        realtime_factor=None,
        peak_rss_mb=1.0,
        lost=tuple(LostStretch(0, 0, 0.0, 0.0, "too few points") for _ in range(4)),
        degraded_scans=0,
        unconstrained_m=0.0,
        odometry_asked=1,
        graph=graph,
        map=WrittenMap(1, 0.1, moved),
        warnings=(),
    )


def test_one_of_a_thing_is_singular() -> None:
    text = format_outcome(Path("out"), RunOutcome(summary_of(), None))
    for words in ("1 scan, 0.0 m", "map of 1 point, voxels", "LOST on 1 more stretch\n", "lost on 4 of 1 scan;"):
        assert words in text


def test_the_slowest_stage_of_a_scan_is_named_but_not_of_the_first_that_loads_loops() -> None:
    stage_ms = np.full((4, 6), 2.0)
    stage_ms[0], stage_ms[2, STAGES.index("refine")] = 900.0, 77.0
    slowest = SlowestScan.of(stage_ms)
    assert slowest == SlowestScan(2, "refine", 77.0)
    assert SlowestScan.of(stage_ms[:1]) is None
    summary = replace(summary_of(), slowest=slowest)
    words = "latency of one scan: median 40 ms, 99 % under 90 ms; slowest: scan 2, 77 ms of refine\n"
    assert words in format_outcome(Path("out"), RunOutcome(summary, None))
    assert summary.to_json()["slowest_scan"] == {"scan": 2, "stage": "refine", "ms": 77.0}


def test_percentiles_are_of_all_scans() -> None:
    assert Milliseconds.of(np.arange(101.0)) == Milliseconds(50.0, 95.0, 99.0)


def test_what_moved_is_counted() -> None:
    for moved, words in (
        (0, "voxels of 10 cm\n"),
        (1, "voxels of 10 cm; 1 point of moving objects removed\n"),
        (2345, "voxels of 10 cm; 2,345 points of moving objects removed\n"),
    ):
        summary = summary_of(moved=moved)
        assert words in format_outcome(Path("out"), RunOutcome(summary, None))
        assert summary.to_json()["map_points_moved"] == moved


def test_loops_are_counted_and_their_effect_is_said() -> None:
    closure = LoopClosure(0, 5, np.eye(4), np.eye(6), 0.9, 0.01, 0.8, False, 2, "")
    loops = [LoopReport(closure, accepted, (0, 9)) for accepted in (True, False, True)]
    for chosen, words in (
        (loops, "7 keyframes, 2 loops closed, poses corrected by up to 1.23 m (1 candidate rejected;"),
        (loops[:1], "7 keyframes, 1 loop closed, poses corrected by up to 1.23 m\n"),
        ([], "7 keyframes, 0 loops closed\n"),
    ):
        summary = summary_of(GraphSummary(7, 12, tuple(chosen), 1.234, None))
        assert words in format_outcome(Path("out"), RunOutcome(summary, None))
        assert summary.to_json()["loop_closures"] == sum(loop.accepted for loop in chosen)
        assert len(summary.to_json()["pose_graph"]["loops"]) == len(chosen)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (None, " ms per scan; 1 MB of memory"),
        (0.6, " ms per scan, 1.7 times slower than recorded; "),
        (1.02, " ms per scan, as fast as recorded; "),
        (1.7, " ms per scan, 1.7 times faster than recorded; "),
    ],
)
def test_speed_is_faster_or_slower(factor: float | None, words: str) -> None:
    summary = replace(summary_of(), realtime_factor=factor)
    assert words in format_outcome(Path("out"), RunOutcome(summary, None))


@pytest.mark.parametrize(
    ("voxel_m", "words"), [(1.2, "1.2 m"), (0.24, "24 cm"), (0.01, "1 cm"), (0.002, "2 mm"), (0.00005, "0.05 mm")]
)
def test_no_voxel_is_of_0_cm(voxel_m: float, words: str) -> None:
    assert f"voxels of {words};" in format_map(WrittenMap(10, voxel_m, 1))
