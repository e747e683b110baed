"""What is printed at the end of a run."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarslam.pipeline.estimates import STAGES
from lidarslam.run.results import RunOutcome
from lidarslam.run.summary import GraphSummary, LostStretch, Milliseconds, RunSummary, SlowestScan, WrittenMap
from lidarslam.run.summary_text import format_outcome


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
