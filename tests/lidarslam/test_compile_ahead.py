"""Loops are compiled ahead: those of a run, for the types that it calls them with, by processes that end."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from lidarslam.config.settings import load_config
from lidarslam.pipeline import compile_ahead
from lidarslam.pipeline.compile_ahead import PARTS, CompileAhead, parts_of

from ..conftest import write_recording

REPOSITORY = Path(__file__).parents[2]
# Loops that only some runs need, and that take no more than a second to compile.
LEFT_OUT = {
    "lidarslam.core.thinning",
    "lidarslam.mapping.surfels.symmetric",
    "lidarslam.mapping.registration.gauss_newton",  # of loop closures; within a registration it is a part
    "lidarslam.mapping.global_map.occupancy_grid",  # of export-grid, which is no part of a run
}
# Rehearse everything, take a recording through the pipeline, and print the loops that are called with other types.
REHEARSE_AND_RUN = """
import gc, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from lidarslam.config.settings import load_config
from lidarslam.pipeline.compile_ahead import PARTS, main
from lidarslam.run.request import RunRequest
from lidarslam.run.run import execute

def called():
    loops = (o for o in gc.get_objects() if isinstance(o, Dispatcher) and o.py_func.__module__.startswith("lidarslam"))
    kept = (o for o in loops if hasattr(o._cache, "has_overloads"))
    return {(o.py_func.__module__, o.py_func.__name__): set(o.overloads) for o in kept}

main(list(PARTS))
before = called()
modules = {f"lidarslam.{module}" for part in PARTS.values() for module in part.modules}
for loop, types in before.items():
    if loop[0] in modules and not types:
        print("not rehearsed", *loop)
for method in ("surfels", "loam"):
    config = load_config(None, [f"mapping.method={method}"])
    execute(RunRequest(Path(sys.argv[1]), Path(sys.argv[2]), config, overwrite=True), lambda *_: None)
for loop, types in called().items():
    if types - before.get(loop, set()):
        print("other types", *loop, types)
"""


@pytest.mark.long
def test_a_rehearsal_compiles_all_that_a_run_calls(tmp_path, room, drive):
    folder = write_recording(tmp_path / "scans", [room.ring_sweep(drive, 0.1 * number) for number in range(1, 5)])
    command = [sys.executable, "-c", REHEARSE_AND_RUN, str(folder), str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert not done.stdout, done.stdout


def test_every_file_with_compiled_loops_belongs_to_a_part():
    sources = [path for top in ("odometry", "mapping", "lidarslam") for path in (REPOSITORY / top).rglob("*.py")]
    with_loops = {path for path in sources if "\n@compiled\n" in path.read_text(encoding="utf-8")}
    paths = [path.relative_to(REPOSITORY).with_suffix("").parts for path in with_loops]
    names = {".".join(parts if parts[0] == "lidarslam" else ("lidarslam", *parts)) for parts in paths}
    in_parts = {f"lidarslam.{module}" for part in PARTS.values() for module in part.modules}
    assert names - LEFT_OUT == in_parts


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        ([], ["surfels", "alignment", "images", "reading", "map", "checks"]),
        (["mapping.method=loam", "odometry.method=kiss-icp"], ["loam", "reading", "map", "checks"]),
        (["mapping.method=off", "odometry.method=kiss-icp"], ["reading", "map", "checks"]),
    ],
)
def test_a_run_compiles_the_parts_that_it_uses(settings, parts):
    assert parts_of(load_config(None, settings)) == parts


class Popen(subprocess.Popen[bytes]):
    code = "import time; time.sleep(60)"

    def __init__(self, command: list[str], **options: object) -> None:
        super().__init__([command[0], "-c", self.code], **options)


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compile_ahead, "uncompiled", lambda names: names)
    monkeypatch.setattr(subprocess, "Popen", Popen)


@pytest.mark.usefixtures("uncompiled")
def test_an_interruption_ends_the_processes():
    def interrupt(_: str) -> None:
        raise KeyboardInterrupt

    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), CompileAhead(parts_of(load_config(None, []))) as compiling:
        compiling.wait(interrupt)
    assert compiling._running
    assert all(process.poll() is not None for process in compiling._running)
    assert time.monotonic() - started < 50.0  # they would sleep for 60 s


@pytest.mark.usefixtures("uncompiled")
def test_a_process_that_fails_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(Popen, "code", "raise SystemExit(1)")
    lines: list[str] = []
    with CompileAhead(parts_of(load_config(None, []))) as compiling:
        compiling.wait(lines.append)
    assert lines[0] == "compiling loops, once on this machine (0 of 6)"


def test_nothing_is_waited_for_once_all_is_compiled(monkeypatch):
    monkeypatch.setattr(compile_ahead, "is_compiled", lambda _: True)
    with CompileAhead(parts_of(load_config(None, []))) as compiling:
        compiling.wait(pytest.fail)
    assert not compiling._running
