"""Methods side by side: the folder of a serial comparison but for times, here and on a cluster that loses a node."""

import json
import os
import re
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from lidarslam.compare.comparison import CompareOutcome, compare
from lidarslam.compare.methods import parse_methods
from lidarslam.compare.plan import CompareRequest, RecordingEntry
from lidarslam.core.tasks import SERIAL, Where

from ..conftest import lidarslam
from .conftest import Told

pytest.importorskip("ray")

METHODS = "constant-velocity+map,learned+map,prior"
# The files of a run that hold times, or the memory that was taken.
TIMED = {"summary.json", "scans.csv", "process.json", "process.log"}

# Each start of a method is a line in the file; what it does then depends on its name and on how often it was started.
COUNTED = """
import json, os, signal, sys, time
from pathlib import Path
signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
log, request = Path(sys.argv[1]), json.loads(sys.argv[-1])["request"]
name = Path(request["out"]).name
with log.open("a") as file: file.write(f"{name} {os.getppid()} {os.getpid()}\\n")
starts = sum(line.startswith(f"{name} ") for line in log.read_text().splitlines())
if name.startswith("learned") and starts == 1 and sys.argv[2] == "wait": time.sleep(120)
os.execv(sys.executable, [sys.executable, "-m", "lidarslam.compare.method_run", *sys.argv[3:]])
"""


def _compare(recording: Path, out: Path, where: Where, told: Told, *command: str, **changes: Any) -> CompareOutcome:
    entry = RecordingEntry(recording, prior=recording / "ground_truth.tum")
    request = CompareRequest(out, (entry,), parse_methods(METHODS), where=where, **changes)
    return compare(request, told.narrator, *((command,) if command else ()))


def _contents(out: Path) -> dict[str, Any]:
    """Every file of a comparison, times apart."""
    files: dict[str, Any] = {}
    for path in (path for path in sorted(out.rglob("*")) if path.is_file()):
        name = str(path.relative_to(out))
        files[name] = None if path.name in TIMED or path.name.startswith("report") else path.read_bytes()
    content = json.loads((out / "comparison.json").read_text())
    for method in content["methods"].values():
        for key in [key for key in method if "ms" in key.split("_") or key in ("peak_rss_mb", "wall_s")]:
            method.pop(key)
    files["comparison.json"] = content
    rows = [row.split(",") for row in (out / "room" / "learned+map" / "scans.csv").read_text().splitlines()]
    timed = [column for column, title in enumerate(rows[0]) if re.search(r"(^|_)ms($|_)", title)]
    files["rows"] = [[cell for column, cell in enumerate(row) if column not in timed] for row in rows]
    return files


@pytest.fixture(scope="module")
def serial(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The comparison of one method after another."""
    out = tmp_path_factory.mktemp("compared") / "serial"
    _compare(small_recording, out, SERIAL, Told())
    return _contents(out)


@pytest.fixture
def counted(tmp_path: Path) -> tuple[str, str, str]:
    """The process of a method, whose starts are lines in `starts`."""
    file = tmp_path / "counted.py"
    file.write_text(COUNTED)
    return sys.executable, str(file), str(tmp_path / "starts")


def _starts(tmp_path: Path) -> list[list[str]]:
    file = tmp_path / "starts"
    return [line.split() for line in file.read_text().splitlines()] if file.exists() else []


def _wait_for(condition: Any, seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.05)


@pytest.mark.slow
def test_side_by_side_is_the_same_as_one_after_another(
    small_recording: Path, tmp_path: Path, serial: dict[str, Any], told: Told
) -> None:
    _compare(small_recording, tmp_path / "out", Where(2), told)
    assert _contents(tmp_path / "out") == serial
    assert told.counts[-1][1:] == (18, 18)
    assert len(told.lines) == 3
    again = Told()
    none = (sys.executable, "-c", "raise SystemExit('was run again')")
    _compare(small_recording, tmp_path / "out", Where(2), again, *none, reuse=True)
    assert all("in an earlier comparison" in line for line in again.lines)
    assert _contents(tmp_path / "out") == serial


@pytest.mark.slow
def test_a_node_that_dies_costs_only_its_tasks(
    small_recording: Path, tmp_path: Path, serial: dict[str, Any], counted: tuple[str, ...]
) -> None:
    """Two nodes with a CPU each; that with `learned+map` at work is killed."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    died: list[int] = []

    def kill() -> None:
        """The node whose raylet is the parent of the worker that started the method."""
        import psutil

        _wait_for(lambda: any(name == "learned+map" for name, *_ in _starts(tmp_path)))
        _, worker, process = next(start for start in _starts(tmp_path) if start[0] == "learned+map")
        raylet = psutil.Process(int(worker)).ppid()
        _wait_for(lambda: len({name for name, *_ in _starts(tmp_path)}) == 3)
        doomed = next(n for n in nodes if any(p.process.pid == raylet for p in n.all_processes["raylet"]))
        cluster.remove_node(doomed, allow_graceful=False)
        died.append(int(process))

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    try:
        command = (*counted, "wait")
        _compare(small_recording, tmp_path / "out", Where(cluster=cluster.address), Told(), *command)
        killer.join(60.0)
    finally:
        cluster.shutdown()
    assert died
    assert sorted(name for name, *_ in _starts(tmp_path)) == sorted([*METHODS.split(","), "learned+map"])
    assert _contents(tmp_path / "out") == serial
    assert not Path(f"/proc/{died[0]}").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_ends_all_methods_and_writes_what_there_is(
    small_recording: Path, tmp_path: Path, counted: tuple[str, ...], told: Told
) -> None:
    def interrupt() -> None:
        _wait_for(lambda: any("prior" in line for line in told.lines) and len(_starts(tmp_path)) == 3)
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    outcome = _compare(small_recording, tmp_path / "out", Where(2), told, *counted, "wait")
    assert outcome.interrupted
    rows = {row.name: row.status for row in outcome.comparison.sequences[0].methods}
    assert rows == {"constant-velocity+map": "ok", "learned+map": "not run", "prior": "ok"}
    assert json.loads((tmp_path / "out" / "comparison.json").read_text())["notes"][0].startswith("interrupted")
    assert not any(Path(f"/proc/{process}").exists() for _, _, process in _starts(tmp_path))


@pytest.mark.slow
def test_a_simulated_recording_is_the_same_to_the_byte(tmp_path: Path) -> None:
    for jobs in ("1", "2"):
        out = tmp_path / jobs / "walk"
        command = ["simulate", "--out", str(out), "--scans", "23", "--format", "ply", "--jobs", jobs]
        result = lidarslam(*command)
        assert result.exit_code == 0, result.output
    one, two = (
        {path.name: path.read_bytes() for path in (tmp_path / jobs / "walk").iterdir() if path.name != "README.md"}
        for jobs in ("1", "2")
    )
    assert len(one) == 26
    assert one == two
