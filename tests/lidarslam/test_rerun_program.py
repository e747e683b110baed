"""Rerun's window is asked to listen on this machine alone."""

import ast
import os
import signal
import socket
import time
from pathlib import Path

import pytest

from lidarslam.core.errors import OutputError
from lidarslam.viewer import rerun_program
from lidarslam.viewer.rerun_program import is_taken, open_window

LISTENER = """#!/usr/bin/env python3
import os, socket, sys, time
from pathlib import Path
given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
Path(__file__).with_name("pid").write_text(str(os.getpid()))
with socket.create_server((given["--bind"], int(given["--port"]))):
    time.sleep(60)
"""


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


def test_a_window_that_does_not_open_gets_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    pretend(monkeypatch, tmp_path / "rerun", "#!/bin/sh\nexit 3\n")
    with pytest.raises(OutputError, match="cannot be opened; write a file instead"):
        open_window(port)


def test_a_window_that_never_listens_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    monkeypatch.setattr("lidarslam.viewer.rerun_program._START_S", 1.0)
    pretend(monkeypatch, tmp_path / "rerun", f"#!/bin/sh\necho $$ > {tmp_path}/pid\nexec sleep 60\n")
    begun = time.monotonic()
    with pytest.raises(OutputError, match="cannot be opened"):
        open_window(port)
    assert time.monotonic() - begun < 20
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_a_program_that_is_missing_gets_one_line(monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    monkeypatch.setattr("sys.executable", "/nowhere/python")
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(OutputError, match="not installed"):
        rerun_program.open_window(port)
