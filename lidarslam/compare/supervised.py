"""A command in a session of its own under supervision: its time, the memory of all its processes, how it ended."""

import contextlib
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import psutil

from lidarslam.core.files import open_own
from lidarslam.core.tasks import bound

# Between two samples of the memory; a sample costs a millisecond or two of a core.
_PERIOD_S = 0.2
# For an interrupted command to write its results.
_GRACE_S = 60.0

Cause = Literal["itself", "memory", "time", "interrupt"]


@dataclass(frozen=True)
class Limits:
    """Limits of a command; None: no limit."""

    memory_mb: float | None = None  # resident memory of all its processes together
    timeout_s: float | None = None  # wall time


@dataclass(frozen=True)
class Ending:
    """How a command ended."""

    cause: Cause  # by itself, or because a limit or an interruption ended it
    status: int  # its exit status, negative for the signal that ended it
    wall_s: float  # from its start to its end
    # largest resident memory of its process tree, sampled five times a second, units of 1024 x 1024 bytes; shared pages
    # count for each process. None where no sample was taken.
    peak_rss_mb: float | None


def supervise(
    command: Sequence[str], log: Path, limits: Limits, on_line: Callable[[str], None], cwd: Path | None = None
) -> Ending:
    """Run a command to its end; none of its processes outlives this call, nor this process.

    On Ctrl-C the command is interrupted too and given a minute to write its results; a second Ctrl-C ends that.

    Its standard error goes to a log; `on_line` is called with every line of its standard output, from another thread.
    """
    started = time.monotonic()
    with (
        open_own(log, anew=True) as stderr,
        subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            cwd=cwd,
            start_new_session=True,
            errors="replace",
        ) as process,
    ):
        reading = threading.Thread(target=_pass_on, args=(process.stdout, on_line), daemon=True)
        reading.start()
        peaks = [0.0]
        with bound(process):
            try:
                cause = _wait(process, limits, peaks)
            except KeyboardInterrupt:
                cause = "interrupt"
                process.send_signal(signal.SIGINT)
                with contextlib.suppress(KeyboardInterrupt):
                    _wait(process, Limits(limits.memory_mb, _GRACE_S), peaks)
        reading.join()
    return Ending(cause, process.returncode, time.monotonic() - started, max(peaks) or None)


def _pass_on(lines: Iterable[str] | None, on_line: Callable[[str], None]) -> None:
    for line in lines or ():
        with contextlib.suppress(Exception):  # the pipe has to be emptied, or the process waits forever
            on_line(line.rstrip("\n"))


def _wait(process: "subprocess.Popen[str]", limits: Limits, peaks: list[float]) -> Cause:
    """Wait for the end of the process or for a limit; the peak of the memory is appended."""
    until = None if limits.timeout_s is None else time.monotonic() + limits.timeout_s
    while True:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_PERIOD_S)
            return "itself"
        rss_mb = tree_rss_mb(process.pid)
        peaks.append(rss_mb)
        if limits.memory_mb is not None and rss_mb > limits.memory_mb:
            return "memory"
        if until is not None and time.monotonic() > until:
            return "time"


def tree_rss_mb(pid: int) -> float:
    """Resident memory of a process and its descendants, 1024 x 1024 bytes each; 0 when it is gone."""
    total = 0
    with contextlib.suppress(psutil.Error):
        root = psutil.Process(pid)
        for process in (root, *root.children(recursive=True)):
            with contextlib.suppress(psutil.Error):  # ended meanwhile
                total += process.memory_info().rss
    return total / 2**20
