"""Finished runs in Rerun, and one line when they cannot be shown."""

import socket
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from lidarslam.config import ViewerConfig
from lidarslam.core.errors import OutputError
from lidarslam.core.trajectory import Trajectory
from lidarslam.finished_run import FinishedRun
from lidarslam.rerun_viewer import show_runs


@pytest.fixture
def finished() -> FinishedRun:
    trajectory = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    return FinishedRun("my run", trajectory, np.zeros(3, dtype=np.bool_), np.eye(3), np.array([[0, 2]]))


def test_a_name_with_a_space_is_one_entity(
    finished: FinishedRun, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert show_runs([finished], ViewerConfig(), tmp_path / "runs.rrd", web=False) is None
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "runs.rrd").stream()}
    assert r"/world/0_my\ run/map" in entities
    assert capfd.readouterr().err == ""


def test_a_file_that_cannot_be_written_gets_one_line(finished: FinishedRun, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"runs\.rrd: cannot be written \(.*\); name a file") as caught:
        show_runs([finished], ViewerConfig(), tmp_path / "none" / "runs.rrd", web=False)
    assert "\n" not in str(caught.value)


def test_a_port_in_use_gets_one_line(finished: FinishedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setattr("lidarslam.rerun_viewer._GRPC_PORT", port)
        with pytest.raises(OutputError, match=f"port {port} is in use; .* --save"):
            show_runs([finished], ViewerConfig(), None, web=True)


def test_no_display_gets_one_line(finished: FinishedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("lidarslam.rerun_viewer._is_taken", lambda _: False)
    with pytest.raises(OutputError, match=r"no display .* --save FILE\.rrd, or use --web"):
        show_runs([finished], ViewerConfig(), None, web=False)
