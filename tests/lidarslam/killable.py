"""Commands that are killed on their way."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]

# Loads the program once, and for every line forks a command of it; told to, that kills itself without notice as it is
# about to do something to its directory. It counts what it does there, and may keep what lies there before each of
# these things, which is what a run that is killed then leaves.
SERVER = """
import json, os, shutil, signal, sys, threading
from pathlib import Path
import lidarslam.viewer.rerun_recording, lidarslam.run.run, lidarslam.merge.merge
import lidarslam.mapping.global_map.point_cloud, lidarslam.mapping.pose_graph.slam_graph
import lidarslam.odometry.methods.learned
from lidarslam.cli import main

EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "fsync"}

def run(order):
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    count, busy = 0, threading.local()

    def see(event, args):
        nonlocal count
        if event not in EVENTS or not (event == "fsync" or str(args[0]).startswith(order["out"])):
            return
        if hasattr(busy, "copying"):
            return
        count += 1
        if order["keep_in"] is not None and os.path.isdir(order["out"]):
            busy.copying = True
            shutil.copytree(order["out"], os.path.join(order["keep_in"], str(count)))
            del busy.copying
        if count == order["kill_at"]:
            os.kill(os.getpid(), signal.SIGKILL)

    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.addaudithook(see)
    fsync = os.fsync
    os.fsync = lambda handle: (see("fsync", ()), fsync(handle))[1]
    status = 0
    try:
        main(order["arguments"])
    except SystemExit as end:
        status = end.code or 0
    Path(order["log"] + ".count").write_text(str(count))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)

print("ready", flush=True)
for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        run(json.loads(line))
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


@dataclass(frozen=True)
class Ended:
    status: int
    said: str
    events: int


@contextmanager
def serving(log: Path) -> Iterator[Callable[..., Ended]]:
    """Carries out `lidarslam ... --out OUT`, killed at some event if one is given."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command, pipe = [sys.executable, "-c", SERVER], subprocess.PIPE
    server = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment, cwd=ROOT)
    assert server.stdout.readline() == "ready\n"

    def carry_out(
        *arguments: object,
        out: Path,
        kill_at: int | None = None,
        keep_in: Path | None = None,
    ) -> Ended:
        order = {
            "arguments": [*map(str, arguments), "--out", str(out)],
            "out": str(out),
            "log": str(log),
            "kill_at": kill_at,
            "keep_in": None if keep_in is None else str(keep_in),
        }
        count = Path(f"{log}.count")
        count.unlink(missing_ok=True)
        server.stdin.write(json.dumps(order) + "\n")
        server.stdin.flush()
        status = int(server.stdout.readline())
        events = int(count.read_text()) if count.is_file() else -1
        return Ended(status, log.read_text(), events)

    yield carry_out
    server.stdin.close()
    server.wait()
