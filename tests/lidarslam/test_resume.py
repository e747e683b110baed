"""A run that was killed, wherever, and resumed comes to the results of one that was not."""

import csv
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import write_tum

ROOT = Path(__file__).parents[2]
KILLED = -signal.SIGKILL

# Loads the program once, and for every line forks a run of it; told to, that kills itself without further notice as it
# is about to do something to its directory, or at some time. It counts what it does there.
SERVER = """
import json, os, signal, sys, threading
from pathlib import Path
import lidarslam.rerun_viewer, lidarslam.run, mapping.map_io, mapping.slam_graph, odometry.learned
from lidarslam.cli import main

EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "fsync"}

def run(order):
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    count = 0

    def see(event, args):
        nonlocal count
        if event not in EVENTS or not (event == "fsync" or str(args[0]).startswith(order["out"])):
            return
        count += 1
        if count == order["kill_at"]:
            os.kill(os.getpid(), signal.SIGKILL)

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
        source: Path, out: Path, *arguments: str, kill_at: int | None = None, kill_after_s: float | None = None
    ) -> Ended:
        order = {
            "arguments": ["run", str(source), "--out", str(out), *arguments],
            "out": str(out),
            "log": str(log),
            "kill_at": kill_at,
            "kill_after_s": kill_after_s,
        }
        count = Path(f"{log}.count")
        count.unlink(missing_ok=True)
        server.stdin.write(json.dumps(order) + "\n")
        server.stdin.flush()
        status = int(server.stdout.readline())
        return Ended(status, log.read_text(), int(count.read_text()) if count.is_file() else -1)

    yield run
    server.stdin.close()
    server.wait()


SCANS = 20
METHODS = {
    "constant velocity": ["--odometry", "constant-velocity"],
    "learned": ["--odometry", "learned"],
    "odometry alone": ["--odometry", "learned", "--no-mapping"],
    "pose graph": [
        "--odometry", "constant-velocity", "--pose-graph", "--set", "pose_graph.keyframes.distance_m=0.2",
        "--set", "pose_graph.loops.min_way_m=0.5", "--set", "pose_graph.loops.min_way_ranges=0",
        "--set", "pose_graph.loops.alone_ranges=100",
    ],
    "kiss-icp": ["--odometry", "kiss-icp", "--no-mapping", "--set", "odometry.kiss_icp.threads=1"],
}  # fmt: skip
FAST = ["--set", "checkpoints.every_scans=3", "--set", "global_map.voxel_size_m=0.1", "--set", "mapping.keypoints=800"]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory, room_scans: list[Scan], room_truth: Trajectory) -> Path:
    """The drive through the room, thinned to a third; one scan is of a covered sensor, and one goes back in time."""
    folder = tmp_path_factory.mktemp("data") / "room"
    folder.mkdir()
    fields = np.dtype([("x", "f8"), ("y", "f8"), ("z", "f8"), ("time", "f8")])
    for index, scan in enumerate(room_scans[:SCANS]):
        thin = scan.select(np.arange(0, len(scan), 3))
        table = np.empty(len(thin), dtype=fields)
        table["x"], table["y"], table["z"] = thin.points.T
        table["time"] = thin.time_offsets
        if index == 9:
            table["x"] = np.nan
        np.save(folder / f"{index:06d}.npy", table)
    np.savetxt(folder / "timestamps.txt", room_truth.stamps[:SCANS], fmt="%.9f")
    write_tum(folder / "ground_truth.tum", room_truth)
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
        return made[method]

    return make


def rows(path: Path) -> list[dict[str, str]]:
    """Of scans.csv, without what differs from run to run."""
    with path.open() as file:
        return [{k: v for k, v in row.items() if not k.startswith("ms_")} for row in csv.DictReader(file)]


def numbers(path: Path) -> dict[str, Any]:
    """Of summary.json, likewise."""
    summary = json.loads(path.read_text())
    for name in ("ms_per_scan", "elapsed_s", "realtime_factor", "peak_rss_mb"):
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
    assert rows(out / "scans.csv") == rows(expected / "scans.csv")
    assert numbers(out / "summary.json") == numbers(expected / "summary.json")


@pytest.mark.parametrize("method", METHODS)
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
