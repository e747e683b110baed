"""Finished runs in Rerun, and one line when they cannot be shown."""

import resource
import signal
import socket
import threading
import time
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from rerun.chunk import RrdReader

from lidarslam.config.settings import ViewerConfig
from lidarslam.core.errors import OutputError
from lidarslam.core.trajectory import Trajectory
from lidarslam.storage.finished_run import FinishedRun
from lidarslam.viewer import rerun_environment
from lidarslam.viewer.rerun_program import is_taken
from lidarslam.viewer.rerun_recording import IncompleteRecordingError
from lidarslam.viewer.rerun_runs import open_runs, save_runs, served_runs
from lidarslam.viewer.rerun_viewer import rerun_viewer


@pytest.fixture
def finished() -> FinishedRun:
    trajectory = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    return FinishedRun("my run", trajectory, np.zeros(3, dtype=np.bool_), np.eye(3), np.array([[0, 2]]))


def test_a_name_with_a_space_is_one_entity(
    finished: FinishedRun, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    save_runs([finished], ViewerConfig(), tmp_path / "runs.rrd")
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "runs.rrd").stream()}
    assert r"/world/0_my\ run/map" in entities
    assert capfd.readouterr().err == ""


def test_a_file_that_cannot_be_written_gets_one_line(finished: FinishedRun, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"runs\.rrd: cannot be written \(.*\); name another") as caught:
        save_runs([finished], ViewerConfig(), tmp_path / "none" / "runs.rrd")
    assert "\n" not in str(caught.value)


def test_a_port_in_use_gets_one_line(finished: FinishedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setattr("lidarslam.viewer.rerun_runs.GRPC_PORT", port)
        with (
            pytest.raises(OutputError, match=f"port {port} is in use; .* --save"),
            served_runs([finished], ViewerConfig()),
        ):
            pass


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_browser_is_served_to_this_machine_alone(finished: FinishedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server on all interfaces would be there on each address of the loopback; one on 127.0.0.1 is on that alone."""
    ports = free_port(), free_port()
    monkeypatch.setattr("lidarslam.viewer.rerun_runs.GRPC_PORT", ports[0])
    monkeypatch.setattr("lidarslam.viewer.rerun_runs.WEB_PORT", ports[1])
    with served_runs([finished], ViewerConfig()) as address:
        assert address.startswith(f"http://127.0.0.1:{ports[1]}/?url=")
        with urlopen(address, timeout=10) as page:
            assert b"<html" in page.read().lower()
        for port in ports:
            assert is_taken(port)
            with socket.socket() as probe:
                assert probe.connect_ex(("127.0.0.2", port)) != 0
    begun = time.monotonic()
    while is_taken(ports[1]) and time.monotonic() - begun < 10:
        time.sleep(0.05)
    assert not is_taken(ports[1]), "the page goes with whoever served it"


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
            rerun_viewer("run", ViewerConfig(), tmp_path / "recording.rrd", window=False) as viewer,
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
        save_runs([], ViewerConfig(), tmp_path / "recording.rrd")
    assert "\n" not in str(caught.value)
    assert not any(thread.name == "recording" for thread in threading.enumerate())  # its file is finished


def test_no_display_gets_one_line(finished: FinishedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("lidarslam.viewer.rerun_runs.is_taken", lambda _: False)
    with pytest.raises(OutputError, match=r"no display .* --save FILE\.rrd, or use --web"):
        open_runs([finished], ViewerConfig())
