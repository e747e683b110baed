"""A run that was killed, wherever, and resumed comes to the results of one that was not."""

import hashlib
import json
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.folders.scan_files import read_ply
from lidarslam.simulation.imu import MEMS_IMU, sample_imu
from lidarslam.storage.finished_run import load_run

from ..conftest import lidarslam
from .killable import Ended

KILLED = -signal.SIGKILL

Run = Callable[..., Ended]
Timeless = Callable[[Path], dict[str, Any]]


@pytest.fixture(scope="module")
def run(killable: Run) -> Run:
    """Runs `lidarslam run SOURCE --out OUT ...`."""
    return lambda source, out, *arguments, **kill: killable("run", source, *arguments, out=out, **kill)


SCANS = 34
COVERED = 4
GRAPH = [
    "--pose-graph", "--set", "pose_graph.keyframes.distance_m=0.2", "--set", "pose_graph.loops.min_way_m=0.5",
]  # fmt: skip
METHODS = {
    "constant velocity": ["--odometry", "constant-velocity", "--stop", "12"],
    "learned": ["--odometry", "learned", "--stop", "10"],
    "odometry alone": ["--odometry", "learned", "--no-mapping", "--stop", "10"],
    "pose graph": ["--odometry", "constant-velocity", *GRAPH, "--loop", "2", "12", "--loop", "3", "33"],
    "imu": ["--odometry", "imu", *GRAPH],
    "tiles": ["--odometry", "constant-velocity", "--stop", "16", "--set", "global_map.most_points=3000"],
    "kiss-icp": ["--odometry", "kiss-icp", "--no-mapping", "--set", "odometry.kiss_icp.threads=1", "--stop", "12"],
}
SETTINGS = ("checkpoints.every_scans=3", "global_map.voxel_size_m=0.1", "mapping.keypoints=800")
FAST = ["--no-report", *(word for setting in SETTINGS for word in ("--set", setting))]


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
    Trajectory(stamps, there_and_back(stamps)).save(folder / "ground_truth.tum")
    model = replace(MEMS_IMU, T_lidar_imu=np.eye(4))
    imu = sample_imu(model, there_and_back, 0.0, 0.1 * SCANS + 0.2, seed=1)
    rows = np.column_stack([imu.stamps, imu.angular_velocities, imu.accelerations])
    np.savetxt(folder / "imu.csv", rows, delimiter=",", header="T_lidar_imu: 1 0 0 0 0 1 0 0 0 0 1 0")
    return folder


class Whole:
    """A run that nobody killed, to which others like it are compared."""

    def __init__(self, run: Run, source: Path, out: Path, arguments: list[str], timeless: Timeless) -> None:
        self.out = out
        self._run, self._source, self._arguments, self._timeless = run, source, arguments, timeless
        self.ended = self.again(out)
        assert self.ended.status in (0, 3), self.ended.said

    def again(self, out: Path, *more: str, source: Path | None = None, **kill: Any) -> Ended:
        """Another such run, perhaps killed."""
        return self._run(source or self._source, out, *self._arguments, *more, **kill)

    def assert_finishes(self, out: Path, *more: str, keep_in: Path | None = None) -> Ended:
        """See that such a run ends as this one, with the same results to the last digit."""
        ended = self.again(out, *more, keep_in=keep_in)
        assert ended.status == self.ended.status, ended.said
        self.assert_same(out)
        return ended

    def assert_same(self, out: Path) -> None:
        found, expected = self._timeless(out), self._timeless(self.out)
        found["config.yaml"] = expected["config.yaml"]  # how often the state is saved may differ
        assert found == expected


@pytest.fixture(scope="module")
def whole(run: Run, source: Path, tmp_path_factory: pytest.TempPathFactory, timeless: Timeless) -> Callable[..., Whole]:
    """The run of each method, made when it is asked for."""

    @cache
    def make(method: str) -> Whole:
        out = tmp_path_factory.mktemp("whole") / "run"
        made = Whole(run, source, out, [*METHODS[method], *FAST], timeless)
        assert {"intensity", "red"} <= set(read_ply(out / "map.ply").dtype.names or ())
        return made

    return make


@pytest.fixture(scope="module")
def expected(whole: Callable[[str], Whole]) -> Whole:
    """That without an odometry, which is fast."""
    return whole("constant velocity")


SLOW = ("learned", "odometry alone", "kiss-icp")  # for their odometry; those with --pose-graph show loops


@pytest.mark.long
@pytest.mark.parametrize("method", [pytest.param(m, marks=pytest.mark.slow) if m in SLOW else m for m in METHODS])
def test_a_killed_run_comes_to_the_same_results(whole, tmp_path, method):
    """Killed twice, at a third and at two thirds of all that is done on disk."""
    expected, out = whole(method), tmp_path / "run"
    events = expected.ended.events
    assert expected.again(out, kill_at=events // 3).status == KILLED
    assert expected.again(out, "--resume", kill_at=events // 3).status == KILLED
    ended = expected.assert_finishes(out, "--resume")
    summary = json.loads((out / "summary.json").read_text())
    (resumed,) = [line for line in summary["warnings"] if "resumed" in line]
    first, second = map(int, resumed.removeprefix("the run was resumed 2 times, after ").split(" scans")[0].split(", "))
    assert 0 < first < second < SCANS
    assert resumed in ended.said
    assert method != "pose graph" or summary["loop_closures"] > 0, "else this tells nothing about loops"


def go_on(expected: Whole, out: Path, *more: str) -> None:
    """Go on with what a killed run left, until it is done, and see that it is as it should be."""
    if out.exists() and (out / "unfinished" / "run.json").exists():
        with pytest.raises(InputError, match="did not finish"):
            load_run(out)
        ended = expected.again(out, *more, "--resume")
    else:  # hardly begun, or just done
        ended = expected.again(out, *more, "--resume" if (out / "summary.json").exists() else "--overwrite")
    assert ended.status == expected.ended.status, ended.said
    leftover = out / "unfinished"
    if leftover.exists():  # killed while it was removed: nothing that anybody would take for a run
        assert not (leftover / "run.json").exists()
        shutil.rmtree(leftover)
    expected.assert_same(out)


@pytest.mark.slow  # a run for every different thing that a killed one may leave: a minute
@pytest.mark.parametrize(("method", "every_scans"), [("constant velocity", 3), ("pose graph", 10), ("tiles", 5)])
def test_a_run_may_be_killed_before_anything_it_does_on_disk(whole, tmp_path, method, every_scans):
    """What lies there before each of these things is kept of one run, as so many kills would leave it.

    A state is saved three times, each time by the same steps.
    """
    expected, kept = whole(method), tmp_path / "kept"
    more = "--set", f"checkpoints.every_scans={every_scans}"
    kept.mkdir()
    expected.assert_finishes(tmp_path / "run", *more, keep_in=kept)
    left = {content(path): path for path in sorted(kept.iterdir(), key=lambda path: int(path.name))}
    assert len(left) > 20
    for out in left.values():
        go_on(expected, out, *more)
        shutil.rmtree(out)


def content(folder: Path) -> tuple[tuple[str, bytes], ...]:
    return tuple(
        (str(path.relative_to(folder)), hashlib.sha256(path.read_bytes()).digest() if path.is_file() else b"")
        for path in sorted(folder.rglob("*"))
    )


@pytest.fixture(scope="module")
def killed_once(expected: Whole, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("killed") / "run"
    assert expected.again(out, kill_at=expected.ended.events // 3).status == KILLED
    assert (out / "unfinished" / "state.npz").exists()
    return out


@pytest.fixture
def killed(killed_once: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(killed_once, tmp_path / "run"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "lock"}


def assert_refused(ended: Ended, told: str) -> None:
    assert ended.status == 1
    assert told in ended.said
    assert ended.said.count("\n") == 1


@pytest.mark.long
@pytest.mark.parametrize(("arguments", "told"), [
    (["--stop", "13"], "stop 12 (now 13)"), (["--start", "1"], "start 0 (now 1)"),
    (["--pose-graph"], "pose_graph.enabled False (now True)"),
    (["--odometry", "learned"], "odometry.method constant-velocity (now learned)"),
])  # fmt: skip
def test_another_run_is_not_resumed(expected, killed, arguments, told):
    before = contents(killed)
    assert_refused(expected.again(killed, *arguments, "--resume"), told)
    assert contents(killed) == before


def test_another_recording_is_not_taken_for_it(expected, source, killed, tmp_path):
    other = shutil.copytree(source, tmp_path / "other")
    assert_refused(expected.again(killed, "--resume", source=other), "was begun with source")
    about = killed / "unfinished" / "run.json"
    about.write_text(about.read_text().replace(str(source), str(other)))
    (other / "000000.npy").write_bytes((other / "000001.npy").read_bytes())  # it has been dealt with already
    (other / "ground_truth.tum").unlink()
    for path in sorted(other.glob("*.npy"))[1:]:
        table = np.load(path)
        table["x"] += 0.01
        np.save(path, table)
    assert_refused(expected.again(killed, "--resume", source=other), "the recording has changed")


@pytest.mark.long
def test_a_run_killed_before_its_first_state_begins_again(expected, tmp_path):
    out, event = tmp_path / "run", 1
    while not (out / "unfinished" / "run.json").exists():
        shutil.rmtree(out, ignore_errors=True)
        event += 1
        assert expected.again(out, kill_at=event).status == KILLED
    assert not (out / "unfinished" / "state.npz").exists()
    assert "no checkpoint yet" in expected.assert_finishes(out, "--resume").said


def test_a_killed_run_is_neither_replaced_nor_evaluated_unasked(expected, source, killed):
    ended = expected.again(killed)
    assert ended.status == 1
    assert "holds an unfinished run or merge; replace it with --overwrite" in ended.said
    for command in (["evaluate", killed], ["view", killed], ["view", killed, "--picture", "x.png"]):
        result = lidarslam(*command)
        assert result.exit_code == 1
        assert f"did not finish; resume it with lidarslam run {source} --out {killed} --resume" in result.stderr
    result = lidarslam("evaluate", expected.out, "--reference", killed)
    assert (result.exit_code, "did not finish" in result.stderr) == (1, True)


@pytest.mark.long
@pytest.mark.parametrize("part", [0.5, 0.9])
def test_what_a_killed_overwrite_was_to_replace_is_given_back(expected, tmp_path, caplog, part):
    """Killed on its way, and among its final results."""
    out = tmp_path / "run"
    expected.again(out, "--stop", "6")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    kill_at = int(part * expected.ended.events)
    assert expected.again(out, "--overwrite", kill_at=kill_at).status == KILLED
    untouched = all((out / name).read_bytes() == content for name, content in before.items())
    assert untouched == (part == 0.5)
    if untouched:
        assert len(load_run(out).trajectory) == 6
        assert lidarslam("evaluate", out).exit_code == 0
        assert caplog.text.count("results of an earlier run") == 1
    else:
        with pytest.raises(InputError, match="did not finish"):
            load_run(out)
    expected.assert_finishes(out, "--resume")


def test_a_finished_run_is_left_as_it_is(expected):
    before = contents(expected.out)
    ended = expected.again(expected.out, "--resume")
    assert ended.status == expected.ended.status
    assert "is finished already" in ended.said
    other = expected.again(expected.out, "--stop", "5", "--resume")
    assert other.status == 1
    assert "holds another finished run" in other.said
    assert contents(expected.out) == before


def test_there_must_be_something_to_resume(run, source, tmp_path):
    ended = run(source, tmp_path / "run", "--resume")
    assert ended.status == 1
    assert "holds no run to resume" in ended.said
    assert not (tmp_path / "run").exists()
    assert run(source, tmp_path / "run", "--resume", "--overwrite").status == 2


@pytest.mark.long
def test_a_rerun_recording_goes_on_in_a_new_file(expected, killed):
    ended = expected.again(killed, "--resume", "--rerun", "save")
    assert ended.status == expected.ended.status
    assert "warning: recording.rrd holds the scans from" in ended.said
    assert (killed / "recording.rrd").stat().st_size > 0
    assert (killed / "trajectory.tum").read_text() == (expected.out / "trajectory.tum").read_text()
