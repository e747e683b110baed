"""Links among results lead nowhere: what lies behind them is neither written nor removed."""

import os
from pathlib import Path

import pytest

from lidarslam.core.errors import OutputError
from lidarslam.core.files import open_own

from .conftest import refused


def test_a_file_is_opened_without_following_links(tmp_path: Path) -> None:
    (tmp_path / "outside").write_text("precious")
    (tmp_path / "link").symlink_to(tmp_path / "outside")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    os.link(tmp_path / "outside", tmp_path / "second")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "dangling", "second", "pipe"):
        with pytest.raises(OutputError, match=f"{name}: is a link"):
            open_own(tmp_path / name)
        with open_own(tmp_path / name, anew=True) as file:
            file.write(b"ours")
    assert (tmp_path / "outside").read_text() == "precious"
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize(
    ("link", "source", "method", "option"),
    [
        ("recordings", "simulate: {scans: 2}", "kiss-icp", "--overwrite"),
        ("recordings/walk", "simulate: {scans: 2}", "kiss-icp", "--overwrite"),
        ("walk", "source: recorded", "kiss-slam", "--reuse"),  # not installed
        ("walk", "source: recorded", "constant-velocity+map", "--overwrite"),
        ("walk/constant-velocity+map", "source: recorded", "constant-velocity+map", "--reuse"),
    ],
)
def test_a_comparison_writes_nothing_behind_a_link(
    tmp_path: Path, small_recording: Path, link: str, source: str, method: str, option: str
) -> None:
    place, outside, benchmark = tmp_path / "out" / link, tmp_path / "outside", tmp_path / "benchmark.yaml"
    place.parent.mkdir(parents=True)
    outside.mkdir()
    place.symlink_to(outside)
    recordings = f"[{{name: walk, {source.replace('recorded', str(small_recording))}}}]"
    benchmark.write_text(f"title: t\nmethods: [{method}]\nrecordings: {recordings}\n")
    said = refused("compare", "--benchmark", benchmark, "--out", tmp_path / "out", option)
    assert f"{place}: is a link to another place" in said
    assert not any(outside.iterdir())
