"""Finished runs in Rerun: files written through a pipe, windows on this machine alone, one line where it cannot be."""

import ast
import os
import resource
import signal
import socket
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
from lidarslam.viewer.rerun_program import is_taken, open_window
from lidarslam.viewer.rerun_recording import IncompleteRecordingError
from lidarslam.viewer.rerun_recording import _PipedFile as PipedFile
from lidarslam.viewer.rerun_runs import show_runs
from lidarslam.viewer.rerun_viewer import rerun_viewer

LISTENER = """#!/usr/bin/env python3
import os, socket, sys, time
from pathlib import Path
given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
Path(__file__).with_name("pid").write_text(str(os.getpid()))
with socket.create_server((given["--bind"], int(given["--port"]))):
    time.sleep(60)
"""


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


def test_a_write_that_fails_empties_the_file_and_swallows_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a disk that fills up does: first it takes a part, then it says so."""
    room = 100_000

    def write(handle: int, piece: bytes) -> int:
        nonlocal room
        if not room:
            raise OSError(28, "No space left on device")
        taken = written(handle, piece[:room])
        room -= taken
        return taken

    written = os.write
    monkeypatch.setattr("lidarslam.viewer.rerun_recording.os.write", write)
    file = PipedFile(tmp_path / "file")
    with file.entrance.open("wb") as entrance:
        file.close_entrance()
        for _ in range(50):
            entrance.write(bytes(100_000))
    assert file.finish()
    assert (tmp_path / "file").stat().st_size == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_file_that_cannot_even_be_emptied_holds_no_writer() -> None:
    """As on a disk that fails."""
    file = PipedFile(Path("/dev/full"))

    def write() -> None:
        with file.entrance.open("wb") as entrance:
            opened.set()
            entrance.write(bytes(1_000_000))

    opened = threading.Event()
    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    assert opened.wait(10.0)
    file.close_entrance()
    writer.join(10.0)
    assert not writer.is_alive()
    assert file.finish()


def test_a_writer_that_never_lets_go_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lidarslam.viewer.rerun_recording._PIPE_S", 0.1)
    file = PipedFile(tmp_path / "file")
    with file.entrance.open("wb"):
        file.close_entrance()
        assert not file.finish()
    monkeypatch.undo()  # what follows is waited for, however busy the machine is
    assert file.finish()


@pytest.fixture
def port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def pretend(monkeypatch: pytest.MonkeyPatch, program: Path, text: str) -> None:
    program.write_text(text)
    program.chmod(0o755)
    monkeypatch.setattr("lidarslam.viewer.rerun_program._program", lambda: str(program))


def test_a_window_listens_on_this_machine_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    pretend(monkeypatch, tmp_path / "rerun", LISTENER)
    open_window(port)
    try:
        assert is_taken(port)
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.2", port)) != 0
        before = (tmp_path / "pid").read_text()
        open_window(port)  # which is open
        assert (tmp_path / "pid").read_text() == before
    finally:
        os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)


def test_the_window_is_kept_from_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    """It asks for a newer version by way of a proxy: one that is not there."""
    for name in ("ALL_PROXY", "HTTPS_PROXY", "https_proxy"):
        monkeypatch.setenv(name, "http://elsewhere.example:3128")
    told = 'Path(__file__).with_name("told").write_text(repr(dict(os.environ)))\n'
    pretend(monkeypatch, tmp_path / "rerun", LISTENER.replace("with socket", told + "with socket"))
    open_window(port)
    os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)
    environment = ast.literal_eval((tmp_path / "told").read_text())
    for name in ("ALL_PROXY", "all_proxy", "HTTPS_PROXY", "https_proxy"):
        assert environment[name] == "http://127.0.0.1:1"


def test_a_window_that_never_listens_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    monkeypatch.setattr("lidarslam.viewer.rerun_program._START_S", 1.0)
    pretend(monkeypatch, tmp_path / "rerun", f"#!/bin/sh\necho $$ > {tmp_path}/pid\nexec sleep 60\n")
    begun = time.monotonic()
    with pytest.raises(OutputError, match="cannot be opened"):
        open_window(port)
    assert time.monotonic() - begun < 20
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)
