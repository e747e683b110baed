"""What is printed at the end of a run."""

from pathlib import Path

from lidarslam.run import RunOutcome
from lidarslam.summary import LostStretch, Milliseconds, RunSummary
from lidarslam.summary_text import format_outcome


def test_one_of_a_thing_is_singular() -> None:
    summary = RunSummary(
        scans=1,
        length_m=0.0,
        duration_s=0.0,
        elapsed_s=0.1,
        ms_per_scan={"total": Milliseconds(1.0, 1.0)},
        realtime_factor=None,
        peak_rss_mb=1.0,
        lost=tuple(LostStretch(0, 0, 0.0, 0.0, "too few points") for _ in range(4)),
        degraded_scans=0,
        graph=None,
        map_points=1,
        map_voxel_size_m=0.1,
        warnings=(),
    )
    text = format_outcome(Path("out"), RunOutcome(summary, None))
    for words in ("1 scan, 0.0 m", "map of 1 point, one", "LOST on 1 more stretch\n", "lost on 4 of 1 scan;"):
        assert words in text
