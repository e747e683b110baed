"""A run that was killed, wherever, and resumed comes to the results of one that was not."""

import csv
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.trajectory import Trajectory, write_tum
from lidarslam.datasets.folders.scan_files import read_ply
from lidarslam.simulation.imu import MEMS_IMU, sample_imu
from lidarslam.storage.finished_run import load_run

from ..conftest import lidarslam

ROOT = Path(__file__).parents[2]
KILL = signal.SIGKILL
KILLED = -KILL

# Loads the program once, and for every line forks a run of it; told to, that kills itself without further notice as it
# is about to do something to its directory, or at some time. It counts what it does there, and may keep what lies there
# before each of these things, which is what a run that is killed then leaves.
SERVER = """
import json, os, shutil, signal, sys, threading
from pathlib import Path
import lidarslam.viewer.rerun_viewer, lidarslam.run.run, mapping.global_map.point_cloud, mapping.pose_graph.slam_graph
import lidarslam.odometry.methods.learned
from lidarslam.cli import main

EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "fsync"}

def run(order):
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    count, busy = 0, threading.local()

    def see(event, args):
        nonlocal count
        if event not in EVENTS or not (event == "fsync" or str(args[0]).startswith(order["out"])):
            return
        if hasattr(busy, "copying"):
            return
        count += 1
        if order["keep_in"] is not None and os.path.isdir(order["out"]):
            busy.copying = True
            shutil.copytree(order["out"], os.path.join(order["keep_in"], str(count)))
            del busy.copying
        if count == order["kill_at"]:
            os.kill(os.getpid(), order["signal"])

    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.addaudithook(see)
    fsync = os.fsync
    os.fsync = lambda handle: (see("fsync", ()), fsync(handle))[1]
    if order["kill_after_s"] is not None:
        threading.Timer(order["kill_after_s"], lambda: os.kill(os.getpid(), signal.SIGKILL)).start()
    status = 0
    try:
        main(order["arguments"])
    except SystemExit as end:
        status = end.code or 0
    Path(order["log"] + ".count").write_text(str(count))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)

print("ready", flush=True)
for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        run(json.loads(line))
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    status: int
    said: str
    events: int
    seconds: float


Run = Callable[..., Ended]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Runs `lidarslam run SOURCE --out OUT ...`."""
    log = tmp_path_factory.mktemp("log") / "log"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=ROOT,
    )
    assert server.stdin is not None
    assert server.stdout is not None
    assert server.stdout.readline() == "ready\n"

    def run(
        source: Path,
        out: Path,
        *arguments: str,
        kill_at: int | None = None,
        kill_after_s: float | None = None,
        signal: int = KILL,
        keep_in: Path | None = None,
    ) -> Ended:
        order = {
            "arguments": ["run", str(source), "--out", str(out), *arguments],
            "out": str(out),
            "log": str(log),
            "kill_at": kill_at,
            "kill_after_s": kill_after_s,
            "signal": int(signal),
            "keep_in": None if keep_in is None else str(keep_in),
        }
        count = Path(f"{log}.count")
        count.unlink(missing_ok=True)
        server.stdin.write(json.dumps(order) + "\n")
        server.stdin.flush()
        started = time.monotonic()
        status = int(server.stdout.readline())
        events = int(count.read_text()) if count.is_file() else -1
        return Ended(status, log.read_text(), events, time.monotonic() - started)

    yield run
    server.stdin.close()
    server.wait()


SCANS = 34
COVERED = 4
METHODS = {
    "constant velocity": ["--odometry", "constant-velocity", "--stop", "12"],
    "learned": ["--odometry", "learned", "--stop", "10"],
    "odometry alone": ["--odometry", "learned", "--no-mapping", "--stop", "10"],
    "pose graph": [
        "--odometry", "constant-velocity", "--pose-graph", "--set", "pose_graph.keyframes.distance_m=0.2",
        "--set", "pose_graph.loops.min_way_m=0.5", "--loop", "2", "12", "--loop", "3", "33",
    ],
    "imu": [
        "--odometry", "imu", "--pose-graph", "--set", "pose_graph.keyframes.distance_m=0.2",
        "--set", "pose_graph.loops.min_way_m=0.5",
    ],
    "tiles": ["--odometry", "constant-velocity", "--stop", "16", "--set", "global_map.most_points=3000"],
    "kiss-icp": ["--odometry", "kiss-icp", "--no-mapping", "--set", "odometry.kiss_icp.threads=1", "--stop", "12"],
}  # fmt: skip
FAST = [
    "--no-report",
    "--set",
    "checkpoints.every_scans=3",
    "--set",
    "global_map.voxel_size_m=0.1",
    "--set",
    "mapping.keypoints=800",
]


def there_and_back(time: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) at times (N,): a loop through the room in three seconds."""
    phase = 2.0 * np.pi / 3.0 * time
    ways = np.zeros((*phase.shape, 6))
    ways[..., 2], ways[..., 3], ways[..., 4] = 0.3 * np.sin(phase), 1.2 * np.sin(phase), 0.6 * (1.0 - np.cos(phase))
    return exp(np.array([0.0, 0.0, 0.3, -4.0, 0.0, -0.4])) @ exp(ways)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory, room: Any) -> Path:
    """Sweeps of few points along the loop, most with intensity and colour; in one the sensor is covered."""
    folder = tmp_path_factory.mktemp("data") / "room"
    folder.mkdir()
    plain = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("time", "f8")]
    bright = [*plain, ("intensity", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    stamps = 0.1 * np.arange(1, SCANS + 1)
    few = replace(room, points=3000)
    for index, stamp in enumerate(stamps):
        scan = few.sweep(there_and_back, float(stamp))
        table = np.empty(len(scan), dtype=bright if index % 3 else plain)
        table["x"], table["y"], table["z"] = scan.points.T
        table["time"] = scan.time_offsets
        if index % 3:
            table["intensity"], table["red"] = np.linspace(0.0, 1.0, len(scan)), index
            table["green"], table["blue"] = 10 * index % 256, np.arange(len(scan)) % 256
        if index == COVERED:
            table["x"] = np.nan
        np.save(folder / f"{index:06d}.npy", table)
    np.savetxt(folder / "timestamps.txt", stamps, fmt="%.9f")
    write_tum(folder / "ground_truth.tum", Trajectory(stamps, there_and_back(stamps)))
    model = replace(MEMS_IMU, T_lidar_imu=np.eye(4))
    imu = sample_imu(model, there_and_back, 0.0, 0.1 * SCANS + 0.2, seed=1)
    rows = np.column_stack([imu.stamps, imu.angular_velocities, imu.accelerations])
    np.savetxt(folder / "imu.csv", rows, delimiter=",", header="T_lidar_imu: 1 0 0 0 0 1 0 0 0 0 1 0")
    return folder


@dataclass(frozen=True)
class Whole:
    """A run that nobody killed: where it lies, how it ended, and how it was asked for."""

    out: Path
    ended: Ended
    arguments: list[str]


@pytest.fixture(scope="module")
def whole(run: Run, source: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Whole]:
    """The run of each method, made when it is asked for."""
    made: dict[str, Whole] = {}

    def make(method: str) -> Whole:
        if method not in made:
            arguments = [*METHODS[method], *FAST]
            out = tmp_path_factory.mktemp("whole") / "run"
            made[method] = Whole(out, run(source, out, *arguments), arguments)
            assert made[method].ended.status in (0, 3), made[method].ended.said
            assert {"intensity", "red"} <= set(read_ply(out / "map.ply").dtype.names or ())
        return made[method]

    return make


def rows(path: Path) -> list[dict[str, str]]:
    """Of scans.csv, without what differs from run to run."""
    with path.open() as file:
        return [{k: v for k, v in row.items() if not k.startswith("ms_")} for row in csv.DictReader(file)]


def numbers(path: Path) -> dict[str, Any]:
    """Of summary.json, likewise."""
    summary = json.loads(path.read_text())
    for name in (
        "ms_per_scan",
        "slowest_scan",
        "elapsed_s",
        "elapsed_ms_per_scan",
        "latency_ms",
        "realtime_factor",
        "peak_rss_mb",
    ):
        del summary[name]
    if summary["pose_graph"]:
        del summary["pose_graph"]["ms_per_keyframe"]
    summary["warnings"] = [line for line in summary["warnings"] if not line.startswith("the run was resumed")]
    return dict(summary)


def assert_same(out: Path, expected: Path) -> None:
    """See that two runs have the same results, to the last digit."""
    assert sorted(path.name for path in out.iterdir()) == sorted(path.name for path in expected.iterdir())
    for name in ("trajectory.tum", "odometry.tum", "trajectory.kitti", "map.ply", "metrics.json"):
        assert (out / name).read_bytes() == (expected / name).read_bytes(), name
    if (expected / "pose_graph.g2o").exists():
        assert (out / "pose_graph.g2o").read_bytes() == (expected / "pose_graph.g2o").read_bytes()
    for tile in (expected / "map").glob("*"):
        assert (out / "map" / tile.name).read_bytes() == tile.read_bytes(), tile.name
    assert rows(out / "scans.csv") == rows(expected / "scans.csv")
    assert numbers(out / "summary.json") == numbers(expected / "summary.json")


SLOW = ("learned", "odometry alone", "kiss-icp")  # for their odometry; those with --pose-graph show loops


@pytest.mark.long
@pytest.mark.parametrize("method", [pytest.param(m, marks=pytest.mark.slow) if m in SLOW else m for m in METHODS])
def test_a_killed_run_comes_to_the_same_results(
    run: Run, whole: Callable[[str], Whole], source: Path, tmp_path: Path, method: str
) -> None:
    """Killed twice, at a third and at two thirds of all that is done on disk."""
    expected, out = whole(method), tmp_path / "run"
    events = expected.ended.events
    assert run(source, out, *expected.arguments, kill_at=events // 3).status == KILLED
    assert run(source, out, *expected.arguments, "--resume", kill_at=events // 3).status == KILLED
    ended = run(source, out, *expected.arguments, "--resume")
    assert ended.status == expected.ended.status, ended.said
    assert_same(out, expected.out)
    (resumed,) = [line for line in json.loads((out / "summary.json").read_text())["warnings"] if "resumed" in line]
    first, second = map(int, resumed.removeprefix("the run was resumed 2 times, after ").split(" scans")[0].split(", "))
    assert 0 < first < second < SCANS
    assert resumed in ended.said


@pytest.mark.long
def test_the_graph_that_is_resumed_has_loops(whole: Callable[[str], Whole]) -> None:
    """Else the test above would tell nothing about them."""
    assert json.loads((whole("pose graph").out / "summary.json").read_text())["loop_closures"] > 0


def kill_and_resume(run: Run, expected: Whole, source: Path, out: Path, **kill: Any) -> None:
    """Kill a run, resume it until it is done, and see that it is as it should be."""
    ended = run(source, out, *expected.arguments, **kill)
    if ended.status == KILLED:
        go_on(run, expected, source, out)
        return
    assert ended.status == expected.ended.status, ended.said  # it was done before
    assert_same(out, expected.out)


def go_on(run: Run, expected: Whole, source: Path, out: Path) -> None:
    """Go on with what a killed run left, until it is done, and see that it is as it should be."""
    if out.exists() and (out / "unfinished" / "run.json").exists():
        with pytest.raises(InputError, match="did not finish"):
            load_run(out)
        ended = run(source, out, *expected.arguments, "--resume")
    else:  # hardly begun, or just done
        again = () if (out / "summary.json").exists() else ("--overwrite",)
        ended = run(source, out, *expected.arguments, *(again or ("--resume",)))
    assert ended.status == expected.ended.status, ended.said
    leftover = out / "unfinished"
    if leftover.exists():  # killed while it was removed: nothing that anybody would take for a run
        assert not (leftover / "run.json").exists()
        shutil.rmtree(leftover)
    assert_same(out, expected.out)


EVERYWHERE = 24


@pytest.mark.slow  # a run for every different thing that a killed one may leave: a minute
@pytest.mark.parametrize(("method", "every_scans"), [("constant velocity", 3), ("pose graph", 10), ("tiles", 5)])
def test_a_run_may_be_killed_before_anything_it_does_on_disk(
    run: Run, whole: Callable[[str], Whole], source: Path, tmp_path: Path, method: str, every_scans: int
) -> None:
    """What lies there before each of these things is kept of one run, as so many kills would leave it.

    A state is saved three times, each time by the same steps.
    """
    expected, kept = whole(method), tmp_path / "kept"
    expected = replace(expected, arguments=[*expected.arguments, "--set", f"checkpoints.every_scans={every_scans}"])
    kept.mkdir()
    ended = run(source, tmp_path / "run", *expected.arguments, keep_in=kept)
    assert ended.status == expected.ended.status, ended.said
    assert_same(tmp_path / "run", expected.out)
    left = {content(path): path for path in sorted(kept.iterdir(), key=lambda path: int(path.name))}
    assert len(left) > 20
    for out in left.values():
        go_on(run, expected, source, out)
        shutil.rmtree(out)


def content(folder: Path) -> tuple[tuple[str, bytes], ...]:
    """All that lies in a folder."""
    return tuple(
        (str(path.relative_to(folder)), hashlib.sha256(path.read_bytes()).digest() if path.is_file() else b"")
        for path in sorted(folder.rglob("*"))
    )


@pytest.mark.slow  # a fork and two runs for every kill: a minute
@pytest.mark.parametrize("method", METHODS)
def test_a_run_may_be_killed_at_any_time(
    run: Run, whole: Callable[[str], Whole], source: Path, tmp_path: Path, rng: np.random.Generator, method: str
) -> None:
    expected = whole(method)
    for number, delay_s in enumerate(rng.uniform(0.0, 1.2 * expected.ended.seconds, EVERYWHERE)):
        kill_and_resume(run, expected, source, tmp_path / str(number), kill_after_s=float(delay_s))


@pytest.mark.long
@pytest.mark.parametrize("share", [0.55, 0.95])
def test_a_run_may_be_killed_while_it_writes(
    run: Run, whole: Callable[[str], Whole], source: Path, tmp_path: Path, share: float
) -> None:
    """A sample of the slow test above; the last one is killed among its final results."""
    expected = whole("constant velocity")
    kill_and_resume(run, expected, source, tmp_path / "run", kill_at=round(share * expected.ended.events))


@pytest.mark.long
def test_a_run_that_is_stopped_can_be_resumed_as_well(
    run: Run, whole: Callable[[str], Whole], source: Path, tmp_path: Path
) -> None:
    """Ctrl-C comes just as a state is written; what there is can be looked at meanwhile."""
    expected, out = whole("constant velocity"), tmp_path / "run"
    ended = run(source, out, *expected.arguments, kill_at=expected.ended.events // 3, signal=signal.SIGINT)
    assert ended.status == 1
    assert "interrupted; continue with --resume" in ended.said
    scans = len(load_run(out).trajectory)
    assert 0 < scans < 12
    ended = run(source, out, *expected.arguments, "--resume")
    assert ended.status == expected.ended.status, ended.said
    assert "stopped after" not in ended.said
    assert_same(out, expected.out)


@pytest.fixture(scope="module")
def killed_once(
    run: Run, whole: Callable[[str], Whole], source: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The directory of a run that was killed half way."""
    expected, out = whole("constant velocity"), tmp_path_factory.mktemp("killed") / "run"
    assert run(source, out, *expected.arguments, kill_at=expected.ended.events // 3).status == KILLED
    assert (out / "unfinished" / "state.npz").exists()
    return out


@pytest.fixture
def killed(killed_once: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(killed_once, tmp_path / "run"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "lock"}


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--stop", "13"], "stop 12 (now 13)"),
        (["--start", "1"], "start 0 (now 1)"),
        (["--pose-graph"], "pose_graph.enabled False (now True)"),
        (["--mapping", "loam"], "mapping.method surfels (now loam)"),
        (["--odometry", "learned", "--no-mapping"], "mapping.method surfels (now off)"),
        (["--set", "mapping.keypoints=900"], "mapping.keypoints 800 (now 900)"),
        (["--odometry", "learned"], "odometry.method constant-velocity (now learned)"),
    ],
)
def test_another_run_is_not_resumed(
    run: Run, whole: Callable[[str], Whole], source: Path, killed: Path, arguments: list[str], told: str
) -> None:
    before = contents(killed)
    ended = run(source, killed, *whole("constant velocity").arguments, *arguments, "--resume")
    assert ended.status == 1
    assert told in ended.said
    assert ended.said.count("\n") == 1
    assert contents(killed) == before


def test_another_recording_is_not_taken_for_it(
    run: Run, whole: Callable[[str], Whole], source: Path, killed: Path, tmp_path: Path
) -> None:
    arguments = whole("constant velocity").arguments
    other = shutil.copytree(source, tmp_path / "other")
    ended = run(other, killed, *arguments, "--resume")
    assert ended.status == 1
    assert "was begun with source" in ended.said
    about = killed / "unfinished" / "run.json"
    about.write_text(about.read_text().replace(str(source), str(other)))
    (other / "000000.npy").write_bytes((other / "000001.npy").read_bytes())  # it has been dealt with already
    (other / "ground_truth.tum").unlink()
    for path in sorted(other.glob("*.npy"))[1:]:
        table = np.load(path)
        table["x"] += 0.01
        np.save(path, table)
    ended = run(other, killed, *arguments, "--resume")
    assert ended.status == 1
    assert "the recording has changed" in ended.said
    assert ended.said.count("\n") == 1


@pytest.mark.long
@pytest.mark.parametrize("name", ["state.npz", "run.json"])
def test_damage_is_told_in_one_line(
    run: Run, whole: Callable[[str], Whole], source: Path, killed: Path, name: str
) -> None:
    path = killed / "unfinished" / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    arguments = whole("constant velocity").arguments
    ended = run(source, killed, *arguments, "--resume")
    assert ended.status == 1
    assert f"{name}: is damaged" in ended.said
    assert "--overwrite" in ended.said
    assert ended.said.count("\n") == 1
    ended = run(source, killed, *arguments, "--overwrite")
    assert ended.status == whole("constant velocity").ended.status
    assert_same(killed, whole("constant velocity").out)


@pytest.mark.long
def test_a_run_killed_before_its_first_state_begins_again(
    run: Run, whole: Callable[[str], Whole], source: Path, tmp_path: Path
) -> None:
    expected, out = whole("constant velocity"), tmp_path / "run"
    event = 1
    while not (out / "unfinished" / "run.json").exists():
        shutil.rmtree(out, ignore_errors=True)
        event += 1
        assert run(source, out, *expected.arguments, kill_at=event).status == KILLED
    assert not (out / "unfinished" / "state.npz").exists()
    ended = run(source, out, *expected.arguments, "--resume")
    assert "there is no checkpoint yet; the run begins from the start" in ended.said
    assert_same(out, expected.out)


def test_a_killed_run_is_neither_replaced_nor_evaluated_unasked(
    run: Run, whole: Callable[[str], Whole], source: Path, killed: Path
) -> None:
    arguments = whole("constant velocity").arguments
    ended = run(source, killed, *arguments)
    assert ended.status == 1
    assert "holds an unfinished run or merge; replace it with --overwrite" in ended.said
    for command in (["evaluate", str(killed)], ["view", str(killed)], ["view", str(killed), "--picture", "x.png"]):
        result = lidarslam(*command)
        assert result.exit_code == 1
        assert f"did not finish; resume it with lidarslam run {source} --out {killed} --resume" in result.stderr
    whole_run = whole("constant velocity").out
    result = lidarslam("evaluate", whole_run, "--reference", killed)
    assert (result.exit_code, "did not finish" in result.stderr) == (1, True)


@pytest.mark.long
@pytest.mark.parametrize("part", [0.5, 0.9])
def test_what_a_killed_overwrite_was_to_replace_is_given_back(
    run: Run,
    whole: Callable[[str], Whole],
    source: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    part: float,
) -> None:
    """Killed on its way, and among its final results."""
    expected, out = whole("constant velocity"), tmp_path / "run"
    run(source, out, *expected.arguments, "--stop", "6")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    kill_at = int(part * expected.ended.events)
    assert run(source, out, *expected.arguments, "--overwrite", kill_at=kill_at).status == KILLED
    untouched = all((out / name).read_bytes() == content for name, content in before.items())
    assert untouched == (part == 0.5)
    if untouched:
        assert len(load_run(out).trajectory) == 6
        assert lidarslam("evaluate", out).exit_code == 0
        assert caplog.text.count("results of an earlier run") == 1
    else:
        with pytest.raises(InputError, match="did not finish"):
            load_run(out)
    assert run(source, out, *expected.arguments, "--resume").status == expected.ended.status
    assert_same(out, expected.out)


def test_a_finished_run_is_left_as_it_is(run: Run, whole: Callable[[str], Whole], source: Path) -> None:
    expected = whole("constant velocity")
    before = contents(expected.out)
    ended = run(source, expected.out, *expected.arguments, "--resume")
    assert ended.status == expected.ended.status
    assert "is finished already" in ended.said
    other = run(source, expected.out, *expected.arguments, "--stop", "5", "--resume")
    assert other.status == 1
    assert "holds another finished run" in other.said
    assert contents(expected.out) == before


def test_there_must_be_something_to_resume(run: Run, source: Path, tmp_path: Path) -> None:
    ended = run(source, tmp_path / "run", "--resume")
    assert ended.status == 1
    assert "holds no run to resume; leave --resume out to begin one" in ended.said
    assert not (tmp_path / "run").exists()
    ended = run(source, tmp_path / "run", "--resume", "--overwrite")
    assert ended.status == 2


@pytest.mark.long
def test_a_rerun_recording_goes_on_in_a_new_file(
    run: Run, whole: Callable[[str], Whole], source: Path, killed: Path
) -> None:
    ended = run(source, killed, *whole("constant velocity").arguments, "--resume", "--rerun", "save")
    assert ended.status == whole("constant velocity").ended.status
    assert "warning: recording.rrd holds the scans from" in ended.said
    assert (killed / "recording.rrd").stat().st_size > 0
    assert (killed / "trajectory.tum").read_text() == (whole("constant velocity").out / "trajectory.tum").read_text()
