"""A run touches its directory and nothing else: no other file, no network."""

import os
import socket
from pathlib import Path

import numpy as np
import pytest

from ..conftest import succeeds


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("somebody asked the network")

    for name in ("connect", "connect_ex", "sendto", "bind"):
        monkeypatch.setattr(socket.socket, name, refuse)
    for name in ("getaddrinfo", "gethostbyname", "create_connection"):
        monkeypatch.setattr(socket, name, refuse)


@pytest.mark.slow  # every kind of command
@pytest.mark.usefixtures("no_network")
def test_only_the_run_directory_is_written_and_nobody_is_called(
    tmp_path: Path, small_recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, variable in (("home", "HOME"), ("tmp", "TMPDIR")):
        (tmp_path / name).mkdir()
        monkeypatch.setenv(variable, str(tmp_path / name))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    before = {path: path.stat().st_mtime_ns for path in small_recording.iterdir()}
    command = ("run", small_recording, "--pose-graph", "--rerun", "save", "--pcd", "--odometry", "constant-velocity")
    succeeds(*command, "--out", tmp_path / "run")
    succeeds("evaluate", tmp_path / "run")
    succeeds("view", tmp_path / "run", "--picture", tmp_path / "run" / "map.png")
    succeeds("compare", small_recording, "--methods", "constant-velocity+map", "--out", tmp_path / "compared")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["compared", "here", "home", "run", "tmp"]
    assert [path for name in ("here", "home", "tmp") for path in (tmp_path / name).rglob("*")] == []
    assert {path: path.stat().st_mtime_ns for path in small_recording.iterdir()} == before


def test_rerun_is_told_not_to_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    succeeds("config")
    assert os.environ.get("CI")
    assert "FORCE_RERUN_ANALYTICS" not in os.environ


def test_names_in_a_recording_do_not_steer_the_terminal(tmp_path: Path, small_recording: Path) -> None:
    source = tmp_path / "e\x1b]0;owned\x07\u202e\nnote  all is well"
    source.mkdir()
    np.save(source / "000000.npy", np.load(small_recording / "000000.npy"))
    said = succeeds("info", source)
    assert "\x1b" not in said
    assert "\\x1b]0;owned\\x07\\u202e\\nnote" in said
    assert not [line for line in said.splitlines() if line.startswith("note  all is well")]
