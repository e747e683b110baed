"""Places that cannot be written, disks that fill up, two writers, requests to end: a line, and no half file."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import OutputError
from lidarslam.core.files import only_writer
from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import read_tum
from lidarslam.storage.directory import FILES, RunDirectory

from ..conftest import lidarslam, succeeds
from .conftest import FAST, files_no_longer_than, refused, summary_of

COMMAND = f"'{sys.executable}' -m lidarslam"


def in_shell(script: str, folder: Path, **changed: str | None) -> "subprocess.CompletedProcess[str]":
    """What it comes to in a folder, with variables of the environment that are changed or absent."""
    path = os.pathsep.join(place for place in sys.path if Path(place).is_absolute())
    env = {key: value for key, value in (os.environ | {"PYTHONPATH": path} | changed).items() if value is not None}
    command = ["bash", "-c", script]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False, timeout=60)


def left_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*")) if folder.exists() else []


@pytest.mark.parametrize(("size", "more"), [
    *((size, ()) for size in (0, 1_200, 4_000, 100_000)), (300, ("--pose-graph",)), (100_000, ("--pcd",)),
    (4_000, ("--set", "global_map.most_points=2000")),
])  # fmt: skip
def test_a_run_on_a_full_disk(tmp_path, small_recording, size, more):
    """The map is 300 kB, the log of the scans 600 bytes, the configuration 3.6 kB."""
    out = tmp_path / "run"
    with files_no_longer_than(size):
        result = lidarslam("run", small_recording, "--out", out, *FAST, *more)
    assert result.exit_code == 1
    said = [line for line in result.stderr.splitlines() if line.startswith("lidarslam: ") and "Rerun: " not in line]
    assert len(said) == 1
    assert str(out) in said[0]
    assert "File too large" in said[0]
    left = left_in(out)
    assert not [name for name in left if name.startswith(".partial")]
    assert "map.ply" not in left
    assert "recording.rrd" not in left
    assert ("summary.json" in left) == ("trajectory.tum" in left), "without a map, all else is there"
    assert "summary.json" in left or more or size < 100_000
    assert not left or "config.yaml" in left, "what is left is a run's, and --overwrite replaces it"
    if "trajectory.tum" in left:
        assert len(read_tum(out / "trajectory.tum")) == 6
    succeeds("run", small_recording, "--out", out, *FAST, "--overwrite")


def test_tiles_that_find_no_room_cost_no_other_result(tmp_path, small_recording, monkeypatch):
    written = []

    def full_after_one(path: Path, *_: object) -> None:
        if written:
            raise OutputError(f"{path.parent}: the .laz map cannot be written there (No space left on device)")
        path.write_bytes(b"a tile")
        written.append(path)

    monkeypatch.setattr("lidarslam.run.results.write_cloud", full_after_one)
    out = tmp_path / "run"
    said = refused("run", small_recording, "--out", out, *FAST, "--set", "global_map.most_points=2000")
    assert "No space left on device" in said
    summary = summary_of(out)
    assert summary["map_tiles"] is None
    assert any("an overview without its tiles" in warning for warning in summary["warnings"])
    assert len(read_tum(out / "trajectory.tum")) == 6
    assert not list(out.rglob("*.laz")), "the room of the tiles is left to the other results"
    assert not (out / "map" / "index.json").exists()


@pytest.mark.parametrize("size", [4_000, 100_000])
def test_results_of_two_runs_are_not_taken_for_one(tmp_path, small_recording, size):
    """Where the disk fills up as a run replaces an earlier one, before it has replaced anything or after."""
    out = tmp_path / "run"
    succeeds("run", small_recording, "--out", out, *FAST)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    again = ("run", small_recording, "--out", out, *FAST, "--start", 1, "--overwrite")
    with files_no_longer_than(size):
        assert lidarslam(*again).exit_code == 1
    is_mixed = before != {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    assert is_mixed == (size == 100_000)
    if is_mixed:
        assert "this run did not finish" in refused("evaluate", out, "--no-report")
    else:
        succeeds("evaluate", out, "--no-report")
    succeeds(*again)
    succeeds("evaluate", out, "--no-report")
    assert summary_of(out)["scans"] == 5


def test_a_recording_of_rerun_that_finds_no_room_costs_itself_alone(tmp_path, small_recording):
    out = tmp_path / "run"
    coarse = ("--set", "global_map.voxel_size_m=0.3")
    command = ("run", small_recording, "--out", out, *FAST, *coarse, "--rerun", "save")
    succeeds(*command)
    sizes = {path.name: path.stat().st_size for path in out.iterdir()}
    room = sizes.pop("recording.rrd") // 2
    assert max(sizes.values()) < room
    with files_no_longer_than(room):
        said = succeeds(*command, "--overwrite")
    (warning,) = [one for one in summary_of(out)["warnings"] if one.startswith("no recording.rrd: ")]
    assert f"warning: {warning}" in said
    assert set(left_in(out)) == set(sizes)


@pytest.mark.parametrize(
    ("command", "sizes"),
    [
        ("evaluate {run} --out {out}/metrics.json", (0, 200)),
        ("evaluate {run} --reference-map {run}/map.ply --out {out}/m.json --errors {out}/e.ply", (0, 3_000)),
        ("view {run} --picture {out}/run.png", (0, 3_000)),
    ],
)
def test_other_outputs_on_a_full_disk(tmp_path, finished_run, command, sizes):
    out = tmp_path / "out"
    out.mkdir()
    for size in sizes:
        with files_no_longer_than(size):
            assert str(out) in refused(*command.format(run=finished_run, out=out).split())
    assert set(left_in(out)) <= {"m.json"}, "the figures of the map fit, and are whole"
    if left_in(out):
        json.loads((out / "m.json").read_text())


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder that not even root may write to")
@pytest.mark.parametrize("command", [
    "run {recording} --odometry constant-velocity --out {place}/run",
    "compare {recording} --methods constant-velocity+map --out {place}/c",
    "simulate --scans 2 --out {place}/s",
    "train {recording} --out {place}/t --steps 1",
    "merge {recording} {run}/.. --reader scan-folder --out {place}/m",
    "evaluate {run} --out {place}/metrics.json",
    "view {run} --save {place}/run.rrd",
    "view {run} --picture {place}/run.png",
])  # fmt: skip
def test_a_folder_that_cannot_be_written(small_recording, finished_run, command):
    for name in ("000000.npy", "000001.npy"):
        shutil.copy(small_recording / name, finished_run.parent)
    said = refused(*command.format(recording=small_recording, run=finished_run, place="/proc/self/task").split())
    assert "/task" in said
    assert "cannot be written" in said


NAMES = ["new\nline \x1b[31mred", os.fsdecode(b"bad\xff"), *(
    pytest.param(name, marks=pytest.mark.slow) for name in ("Größe 测试", "-x", 'it\'s "q" $HOME `x`;rm', "deep/" * 30)
)]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_names_of_every_kind(tmp_path, small_recording, name, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = Path(shutil.copytree(small_recording, tmp_path / "in" / name))
    result = lidarslam("run", source, f"--out={name}", *FAST)
    assert result.exit_code == 0
    assert result.stdout.replace("\n", "").isprintable()
    assert {"summary.json", "map.ply", "config.yaml"} <= set(left_in(tmp_path / name))
    assert summary_of(tmp_path / name)["scans"] == 6
    succeeds("evaluate", f"./{name}", "--no-report")


def test_a_run_inside_its_recording_changes_nothing_of_it(tmp_path, small_recording):
    source = Path(shutil.copytree(small_recording, tmp_path / "room"))
    before = {path: path.read_bytes() for path in source.iterdir()}
    succeeds("run", source, "--out", source / "run", *FAST)
    assert {path: path.read_bytes() for path in source.iterdir() if path.is_file()} == before
    assert "scans         6" in succeeds("info", source)


def test_links_are_replaced_and_never_written_through(tmp_path, small_recording, finished_run):
    outside, names = tmp_path / "outside", [name for name in FILES if "/" not in name]
    outside.mkdir()
    for name in names:
        (outside / name).write_text("precious")
        (finished_run / name).unlink(missing_ok=True)
        if name != "config.yaml":
            (finished_run / name).symlink_to(outside / name)
    (finished_run / "config.yaml").write_text("run:\n")
    (finished_run / "unfinished").symlink_to(outside)
    for name in names:
        (finished_run / f".partial-{os.getpid()}-{name}").symlink_to(outside / name)
    formats = ("--rerun", "save", "--pcd", "--map-format", "laz", "--map-format", "pcd")
    succeeds("run", small_recording, "--out", finished_run, *FAST, *formats, "--overwrite")
    assert {path.name for path in finished_run.glob("map.*")} == {"map.ply", "map.pcd", "map.laz"}
    assert {(outside / name).read_text() for name in names} == {"precious"}
    assert not [name for name in names if (finished_run / name).is_symlink()]
    assert summary_of(finished_run)["scans"] == 6
    succeeds("run", small_recording, "--out", finished_run, *FAST, "--overwrite")
    assert {path.name for path in finished_run.glob("map.*")} == {"map.ply"}


def test_a_summary_cannot_send_merge_to_remove_a_run_elsewhere(tmp_path, small_recording, whole_run):
    shutil.copytree(whole_run, tmp_path, dirs_exist_ok=True)
    out = Path(shutil.copytree(whole_run, tmp_path / "merged"))
    elsewhere = [{"directory": name} for name in ("..", ".", "", "/", "../run", 3, None)]
    (out / "summary.json").write_text(json.dumps({"recordings": elsewhere}))
    again = shutil.copytree(small_recording, tmp_path / "again")
    command = ("merge", small_recording, again, "--out", out, "--odometry", "constant-velocity", "--overwrite")
    assert lidarslam(*command).exit_code in (0, 1)
    assert (out / "01_room").is_dir()
    assert {"config.yaml", "map.ply", "summary.json"} <= {path.name for path in tmp_path.iterdir()}


def test_a_second_writer_is_turned_away(tmp_path, small_recording, finished_run):
    before, compared = {path.name: path.read_bytes() for path in finished_run.iterdir()}, tmp_path / "compared"
    compared.mkdir()
    with only_writer(finished_run), only_writer(compared):
        run = refused("run", small_recording, "--out", finished_run, *FAST, "--overwrite")
        comparison = refused("compare", small_recording, "--methods", "constant-velocity+map", "--out", compared)
    assert "another lidarslam is writing there" in run
    assert "another lidarslam is writing there" in comparison
    assert {path.name: path.read_bytes() for path in finished_run.iterdir()} == before
    with RunDirectory.create(finished_run, overwrite=True):  # the lock is gone with its holder
        pass


@pytest.mark.slow  # a process of its own for each
@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_request_to_end_leaves_what_there_is(tmp_path, room_scans, sent):
    """The recording is a minute long; the request comes in its first seconds."""
    source, out = tmp_path / "room", tmp_path / "run"
    source.mkdir()
    points: FloatArray = room_scans[0].points
    for index in range(2):  # a scan with the points of the one before would be left out
        np.save(source / f"{index:06d}.npy", points[index:])
    for index in range(2, 3_000):
        os.link(source / f"{index % 2:06d}.npy", source / f"{index:06d}.npy")
    often = ["--set", "checkpoints.every_scans=5"]
    command = [sys.executable, "-m", "lidarslam", "run", str(source), "--out", str(out), *FAST, *often]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    begun = time.monotonic()
    while not (out / "unfinished" / "state.npz").exists() and time.monotonic() - begun < 90.0:
        time.sleep(0.05)
    process.send_signal(sent)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 1
    assert said.count("\n") == 1
    assert "stopped after" in said
    assert not [path for path in out.iterdir() if path.name.startswith(".")]
    summary = summary_of(out)
    assert 0 < summary["scans"] < 3_000
    assert any(line.startswith(f"stopped after {summary['scans']} scans") for line in summary["warnings"])
    assert len(read_tum(out / "trajectory.tum")) == summary["scans"]


@pytest.mark.slow  # a process of its own for each
@pytest.mark.parametrize(
    ("redirected", "status"),
    [("| true", 0), (">&-", 0), ("2>&-", 0), ("<&- >&- 2>&-", 0), ("> /dev/full", 1), ("| head -n 1", 0)],
)
def test_standard_streams_that_are_closed_or_full(tmp_path, small_recording, redirected, status):
    ended = in_shell(f"{COMMAND} run '{small_recording}' --out run --odometry constant-velocity {redirected}", tmp_path)
    assert ended.returncode == status
    assert "Traceback" not in ended.stderr
    assert summary_of(tmp_path / "run")["scans"] == 6
    table = (tmp_path / "run" / "scans.csv").read_text().splitlines()
    assert len(table) == 7, "nobody else wrote into it"


@pytest.mark.slow  # a process of its own for each
@pytest.mark.parametrize("changed", [
    {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, {"HOME": None},
    {"HOME": "/proc/self/task"}, {"TMPDIR": "/no/such/folder"}, {"TERM": "dumb", "COLUMNS": "1"},
], ids=" ".join)  # fmt: skip
def test_environments(tmp_path, small_recording, changed):
    source = shutil.copytree(small_recording, tmp_path / "Größe")
    ended = in_shell(f"{COMMAND} run '{source}' --out läuft {' '.join(FAST)} --pose-graph", tmp_path, **changed)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "written to" in ended.stdout
    assert summary_of(tmp_path / "läuft")["scans"] == 6
