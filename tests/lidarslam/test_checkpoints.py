"""When states are saved, where a resumed run goes on in its recording, and what of a directory a run may replace."""

import contextlib
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest

from lidarslam.config.settings import CheckpointConfig
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.scan import Scan
from lidarslam.core.state import State, read_state
from lidarslam.odometry.interface import ConstantVelocity
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.run import checkpoints
from lidarslam.run.checkpoints import Checkpoints, scans_left
from lidarslam.run.results import TileWriter
from lidarslam.run.summary import ScanLog
from lidarslam.storage.directory import CONFIG, MAP_PLY, METRICS, STATE, RunDirectory, Unfinished, require_whole


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
def test_saving_takes_two_percent_of_the_time_at_most(unfinished, monkeypatch, cost_s, pause_s):
    log = ScanLog()
    pipeline = Still(cost_s)
    monkeypatch.setattr(time, "monotonic", lambda: pipeline.now)
    kept = Checkpoints(unfinished, CheckpointConfig(), ConstantVelocity(), log, None)
    pipeline.now += 0.99  # so that a run which ends early can be resumed
    assert not kept.is_due()
    pipeline.now += 0.02
    assert kept.is_due()
    kept.save(cast(Pipeline, pipeline))
    assert read_state(unfinished.run / STATE)["log"]["messages"] == []
    pipeline.now += pause_s - 0.01
    assert not kept.is_due()
    pipeline.now += 0.02
    assert kept.is_due()
    assert not log.warnings


def test_a_disk_that_is_full_does_not_end_the_run(unfinished, monkeypatch):
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


def scan_at(stamp: float) -> Scan:
    return Scan(np.full((1, 3), 1.0 + stamp), stamp)


STAMPS = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize("done", [0, 4])
def test_a_run_goes_on_after_the_scan_that_was_read_last(done):
    for saved in ({"odometry": {}}, {"odometry": None}):
        odometry = Mock()
        left = scans_left(map(scan_at, STAMPS), scan_at(STAMPS[done]), odometry, saved)
        assert [scan.stamp for scan in left] == STAMPS[done + 1 :]
        heard = [call.args[0].stamp for call in odometry.estimate.call_args_list]
        assert heard == ([] if saved["odometry"] is not None else STAMPS[: done + 1])


@pytest.mark.parametrize("held", [Scan(np.full((1, 3), 3.5), 2.0), Scan(np.full((1, 3), 3.0), 2.1)])
def test_another_scan_than_the_one_that_was_read_is_noticed(held):
    with pytest.raises(InputError, match="the recording has changed"):
        scans_left(map(scan_at, STAMPS), held, Mock(), {"odometry": {}})


def refuse_as_unfinished(path: Path) -> None:
    with pytest.raises(InputError, match="did not finish"):
        require_whole(path)


def test_a_stopped_run_may_be_looked_at_until_it_is_resumed(tmp_path):
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


@pytest.mark.parametrize(
    "change",
    [lambda directory: directory.write_text(CONFIG, "run:\n"), lambda directory: TileWriter(directory)._begin()],
)
def test_the_results_before_are_given_back_until_the_first_of_them_is_replaced(tmp_path, caplog, change):
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


def names(path: Path) -> list[str]:
    return sorted(entry.name for entry in path.iterdir())


def test_a_new_directory_is_gone_when_nothing_came_of_the_run(tmp_path):
    with pytest.raises(RuntimeError), RunDirectory.create(tmp_path / "run"):
        raise RuntimeError
    assert names(tmp_path) == []


def test_overwriting_replaces_the_earlier_run_and_nothing_else(tmp_path):
    earlier = tmp_path / "run"
    with RunDirectory.create(earlier) as directory:
        directory.write_text(CONFIG, "run:\n  version: 0\n")
        directory.write_json(METRICS, {"ate": 1.0})
    (earlier / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"), RunDirectory.create(earlier):
        pass
    with pytest.raises(RuntimeError), RunDirectory.create(earlier, overwrite=True):
        raise RuntimeError
    with RunDirectory.create(earlier, overwrite=True) as directory:
        assert names(earlier) == [CONFIG, METRICS, "notes.txt"], "it stays until the new files are there"
        directory.write_text(CONFIG, "run:\n  version: 1\n")
    assert names(earlier) == [CONFIG, "notes.txt"], "no metrics of the run before"
    assert "version: 1" in (earlier / CONFIG).read_text()


def test_files_of_a_runs_names_that_are_no_runs_are_never_touched(tmp_path):
    (tmp_path / MAP_PLY).write_text("somebody's map")
    (tmp_path / CONFIG).write_text("somebody: config\n")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match="not those of a run"), RunDirectory.create(tmp_path, overwrite):
            pass
    assert (tmp_path / MAP_PLY).read_text() == "somebody's map"


def test_a_directory_with_foreign_files_only_is_used_as_it_is(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with RunDirectory.create(tmp_path) as directory:
        directory.write_text(CONFIG, "run:\n")
    assert (tmp_path / "notes.txt").read_text() == "mine"
