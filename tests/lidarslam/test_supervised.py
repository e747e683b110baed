"""Commands that crash, hang, eat memory, and leave children behind."""

import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from lidarslam.compare.method_run import Ending, Limits, supervise

Run = Callable[..., Ending]


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def run(tmp_path: Path, lines: list[str]) -> Run:
    """Supervise a few lines of Python."""

    def supervised(code: str, **limits: float) -> Ending:
        return supervise([sys.executable, "-c", code], tmp_path / "log", Limits(**limits), lines.append)

    return supervised


def test_lines_come_through_and_standard_error_is_kept(run: Run, lines: list[str], tmp_path: Path) -> None:
    ending = run("import sys; print('1 2'); print('2 2'); print('oh', file=sys.stderr); sys.exit(3)")
    assert (ending.cause, ending.status, lines) == ("itself", 3, ["1 2", "2 2"])
    assert (tmp_path / "log").read_text() == "oh\n"


def test_time_and_the_memory_of_all_processes_are_measured(run: Run) -> None:
    child = "import time; held = bytearray(100_000_000); held[::4096] = b'x' * len(held[::4096]); time.sleep(0.8)"
    ending = run(f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])")
    assert 0.8 < ending.wall_s < 10.0
    assert ending.peak_rss_mb is not None
    assert 100.0 < ending.peak_rss_mb < 300.0


def test_one_that_hangs_is_ended_with_its_children(
    run: Run, lines: list[str], still_runs: Callable[[int], bool]
) -> None:
    code = "import subprocess, time; print(subprocess.Popen(['sleep', '60']).pid, flush=True); time.sleep(60)"
    ending = run(code, timeout_s=1.0)
    assert (ending.cause, ending.status) == ("time", -signal.SIGKILL)
    assert ending.wall_s < 10.0
    assert not still_runs(int(lines[0]))


def test_one_that_eats_memory_is_ended(run: Run) -> None:
    code = "import time; held = []\nwhile True: held.append(b'x' * 10_000_000); time.sleep(0.02)"
    ending = run(code, memory_mb=150.0, timeout_s=30.0)
    assert ending.cause == "memory"
    assert ending.peak_rss_mb is not None
    assert 150.0 < ending.peak_rss_mb < 2000.0


@pytest.mark.usefixtures("interruptible")
def test_an_interruption_is_passed_on_and_waited_for(run: Run, tmp_path: Path) -> None:
    mark = tmp_path / "written"
    code = f"""
import time
try:
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(0.3)
    open({str(mark)!r}, "w").close()
"""
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    assert run(code).cause == "interrupt"
    assert mark.exists()
