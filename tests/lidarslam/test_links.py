"""Links in a run's work folder lead nowhere: what lies behind them is neither written nor removed."""

import os
import shutil
from pathlib import Path

import pytest

from lidarslam.core.errors import OutputError
from lidarslam.core.files import open_own
from lidarslam.storage.unfinished import Unfinished

from ..conftest import lidarslam, succeeds
from .conftest import FAST, refused

WITH_FILES = (*FAST, "--pose-graph", "--set", "global_map.most_points=2000")


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def unfinished(tmp_path: Path, small_recording: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run with its checkpoint, as a kill before its end leaves it."""
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(Unfinished, "end", lambda *_, **__: None)
        lidarslam("run", small_recording, "--out", out, *WITH_FILES, "--set", "checkpoints.every_scans=2")
    assert {"run.json", "state.npz", "submaps.bin", "tiles.bin"} <= set(content(out / "unfinished"))
    return out


@pytest.mark.parametrize(("name", "link"), [("submaps.bin", os.symlink), ("tiles.bin", os.link)])
def test_a_file_that_is_appended_to_is_no_link(
    unfinished: Path, small_recording: Path, tmp_path: Path, name: str, link: "type[os.symlink]"
) -> None:
    outside = tmp_path / "precious"
    (unfinished / "unfinished" / name).rename(outside)
    with outside.open("ab") as file:
        file.write(b"more")
    before = outside.read_bytes()
    link(outside, unfinished / "unfinished" / name)
    said = refused("run", small_recording, "--out", unfinished, *WITH_FILES, "--resume")
    assert f"{name}: is a link" in said
    assert outside.read_bytes() == before


def test_the_work_folder_is_no_link(unfinished: Path, small_recording: Path, tmp_path: Path) -> None:
    outside = tmp_path / "precious"
    shutil.move(unfinished / "unfinished", outside)
    (outside / ".partial-1-state.npz").write_text("precious too")
    (unfinished / "unfinished").symlink_to(outside)
    before = content(outside)
    said = refused("run", small_recording, "--out", unfinished, *WITH_FILES, "--resume")
    assert "unfinished: is a link to another place; begin again with --overwrite" in said
    assert content(outside) == before
    succeeds("run", small_recording, "--out", unfinished, *WITH_FILES, "--overwrite")
    assert content(outside) == before
    assert not (unfinished / "unfinished").exists()


def test_a_merge_that_replaces_another_leaves_what_its_links_lead_to(
    unfinished: Path, small_recording: Path, tmp_path: Path
) -> None:
    second, out = tmp_path / "second", tmp_path / "merged"
    shutil.copytree(small_recording, second)
    before = content(unfinished / "unfinished")
    for part, target in (("01_room", unfinished), ("02_second/unfinished", unfinished / "unfinished")):
        (out / part).parent.mkdir(parents=True, exist_ok=True)
        (out / part).symlink_to(target)
    command = ("merge", small_recording, second, "--out", out, "--odometry", "constant-velocity", "--overwrite")
    assert "02_second: 6 scans" in lidarslam(*command).stdout
    assert content(unfinished / "unfinished") == before
    assert not (out / "01_room").is_symlink()
    assert not (out / "02_second" / "unfinished").is_symlink()


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
