"""The demonstration tells the story it promises."""

import pytest

from lidarslam.compare.demo import run_demo


@pytest.mark.slow
def test_the_map_survives_the_turns_that_lose_kiss_icp(tmp_path):
    said: list[str] = []
    (sequence,) = run_demo(tmp_path, 110, said.append).comparison.sequences
    ours, kiss, by_scene = sequence.methods
    assert by_scene.metrics is not None
    assert ours.status == "ok"
    assert ours.metrics.errors.ate_rmse_m < 0.02
    assert kiss.status == "lost"
    assert kiss.metrics.errors.ate_rmse_m > 10.0 * ours.metrics.errors.ate_rmse_m
    names = ["recording.png", "learned+map+graph.png", "kiss-icp.png", "kiss-icp@scene.png"]
    assert all((tmp_path / name).stat().st_size > 10_000 for name in names)
    for name in ("report.html", "report.md", "comparison.json", "demo.rrd"):
        assert (tmp_path / name).stat().st_size > 0
    (text,) = said
    assert "learned+map+graph" in text
    assert "@scene: maximum range 14.1 m instead of 100 m" in text
    assert str(tmp_path / "report.html") in text
