"""Runs in Rerun: files written through a pipe, windows and pages on this machine alone, served until told to end."""

import ast
import http.client
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit
from urllib.request import urlopen

import numpy as np
import psutil
import pytest

from lidarslam.config.settings import ViewerConfig, load_config
from lidarslam.core.errors import OutputError
from lidarslam.core.trajectory import Trajectory
from lidarslam.run.request import RunRequest
from lidarslam.run.run import execute
from lidarslam.storage.finished_run import FinishedRun
from lidarslam.viewer import rerun_environment, rerun_program, rerun_recording
from lidarslam.viewer.rerun_program import WebPage, is_taken, open_window, served_page
from lidarslam.viewer.rerun_scenes import show_runs

from .conftest import files_no_longer_than

LISTENER = """#!/usr/bin/env python3
import os, socket, sys, time
from pathlib import Path
given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
Path(__file__).with_name("pid").write_text(str(os.getpid()))
Path(__file__).with_name("told").write_text(repr(dict(os.environ)))
with socket.create_server((given["--bind"], int(given["--port"]))):
    time.sleep(60)
"""
INDEX = b"""<html><link rel="icon" href="favicon.ico" />
<link rel="preconnect" href="https://fonts.gstatic.com" crossorigin />
<link
  href="//fonts.googleapis.com/css2?family=Inter"
  rel="stylesheet"
/><script src="re_viewer.js"></script></html>"""


@pytest.mark.parametrize("size", [0, 1_000, 100_000])
def test_a_full_disk_neither_holds_a_run_nor_leaves_half_a_recording(tmp_path, monkeypatch, size):
    """Rerun's own writer is never told, because it may wait without end then; the room it took is given back."""
    monkeypatch.setattr(rerun_environment, "abandoned", False)
    begun = time.monotonic()
    with (
        files_no_longer_than(size),
        pytest.raises(rerun_recording.IncompleteRecordingError, match="is the disk full"),
        rerun_recording.rerun_viewer("run", ViewerConfig(), tmp_path / "recording.rrd") as viewer,
    ):
        for seed in range(20):
            viewer.show_map(np.random.default_rng(seed).normal(size=(5_000, 3)))
    assert time.monotonic() - begun < 10
    assert (tmp_path / "recording.rrd").stat().st_size == 0
    assert not rerun_environment.abandoned


def test_no_display_gets_one_line_and_ends_a_run_before_it_begins(monkeypatch, small_recording, tmp_path):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("lidarslam.viewer.rerun_program.is_taken", lambda _: False)
    trajectory = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    finished = FinishedRun("my run", trajectory, np.zeros(3, dtype=np.bool_), np.eye(3), np.array([[0, 2]]))
    with pytest.raises(OutputError, match=r"no display .* --save FILE\.rrd, or use --web"):
        rerun_recording.show_in_window(show_runs([finished], None, ViewerConfig()))
    rerun_recording.save(show_runs([finished], None, ViewerConfig()), tmp_path / "runs.rrd")
    with pytest.raises(OutputError, match=r"no display .* --web"):
        rerun_recording.show_file_in_window(tmp_path / "runs.rrd")
    request = RunRequest(small_recording, tmp_path / "run", load_config(None), rerun="spawn")
    with pytest.raises(OutputError, match=r"no display .* --rerun web, .* --rerun save"):
        execute(request, lambda *_: None)
    assert not (tmp_path / "run").exists()


@pytest.fixture
def port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def assert_on_this_machine_alone(port: int) -> None:
    """A server on all interfaces would be there on each address of the loopback; one on 127.0.0.1 is on that alone."""
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.2", port)) != 0


def pretend(monkeypatch: pytest.MonkeyPatch, program: Path, text: str) -> None:
    program.write_text(text)
    program.chmod(0o755)
    monkeypatch.setattr("lidarslam.viewer.rerun_program._program", lambda: str(program))


def test_a_window_listens_on_this_machine_alone_and_is_kept_from_the_network(tmp_path, monkeypatch, port):
    """It asks for a newer version by way of a proxy: one that is not there."""
    proxies = ("ALL_PROXY", "all_proxy", "HTTPS_PROXY", "https_proxy")
    for name in proxies[::2]:
        monkeypatch.setenv(name, "http://elsewhere.example:3128")
    pretend(monkeypatch, tmp_path / "rerun", LISTENER)
    open_window(port)
    try:
        assert is_taken(port)
        assert_on_this_machine_alone(port)
        before = (tmp_path / "pid").read_text()
        open_window(port)  # which is open
        assert (tmp_path / "pid").read_text() == before
    finally:
        os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)
    environment = ast.literal_eval((tmp_path / "told").read_text())
    assert {environment[name] for name in proxies} == {"http://127.0.0.1:1"}


def test_a_window_that_never_listens_is_ended(tmp_path, monkeypatch, port):
    monkeypatch.setattr("lidarslam.viewer.rerun_program._START_S", 1.0)
    pretend(monkeypatch, tmp_path / "rerun", f"#!/bin/sh\necho $$ > {tmp_path}/pid\nexec sleep 60\n")
    begun = time.monotonic()
    with pytest.raises(OutputError, match="cannot be opened"):
        open_window(port)
    assert time.monotonic() - begun < 20
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


@pytest.fixture
def page() -> Iterator[WebPage]:
    page = WebPage({"/": INDEX, "/re_viewer.js": b"// viewer"})
    yield page
    page.close()


def get(page: WebPage, path: str, host: str | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(page.address).port or 0, timeout=20)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


def test_the_page_may_load_from_its_own_server_alone(page):
    for path in ("/?url=there", "/re_viewer.js", "/"):
        policy = get(page, path).headers["Content-Security-Policy"]
        assert {"default-src 'none'", "connect-src 'self'"} <= {part.strip() for part in policy.split(";")}
        assert "*" not in policy
        assert "http" not in policy
    # A policy does not keep a browser from connecting in advance.
    body = get(page, "/?url=there").read()
    assert b"gstatic" not in body
    assert b"googleapis" not in body
    assert b'href="favicon.ico"' in body
    assert b"re_viewer.js" in body


def test_the_viewer_is_reruns_own():
    """Whatever its page names of elsewhere is not loaded, or only when clicked."""
    with served_page(lambda _: None) as page:
        body = get(page, "/?url=there").read().decode()
        assert not re.search(r"<link[^>]*(https?:)?//", body)
        for script in re.findall(r"<script[^>]*src=\"([^\"]+)\"", body):
            assert get(page, f"/{script}").status == 200
        assert get(page, "/re_viewer_bg.wasm").read(4) == b"\0asm"


def test_a_recording_is_shown_while_it_is_written(page, tmp_path):
    announced: list[str] = []
    page._announce = announced.append
    path = tmp_path / "recording.rrd"
    with path.open("wb", buffering=0) as file, page.showing(path):
        assert announced == [page.address]
        file.write(b"begun, ")
        early = get(page, "/recording.rrd")
        assert early.read(7) == b"begun, "
        file.write(b"continued, ")
        assert early.read(11) == b"continued, "
        path.rename(tmp_path / "renamed.rrd")  # as a run does at its end
        file.write(b"ended")
    assert early.read() == b"ended"
    assert get(page, "/recording.rrd").read() == b"begun, continued, ended"


def test_the_recording_is_found_at_the_end_of_a_tunnel_but_not_by_a_name_made_to_point_here(page):
    """Otherwise any page in the browser could read the recording."""
    response = get(page, "/", "localhost:1234")
    assert response.status == 302
    asked = parse_qs(urlsplit(response.headers["Location"]).query)
    assert asked["url"] == ["http://localhost:1234/recording.rrd"]
    assert get(page, "/recording.rrd", "elsewhere.example:9090").status == 403
    assert get(page, "/", "elsewhere.example").status == 403


def test_this_machine_alone_is_served_from_a_port_that_is_free(page, monkeypatch):
    taken = urlsplit(page.address).port
    assert_on_this_machine_alone(taken or 0)
    other = WebPage({"/": INDEX})
    other.close()
    assert urlsplit(other.address).port != taken
    monkeypatch.setattr(rerun_program, "_PORTS", [taken])
    with pytest.raises(OutputError, match=f"{taken}.* in use"):
        WebPage({"/": INDEX})


Serve = Callable[..., "tuple[subprocess.Popen[str], str]"]


@pytest.fixture
def serve() -> "Iterator[Serve]":
    """Starts a command; it and the address that it prints."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: object) -> "tuple[subprocess.Popen[str], str]":
        command = [sys.executable, "-m", "lidarslam", *map(str, arguments)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(process)
        address = process.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:"), address
        return process, address

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.long
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("request_to_end", [signal.SIGINT, signal.SIGTERM])
def test_a_view_ends_well(serve, finished_run, request_to_end):
    process, address = serve("view", finished_run, "--web")
    with urlopen(f"{address}/recording.rrd", timeout=120) as recording:
        assert recording.read(4) == b"RRF2"
    assert psutil.Process(process.pid).children(recursive=True) == []  # nothing to leave behind, however it ends
    process.send_signal(request_to_end)
    out, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, "")
    assert "Aborted" not in out


@pytest.mark.long
@pytest.mark.usefixtures("interruptible")
def test_a_run_is_served_while_it_goes_on_and_afterwards(serve, small_recording, tmp_path):
    out = tmp_path / "run"
    process, address = serve("run", small_recording, "--out", out, "--odometry", "constant-velocity", "--rerun", "web")
    with urlopen(f"{address}/recording.rrd", timeout=300) as recording:
        seen = recording.read()
    lines = []
    while "until Ctrl-C; later" not in (line := process.stdout.readline()):
        assert line or process.poll() is None, "ended early"
        lines.append(line)
    assert "written to" in "".join(lines)
    rerun_recording.require_complete(out / "recording.rrd")
    assert seen == (out / "recording.rrd").read_bytes()
    assert f"lidarslam view {out / 'recording.rrd'} --web" in line
    with urlopen(f"{address}/?url=there", timeout=120) as page:
        assert page.status == 200
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, "")


@pytest.mark.long
@pytest.mark.usefixtures("interruptible")
def test_a_run_that_is_interrupted_does_not_stay(serve, small_recording, tmp_path):
    process, _ = serve("run", small_recording, "--out", tmp_path / "run", "--rerun", "web")
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode == 1
