"""`view --web` and `run --rerun web` serve until they are told to end, and end well."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.request import urlopen

import psutil
import pytest

from lidarslam.viewer.rerun_recording import require_complete

pytestmark = pytest.mark.usefixtures("interruptible")
Serve = Callable[..., "tuple[subprocess.Popen[str], str]"]


@pytest.fixture
def serve() -> "Iterator[Serve]":
    """Starts a command; it and the address that it prints."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: object) -> "tuple[subprocess.Popen[str], str]":
        command = [sys.executable, "-m", "lidarslam", *map(str, arguments)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:"), address
        return process, address

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.long
@pytest.mark.parametrize("request_to_end", [signal.SIGINT, signal.SIGTERM])
def test_a_view_ends_well(serve: Serve, finished_run: Path, request_to_end: signal.Signals) -> None:
    process, address = serve("view", finished_run, "--web")
    with urlopen(f"{address}/recording.rrd", timeout=120) as recording:
        assert recording.read(4) == b"RRF2"
    assert psutil.Process(process.pid).children(recursive=True) == []  # nothing to leave behind, however it ends
    process.send_signal(request_to_end)
    out, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, "")
    assert "Aborted" not in out


@pytest.mark.long
def test_a_run_is_served_while_it_goes_on_and_afterwards(serve: Serve, small_recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    process, address = serve("run", small_recording, "--out", out, "--odometry", "constant-velocity", "--rerun", "web")
    with urlopen(f"{address}/recording.rrd", timeout=300) as recording:
        seen = recording.read()
    assert process.stdout is not None
    lines = []
    while "until Ctrl-C; later" not in (line := process.stdout.readline()):
        assert line or process.poll() is None, "ended early"
        lines.append(line)
    assert "written to" in "".join(lines)
    require_complete(out / "recording.rrd")
    assert seen == (out / "recording.rrd").read_bytes()
    assert f"lidarslam view {out / 'recording.rrd'} --web" in line
    with urlopen(f"{address}/?url=there", timeout=120) as page:
        assert page.status == 200
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, "")


@pytest.mark.long
def test_a_run_that_is_interrupted_does_not_stay(serve: Serve, small_recording: Path, tmp_path: Path) -> None:
    process, _ = serve("run", small_recording, "--out", tmp_path / "run", "--rerun", "web")
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode == 1
