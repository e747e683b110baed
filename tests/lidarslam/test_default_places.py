"""Where results go, and which run is taken, when the command line names no directory."""

import os
import re
from pathlib import Path

import pytest

from lidarslam.core.errors import InputError
from lidarslam.storage import finished_run
from lidarslam.storage.directory import About, Unfinished
from lidarslam.storage.finished_run import latest_run, source_name, unfinished_run

from ..conftest import lidarslam, succeeds
from . import conftest
from .conftest import refused, summary_of

TIME = r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d"
FAST = (*conftest.FAST, "--stop", "3")

pytestmark = pytest.mark.usefixtures("empty_folder")


def only(folder: str) -> Path:
    """The one entry of a folder, by its relative path."""
    (entry,) = Path(folder).iterdir()
    return entry


def finished(name: str, written: int) -> Path:
    """A run directory whose trajectory was written at some time."""
    run = Path("runs") / name
    run.mkdir(parents=True)
    (run / "trajectory.tum").touch()
    os.utime(run / "trajectory.tum", (written, written))
    return run


def unfinished(name: str, source: Path, sequence: str | None = None, **others: str) -> Path:
    """A run directory with the mark of a run that was killed."""
    run = Path("runs") / name
    (run / "unfinished").mkdir(parents=True)
    About({"source": str(source.resolve()), "reader": {"sequence": sequence}, **others}).write(run)
    return run


def test_a_run_is_written_to_a_place_of_its_own_which_is_named_first_and_last(small_recording):
    ran = lidarslam("run", small_recording, *FAST)
    assert ran.exit_code == 0
    out = only("runs")
    assert re.fullmatch(f"room_{TIME}", out.name)
    assert ran.stderr == f"lidarslam: results go to {out}\n"
    assert f"written to {out}\n" in ran.stdout
    assert ran.stdout.endswith(f"next: lidarslam view {out}\n      lidarslam evaluate {out}\n")
    assert summary_of(out)["scans"] == 3


@pytest.mark.parametrize(("source", "sequence", "name"), [
    ("site.v2.mcap", None, "site.v2"), ("site.mcap", "04", "site"), ("drive_0005.sync/", None, "drive_0005.sync"),
    ("KITTI/", "04", "KITTI_04"), ("KITTI/sequences/04/", "04", "04"),
    ("nuscenes/", "scene-0061", "nuscenes_scene-0061"),
    ("evalio_data/hilti_2022/basement_2", None, "hilti_2022_basement_2"),
    ("recordings/office_2026-01-31_12-00-00-2/", None, "office"), ("/", None, "recording"),
])  # fmt: skip
def test_results_bear_the_name_of_the_recording(source, sequence, name):
    for marker in ("KITTI/sequences/04/a.txt", "nuscenes/v1.0-mini/scene.json"):
        Path(marker).parent.mkdir(parents=True)
        Path(marker).touch()
    if source.endswith("/"):
        Path(source).mkdir(parents=True, exist_ok=True)
    assert source_name(Path(source), sequence) == name


@pytest.mark.slow  # four commands
def test_the_other_commands_have_a_place_too(small_recording):
    made = succeeds("simulate", "--world", "hall", "--scans", 2, "--format", "ply")
    recording = only("recordings")
    assert re.fullmatch(f"hall_{TIME}", recording.name)
    assert f"next: lidarslam run {recording}" in made
    succeeds("compare", small_recording, "--methods", "constant-velocity+map")
    assert re.fullmatch(f"room_{TIME}", only("compared").name)
    assert (only("compared") / "report.html").is_file()
    lidarslam("merge", small_recording, recording, "--odometry", "constant-velocity")
    assert re.fullmatch(f"room_{TIME}", only("merged").name)


def test_a_killed_run_is_resumed_without_its_name(small_recording, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(Unfinished, "end", lambda *_, **__: None)  # as if it was killed before
        lidarslam("run", small_recording, *FAST)
    out = only("runs")
    assert About.read(out) is not None
    resumed = lidarslam("run", small_recording, *FAST, "--resume")
    assert (resumed.exit_code, only("runs")) == (0, out)
    assert resumed.stderr.startswith(f"lidarslam: resuming {out}\n")
    assert About.read(out) is None
    assert "resumed once" in (out / "summary.json").read_text()
    again = refused("run", small_recording, *FAST, "--resume")
    assert f"runs: holds no unfinished run of {small_recording}; name one with --out" in again


def test_the_run_to_resume_is_one_of_the_same_recording(empty_folder):
    (empty_folder / "runs").mkdir()
    (empty_folder / "runs" / "notes.txt").touch()
    unfinished("other", empty_folder / "other.mcap")
    unfinished("part", empty_folder / "site.mcap", merge="00_site")
    unfinished("five", empty_folder / "site.mcap", "05")
    damaged = unfinished("damaged", empty_folder / "site.mcap")
    (damaged / "unfinished" / "run.json").write_text("{")
    with pytest.raises(InputError, match=r"runs: holds no unfinished run of site\.mcap"):
        unfinished_run(Path("site.mcap"))
    mine = unfinished("mine", empty_folder / "site.mcap")
    assert unfinished_run(Path("site.mcap")) == mine
    assert unfinished_run(Path("site.mcap"), "05") == Path("runs/five")
    unfinished("twin", empty_folder / "site.mcap")
    with pytest.raises(InputError, match=r"has several unfinished runs \(runs/mine, runs/twin\); name the one"):
        unfinished_run(Path("site.mcap"))


def test_the_latest_run_is_the_one_written_last():
    assert latest_run() is None
    late, _ = finished("a", 2_000), finished("b", 1_000)
    killed = finished("c", 3_000)
    (killed / "unfinished").mkdir()
    About({"source": "x"}).write(killed)
    assert latest_run() == late
    About({"source": "x"}, "stopped").write(killed)
    assert latest_run() == killed


def test_evaluate_and_view_take_the_latest_run(whole_run):
    for command in (["evaluate"], ["view", "--save", "run.rrd"]):
        refused = lidarslam(*command)
        assert refused.exit_code == 2
        assert "name a RUN; runs holds no finished one" in refused.stderr
    finished_run.RUNS.mkdir()
    (finished_run.RUNS / "whole").symlink_to(whole_run)
    evaluated = lidarslam("evaluate", "-o", "metrics.json")
    assert (evaluated.exit_code, evaluated.stderr) == (0, "lidarslam: taking the latest run, runs/whole\n")
    assert evaluated.stdout.endswith("written to metrics.json\nnext: lidarslam view runs/whole\n")
    viewed = lidarslam("view", "--save", "run.rrd")
    assert (viewed.exit_code, viewed.stderr) == (0, "lidarslam: taking the latest run, runs/whole\n")
