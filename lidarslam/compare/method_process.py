"""One method of a comparison in a process of its own: a run that reports its progress.

The arguments are the working directory, the peer's name or nothing, its maximum range or nothing, and the request as
JSON. After every scan a line goes to standard output: its number from 1, and the total. Libraries' output goes
to standard error. The exit status is that of `lidarslam run`.
"""

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pydantic import TypeAdapter

from lidarslam.compare.peers.estimation import execute_peer
from lidarslam.compare.peers.registry import peer_named
from lidarslam.core.errors import LidarSlamError
from lidarslam.run.request import RunRequest
from lidarslam.run.results import RunOutcome
from lidarslam.run.run import execute

STOPPED, LOST = 1, 3
_PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>
_REQUEST = TypeAdapter(RunRequest)


@dataclass(frozen=True)
class MethodRun:
    """One method on one recording."""

    request: RunRequest  # into the directory with the method's name
    peer: str | None = None  # the peer that estimates the poses
    range_m: float | None = None  # maximum range of the peer by the size of the scene

    @property
    def name(self) -> str:
        """Of the method."""
        return self.request.out.name


def encode(run: MethodRun) -> tuple[str, str, str, str]:
    """The arguments; the run overwrites, and saves no state and draws no page, which would count as its time."""
    request = replace(run.request, overwrite=True, resumable=False, report=False)
    return str(Path.cwd()), run.peer or "", str(run.range_m or ""), _REQUEST.dump_json(request).decode()


def main() -> int:
    """Run; the exit status."""
    folder, peer, range_m, request = sys.argv[1:]
    os.chdir(folder)
    _obey_parent()
    with os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8") as progress:
        os.dup2(2, 1)
        try:
            count = partial(print, file=progress)
            outcome = _run(_REQUEST.validate_json(request), peer, float(range_m) if range_m else None, count)
        except LidarSlamError as error:
            print(f"lidarslam: {error}", file=sys.stderr)
            return STOPPED
    if outcome.stopped is not None:
        print(f"lidarslam: stopped after {outcome.summary.scans} scans: {outcome.stopped}", file=sys.stderr)
        return STOPPED
    return LOST if outcome.summary.went_astray else 0


def _obey_parent() -> None:
    """End with the supervisor, however that ends (Linux), and take its Ctrl-C, which processes of Ray block."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])


def _run(request: RunRequest, peer: str, range_m: float | None, progress: Callable[[int, int], None]) -> RunOutcome:
    if peer:
        return execute_peer(request, peer_named(peer), progress, range_m)
    return execute(request, lambda number, total, _: progress(number, total))


if __name__ == "__main__":
    sys.exit(main())
