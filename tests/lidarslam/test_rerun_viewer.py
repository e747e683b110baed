"""Finished runs in Rerun, and one line when they cannot be shown."""

import resource
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from lidarslam.config.settings import ViewerConfig, load_config
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.trajectory import Trajectory
from lidarslam.run.request import RunRequest
from lidarslam.run.run import execute
from lidarslam.storage.finished_run import FinishedRun
from lidarslam.viewer import rerun_environment
from lidarslam.viewer.rerun_output import save, show_file_in_window, show_in_window
from lidarslam.viewer.rerun_recording import IncompleteRecordingError
from lidarslam.viewer.rerun_runs import show_runs
from lidarslam.viewer.rerun_viewer import rerun_viewer


@pytest.fixture
def finished() -> FinishedRun:
    trajectory = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    return FinishedRun("my run", trajectory, np.zeros(3, dtype=np.bool_), np.eye(3), np.array([[0, 2]]))


def test_a_name_with_a_space_is_one_entity(
    finished: FinishedRun, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    save(show_runs([finished], None, ViewerConfig()), tmp_path / "runs.rrd")
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "runs.rrd").stream()}
    assert r"/world/my\ run/map" in entities
    assert capfd.readouterr().err == ""


def test_a_file_that_cannot_be_written_gets_one_line(finished: FinishedRun, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"runs\.rrd: cannot be written \(.*\); name another") as caught:
        save(show_runs([finished], None, ViewerConfig()), tmp_path / "none" / "runs.rrd")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("size", [0, 1_000, 100_000])
def test_a_full_disk_neither_holds_a_run_nor_leaves_half_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    """Rerun's own writer is never told, because it may wait without end then; the room it took is given back."""
    monkeypatch.setattr(rerun_environment, "abandoned", False)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    begun = time.monotonic()
    try:
        with (
            pytest.raises(IncompleteRecordingError, match="is the disk full"),
            rerun_viewer("run", ViewerConfig(), tmp_path / "recording.rrd") as viewer,
        ):
            for seed in range(20):
                viewer.show_map(np.random.default_rng(seed).normal(size=(5_000, 3)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert time.monotonic() - begun < 10
    assert (tmp_path / "recording.rrd").stat().st_size == 0
    assert not rerun_environment.abandoned


def test_a_recording_that_cannot_be_begun_gets_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where there is no /dev/fd."""
    monkeypatch.setattr("lidarslam.viewer.rerun_recording.OPEN_FILES", tmp_path / "none")
    with pytest.raises(OutputError, match=r"cannot be begun \(.*\)") as caught:
        save(show_runs([], None, ViewerConfig()), tmp_path / "recording.rrd")
    assert "\n" not in str(caught.value)
    assert not any(thread.name == "recording" for thread in threading.enumerate())  # its file is finished


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("lidarslam.viewer.rerun_program.is_taken", lambda _: False)


@pytest.mark.usefixtures("no_display")
def test_no_display_gets_one_line(finished: FinishedRun, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"no display .* --save FILE\.rrd, or use --web"):
        show_in_window(show_runs([finished], None, ViewerConfig()))
    save(show_runs([finished], None, ViewerConfig()), tmp_path / "runs.rrd")
    with pytest.raises(OutputError, match=r"no display .* --web"):
        show_file_in_window(tmp_path / "runs.rrd")


@pytest.mark.usefixtures("no_display")
def test_a_run_with_a_window_and_no_display_ends_before_it_begins(small_recording: Path, tmp_path: Path) -> None:
    request = RunRequest(small_recording, tmp_path / "run", load_config(None), rerun="spawn")
    with pytest.raises(OutputError, match=r"no display .* --rerun web, .* --rerun save"):
        execute(request, lambda *_: None)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("content", [None, b"", b"not a recording"])
def test_a_file_that_is_no_recording_gets_one_line(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "some.rrd").write_bytes(content)
    with pytest.raises(InputError, match=r"some\.rrd: no"):
        show_file_in_window(tmp_path / "some.rrd")
