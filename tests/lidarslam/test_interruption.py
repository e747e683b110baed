"""Ctrl-C at any time of a run, once and several times."""

import contextlib
import logging
import signal
import time
import weakref
from collections.abc import Callable
from itertools import count
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from click.testing import Result

from lidarslam.core.errors import OutputError
from lidarslam.core.trajectory import read_tum
from lidarslam.run import interruption
from lidarslam.run.checkpoints import Checkpoints
from lidarslam.run.interruption import Interruptions, ended_like_interrupted

from ..conftest import lidarslam
from .conftest import FAST

pytestmark = pytest.mark.usefixtures("interruptible")

WRITING = "the results so far are being written"


def press() -> None:
    signal.raise_signal(signal.SIGINT)


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every press counts, however soon after the one before."""
    monkeypatch.setattr(interruption, "_APART_S", 0.0)


Run = Callable[..., Result]


@pytest.fixture
def run(tmp_path: Path, small_recording: Path) -> Run:
    return lambda *options: lidarslam("run", small_recording, "--out", tmp_path / "run", *FAST, *options)


def pressed_at(monkeypatch: pytest.MonkeyPatch, place: str, times: int) -> None:
    """Press Ctrl-C so many times where a function of the program is called."""
    module, name = place.rsplit(".", 1)
    original = getattr(__import__(module, fromlist=[name]), name)

    def pressing(*given: object, **named: object) -> object:
        for _ in range(times):
            press()
        return original(*given, **named)

    monkeypatch.setattr(place, pressing)


def at_scan(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    is_due, asked = Checkpoints.is_due, count(1)

    def pressing(self: Checkpoints) -> bool:
        if next(asked) == number:
            press()
        return is_due(self)

    monkeypatch.setattr(Checkpoints, "is_due", pressing)


@pytest.mark.usefixtures("hasty")
def test_the_second_and_third_wait_for_the_results(run, tmp_path, monkeypatch, caplog):
    at_scan(monkeypatch, 4)
    pressed_at(monkeypatch, "lidarslam.run.run.write_results", 2)
    assert run().exit_code == 1
    told = [record.message for record in caplog.records if WRITING in record.message]
    assert len(told) == 2
    assert len(read_tum(tmp_path / "run" / "trajectory.tum")) == 4
    assert (tmp_path / "run" / "map.ply").is_file()


@pytest.mark.usefixtures("hasty")
def test_the_last_scan_is_done_and_ctrl_c_only_waits(run, tmp_path, monkeypatch, caplog):
    pressed_at(monkeypatch, "lidarslam.run.results.corrected_map", 1)
    assert run().exit_code == 0
    assert sum(WRITING in record.message for record in caplog.records) == 1
    assert not (tmp_path / "run" / "unfinished").exists()


@pytest.mark.usefixtures("hasty")
def test_who_insists_abandons_the_results_and_can_resume(run, tmp_path, monkeypatch):
    at_scan(monkeypatch, 4)
    pressed_at(monkeypatch, "lidarslam.run.run.write_results", 3)
    result = run("--set", "checkpoints.every_scans=2")
    assert result.exit_code == 1
    assert "interrupted, no results were written; continue from the last checkpoint with --resume" in result.output
    assert not (tmp_path / "run" / "trajectory.tum").exists()
    monkeypatch.undo()
    result = run("--set", "checkpoints.every_scans=2", "--resume")
    assert result.exit_code == 0, result.output
    assert len(read_tum(tmp_path / "run" / "trajectory.tum")) == 6


def test_an_interrupted_run_goes_on_after_its_last_scan(run, monkeypatch):
    with monkeypatch.context() as patch:
        at_scan(patch, 3)
        result = run()
    assert result.exit_code == 1
    assert "stopped after 3 scans: interrupted; continue with --resume" in result.output
    result = run("--resume")
    assert result.exit_code == 0
    assert "resumed once, after 3 scans" in result.output


def test_resuming_is_not_promised_where_there_is_no_checkpoint(run, monkeypatch):
    at_scan(monkeypatch, 3)
    monkeypatch.setattr("lidarslam.run.checkpoints.write_state", Mock(side_effect=OutputError("no room")))
    result = run()
    assert result.exit_code == 1
    assert "no checkpoint to continue from; --overwrite begins again" in result.output


@pytest.mark.usefixtures("hasty")
def test_a_second_request_does_not_wait_for_a_checkpoint():
    with Interruptions() as interruptions:
        interruptions.takes_requests = True
        press()
        assert interruptions.is_requested
        with pytest.raises(KeyboardInterrupt):
            press()


def test_before_the_first_scan_nothing_is_kept(run, tmp_path, monkeypatch):
    for place in ("lidarslam.run.run.open_odometry", "lidarslam.run.run.prefetch"):
        with monkeypatch.context() as patch:
            pressed_at(patch, place, 1)
            result = run()
        assert result.exit_code == 1
        assert "nothing was kept" in result.output
        assert "--resume" not in result.output
        assert not (tmp_path / "run").exists()


def test_presses_in_quick_succession_are_one(caplog):
    with Interruptions() as interruptions:
        interruptions.protect_results()
        for _ in range(20):
            press()
    assert len(caplog.records) <= 1


class _InterruptedWhenDropped:
    def __del__(self) -> None:
        press()


@pytest.mark.parametrize("is_weak", [False, True], ids=["finaliser", "weak reference"])
@pytest.mark.parametrize("is_run", [False, True], ids=["command", "run"])
def test_a_request_in_a_finaliser_is_not_lost(is_weak, is_run):
    with ended_like_interrupted(), Interruptions() if is_run else contextlib.nullcontext():
        if is_weak:
            ended: object = np.zeros(3)
            weakref.finalize(ended, press)
        else:
            ended = _InterruptedWhenDropped()
        with pytest.raises(KeyboardInterrupt):
            del ended
            time.sleep(60)


def test_the_handlers_are_as_before():
    def handlers() -> list[object]:
        return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]

    before = handlers()
    with Interruptions():
        assert handlers() != before
    assert handlers() == before
    assert logging.getLogger("lidarslam.run.interruption").level == logging.NOTSET
