"""Processes end with the one that started them, however it ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SLEEP = "import time; time.sleep(60)"
# Print its own process and that of its child, and sleep.
FAMILY = f"""
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", {SLEEP!r}])
print(os.getpid(), child.pid, flush=True)
time.sleep(60)
"""
# What a comparison, a first run, and a run with KISS-ICP start, as `PARENT` starts it; each prints processes.
SUPERVISED = f"""
from pathlib import Path
from lidarslam.compare.method_run import Limits, supervise
supervise([sys.executable, "-c", {FAMILY!r}], Path(os.devnull), Limits(), lambda line: print(line, flush=True))
"""
COMPILING = """
import subprocess
from lidarslam.pipeline import compile_ahead
compile_ahead.uncompiled = lambda names: names
started = subprocess.Popen
def start(command, **options):
    if "-m" in command:
        command = [sys.executable, "-c", "import time; time.sleep(60)"]
    process = started(command, **options)
    if "-c" in command and command[0] == sys.executable:
        print(process.pid, flush=True)
    return process
subprocess.Popen = start
with compile_ahead.CompileAhead(["map"]):
    time.sleep(60)
"""
KISS = """
from lidarslam.odometry.config import KissConfig
from lidarslam.odometry.methods.kiss import KissOdometry
print(KissOdometry(KissConfig())._worker._process.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("killed_by", [signal.SIGKILL, pytest.param(signal.SIGHUP, marks=pytest.mark.long)])
@pytest.mark.parametrize("code", [SUPERVISED, COMPILING, KISS], ids=["supervised", "compiling", "kiss"])
def test_who_is_killed_leaves_no_process_behind(code, killed_by, still_runs):
    paths = os.environ | {"PYTHONPATH": str(ROOT)}
    # Under nohup, a hang-up would be ignored.
    start = "import os, signal, sys, time; signal.signal(signal.SIGHUP, signal.SIG_DFL)"
    command = [sys.executable, "-c", f"{start}\n{code}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=paths, start_new_session=True) as parent:
        children = [int(word) for word in parent.stdout.readline().split()]
        assert children
        time.sleep(0.2)  # until it is watched
        parent.send_signal(killed_by)
    assert not [child for child in children if still_runs(child)]
