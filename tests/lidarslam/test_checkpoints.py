"""When states are saved, who may be at work on a run, and where a resumed one goes on in its recording."""

import contextlib
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from lidarslam.config.settings import CheckpointConfig
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State, read_state
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.odometry.interface import ConstantVelocity
from lidarslam.odometry.methods.consistency import ConsistencyCheck
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.pipeline.localisation import OdometryAlone
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.run import checkpoints
from lidarslam.run.checkpoints import Checkpoints, scans_left
from lidarslam.run.results import TileWriter
from lidarslam.run.summary import ScanLog
from lidarslam.storage.directory import CONFIG, About, RunDirectory, Unfinished, require_whole


@dataclass
class Still:
    """A pipeline with hardly a state, which takes a while to be asked for it by its own clock."""

    seconds: float
    now: float = 100.0

    def state(self) -> State:
        self.now += self.seconds
        return {}


@contextlib.contextmanager
def claim(path: Path, description: dict[str, Any], resume: bool = False) -> Iterator[Unfinished]:
    with (
        RunDirectory.create(path, overwrite=True, resume=resume) as directory,
        Unfinished.claim(directory, description, resume) as claimed,
    ):
        yield claimed


@pytest.fixture
def unfinished(tmp_path: Path) -> Iterator[Unfinished]:
    with claim(tmp_path, {}) as claimed:
        yield claimed


@pytest.mark.parametrize(("cost_s", "pause_s"), [(0.01, 10.0), (0.2, 10.0), (1.0, 50.0)])
def test_saving_takes_two_percent_of_the_time_at_most(
    unfinished: Unfinished, monkeypatch: pytest.MonkeyPatch, cost_s: float, pause_s: float
) -> None:
    log = ScanLog()
    pipeline = Still(cost_s)
    monkeypatch.setattr(time, "monotonic", lambda: pipeline.now)
    kept = Checkpoints(unfinished, CheckpointConfig(), ConstantVelocity(), log, None)
    pipeline.now += 0.99  # so that a run which ends early can be resumed
    assert not kept.is_due()
    pipeline.now += 0.02
    assert kept.is_due()
    kept.save(cast(Pipeline, pipeline))
    assert read_state(unfinished.files.state).part("log").value("messages") == []
    pipeline.now += pause_s - 0.01
    assert not kept.is_due()
    pipeline.now += 0.02
    assert kept.is_due()
    assert not log.warnings


def test_a_disk_that_is_full_does_not_end_the_run(unfinished: Unfinished, monkeypatch: pytest.MonkeyPatch) -> None:
    log = ScanLog()

    def fail(path: Path, _: State) -> None:
        raise OutputError(f"{path}: cannot be written (No space left on device)")

    monkeypatch.setattr(checkpoints, "write_state", fail)
    kept = Checkpoints(unfinished, CheckpointConfig(every_scans=2), ConstantVelocity(), log, None)
    assert [kept.is_due(), kept.is_due()] == [False, True]
    kept.save(cast(Pipeline, Still(0.0)))
    assert [kept.is_due(), kept.is_due()] == [False, True]
    assert "a checkpoint could not be saved" in log.warnings[0]
    assert "No space left" in log.warnings[0]


@dataclass
class Counting:
    """Keeps every second scan's state in memory."""

    states: list[tuple[int, State]] = field(default_factory=list)
    out: int = 0
    asked: int = 0

    def is_due(self) -> bool:
        self.asked += 1
        return self.asked % 2 == 0

    def save(self, pipeline: Pipeline) -> None:
        assert pipeline.held is not None
        self.states.append((self.out, pipeline.state()))


def make_pipeline(odometry: ExternalOdometry, keeper: Counting | None = None) -> Pipeline:
    localiser = OdometryAlone(ConsistencyCheck())
    return Pipeline(odometry, localiser, GlobalMapConfig(voxel_size_m=0.1), checkpointer=keeper)


def test_nothing_is_at_work_while_a_state_is_kept(
    room_scans: list[Scan], room_truth: Trajectory, through_disk: Any
) -> None:
    """All results but that of the scan that is held are out, and the rest follows from the state."""
    keeper = Counting()
    whole = []
    for result in make_pipeline(ExternalOdometry(room_truth), keeper).run(room_scans[:9]):
        whole.append(result)
        keeper.out = len(whole)
    assert [out for out, _ in keeper.states] == [2, 4, 6, 8]
    odometry = ExternalOdometry(room_truth)
    pipeline = make_pipeline(odometry)
    pipeline.restore(through_disk(keeper.states[1][1]))
    assert pipeline.held.scan.stamp == room_scans[4].stamp
    odometry.estimate(room_scans[4])
    rest = list(pipeline.run(room_scans[5:9]))
    assert len(rest) == 5
    for found, expected in zip(rest, whole[4:], strict=True):
        np.testing.assert_array_equal(found.T_world_lidar, expected.T_world_lidar)
        np.testing.assert_array_equal(found.points, expected.points)
        assert (found.status, found.residual_m) == (expected.status, expected.residual_m)


class Deaf:
    """An odometry without a state, and the stamps that it was given."""

    def __init__(self) -> None:
        self.heard: list[float] = []

    def estimate(self, scan: Scan) -> None:
        self.heard.append(scan.stamp)

    def restore(self, _: Saved) -> None:
        pass


def scan_at(stamp: float) -> Scan:
    return Scan(np.full((1, 3), 1.0 + stamp), stamp)


STAMPS = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize("done", [0, 4])
def test_a_run_goes_on_after_the_scan_that_was_read_last(done: int) -> None:
    for saved in (Saved({"odometry": {}}), Saved({"odometry": None})):
        odometry: Any = Deaf()
        left = scans_left(map(scan_at, STAMPS), scan_at(STAMPS[done]), odometry, saved)
        assert [scan.stamp for scan in left] == STAMPS[done + 1 :]
        assert odometry.heard == ([] if saved.has("odometry") else STAMPS[: done + 1])


@pytest.mark.parametrize("held", [Scan(np.full((1, 3), 3.5), 2.0), Scan(np.full((1, 3), 3.0), 2.1)])
def test_another_scan_than_the_one_that_was_read_is_noticed(held: Scan) -> None:
    odometry: Any = Deaf()
    with pytest.raises(InputError, match="the recording has changed"):
        scans_left(map(scan_at, STAMPS), held, odometry, Saved({"odometry": {}}))


def test_two_are_not_at_work_on_one_run(tmp_path: Path) -> None:
    with claim(tmp_path, {"a": 1}) as first:
        first.begin(0)
        for resume in (False, True):
            with pytest.raises(OutputError, match="another lidarslam"), claim(tmp_path, {"a": 1}, resume):
                pass
        assert About.read(tmp_path) is not None


def refuse_as_unfinished(path: Path) -> None:
    with pytest.raises(InputError, match="did not finish"):
        require_whole(path)


def test_a_stopped_run_may_be_looked_at_until_it_is_resumed(tmp_path: Path) -> None:
    with claim(tmp_path, {"a": 1}) as unfinished:
        unfinished.begin(0)
        refuse_as_unfinished(tmp_path)
        unfinished.end(stopped=True)
    require_whole(tmp_path)
    with pytest.raises(OutputError, match="--resume"), RunDirectory.create(tmp_path):
        pass
    with claim(tmp_path, {"a": 1}, resume=True) as unfinished:
        unfinished.begin(3)
        refuse_as_unfinished(tmp_path)
        assert unfinished.about.resumed_after == (3,)
        unfinished.end(stopped=False)
    require_whole(tmp_path)
    assert not (tmp_path / "unfinished").exists()


def replace_first_file(directory: RunDirectory) -> None:
    directory.write_text(CONFIG, "run:\n  version: 1\n")


@pytest.mark.parametrize("change", [replace_first_file, lambda directory: TileWriter(directory)._begin()])
def test_the_results_before_are_given_back_until_the_first_of_them_is_replaced(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, change: Callable[[RunDirectory], None]
) -> None:
    """What lies there at an instant is what a run leaves that is killed then."""
    run, killed = tmp_path / "run", tmp_path / "killed"
    with RunDirectory.create(run) as directory:
        directory.write_text(CONFIG, "run:\n  version: 0\n")
    with claim(run, {"a": 1}) as unfinished:
        unfinished.begin(0)
        shutil.copytree(run, killed)
    require_whole(killed)
    assert "results of an earlier run" in caplog.text
    for description, resume in (({"a": 1}, True), ({"a": 2}, False)):
        again, mixed = tmp_path / f"again {resume}", tmp_path / f"mixed {resume}"
        shutil.copytree(killed, again)
        with (
            RunDirectory.create(again, not resume, resume) as directory,
            Unfinished.claim(directory, description, resume) as unfinished,
        ):
            unfinished.begin(0)
            require_whole(again)
            change(directory)
            shutil.copytree(again, mixed)
        refuse_as_unfinished(mixed)
        with pytest.raises(RuntimeError), claim(mixed, {"a": 3}):  # a failed attempt does not make it whole
            raise RuntimeError
        refuse_as_unfinished(mixed)
        with claim(mixed, {"a": 3}) as unfinished:
            unfinished.begin(0)
            refuse_as_unfinished(mixed)
