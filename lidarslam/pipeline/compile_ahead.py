"""On a machine's first run: loops are compiled side by side in other processes, and kept on disk for this one.

A process compiles one function at a time; one for each part of the pipeline makes use of the other cores. After an
installation, `python -m lidarslam.pipeline.compile_ahead` compiles all parts, so that the first run need not.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Self

from lidarslam.config.settings import Config
from lidarslam.core.compiled import is_compiled
from lidarslam.core.tasks.bound import bound
from lidarslam.pipeline.rehearsal import PARTS

# The processes start here, so that no package in the user's folder is found first.
_ROOT = Path(__file__).resolve().parents[2]


def parts_of(config: Config) -> list[str]:
    """The names of the parts whose loops a run needs."""
    needed = {"reading", "map", "checks"} | ({"images", "alignment"} if config.odometry.is_learned else set())
    if config.mapping.enabled:
        needed.add(config.mapping.method)
    return [name for name in PARTS if name in needed]


def uncompiled(names: list[str]) -> list[str]:
    """Those of the parts with a loop that is not on disk."""
    modules = {name: [import_module(f"lidarslam.{module}") for module in PARTS[name].modules] for name in names}
    return [name for name in names if not all(is_compiled(module) for module in modules[name])]


class CompileAhead:
    """Compiles the loops that are not on disk yet; a context that ends its processes.

    What fails to compile here is compiled in this process, on its first call.

    Args:
        parts: names of the parts whose loops are compiled.
    """

    def __init__(self, parts: list[str]) -> None:
        self._parts = uncompiled(parts)
        self._running: list[subprocess.Popen[bytes]] = []
        self._is_closed = False
        self._pool = ThreadPoolExecutor(max_workers=_cores(), thread_name_prefix="compile")
        self._done: dict[str, Future[None]] = {part: self._pool.submit(self._compile, part) for part in self._parts}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_closed = True
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in self._running:
            process.kill()
        self._pool.shutdown()

    def wait_for_first_scan(self, report: Callable[[str], None]) -> None:
        """Wait for the loops that the first scan needs; `report` is given a line on what is waited for."""
        self._wait([part for part in self._parts if not PARTS[part].is_late], report)

    def wait_for_all(self, report: Callable[[str], None]) -> None:
        """Wait for the others too."""
        self._wait(self._parts, report)

    def _wait(self, parts: list[str], report: Callable[[str], None]) -> None:
        pending = {self._done[part] for part in parts}
        while pending:
            report(f"compiling loops, once on this machine ({len(parts) - len(pending)} of {len(parts)})")
            _, pending = wait(pending, return_when=FIRST_COMPLETED)

    def _compile(self, part: str) -> None:
        command = [sys.executable, "-m", "lidarslam.pipeline.rehearsal", part]
        none = subprocess.DEVNULL
        process = subprocess.Popen(command, cwd=_ROOT, stdin=none, stdout=none, stderr=none, start_new_session=True)
        with bound(process):
            self._running.append(process)
            if self._is_closed:
                process.kill()
            process.wait()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1  # not on macOS


def main() -> None:
    """Compile everything."""
    with CompileAhead(list(PARTS)) as compiling:
        compiling.wait_for_all(print)


if __name__ == "__main__":
    main()
