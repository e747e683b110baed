"""A command in a session of its own, watched: its time, the memory of all its processes, and how it ended."""

import contextlib
import os
import select
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

# How often the memory is looked at; a look costs a millisecond or two of a core.
_PERIOD_S = 0.2
# How long an interrupted command may take to write what it has.
_GRACE_S = 60.0
# Fields of /proc/PID/stat after the name, which may hold blanks and brackets itself.
_SESSION, _RSS_PAGES = 3, 21

Cause = Literal["itself", "memory", "time", "interrupt"]


@dataclass(frozen=True)
class Limits:
    """What a command may take; None: as much as it likes.

    Attributes:
        memory_mb: resident memory of all its processes together.
        timeout_s: wall time.
    """

    memory_mb: float | None = None
    timeout_s: float | None = None


@dataclass(frozen=True)
class Ending:
    """How a command ended.

    Attributes:
        cause: by itself, or because a limit or an interruption ended it.
        status: its exit status, negative for the signal that ended it.
        wall_s: from its start to its end.
        peak_rss_mb: largest resident memory of all its processes together, looked at five times a second; pages that
            they share count for each. None where the system does not tell.
    """

    cause: Cause
    status: int
    wall_s: float
    peak_rss_mb: float | None


def supervise(
    command: Sequence[str], log: Path, limits: Limits, on_line: Callable[[str], None], cwd: Path | None = None
) -> Ending:
    """Run a command to its end; none of its processes outlives this call.

    On Ctrl-C the command is interrupted too and given a minute to write what it has; a second Ctrl-C ends that.

    Args:
        command: program and arguments.
        log: file that its standard error goes to.
        limits: what ends it.
        on_line: told every line of its standard output.
        cwd: where it runs.
    """
    started = time.monotonic()
    with log.open("wb") as stderr:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=stderr, cwd=cwd, start_new_session=True
        )
        watch = _Watch(process, limits, on_line)
        try:
            cause = _follow(watch, started)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            watch.close()
    return Ending(cause, process.returncode, time.monotonic() - started, watch.peak_rss_mb)


def _follow(watch: "_Watch", started: float) -> Cause:
    try:
        return watch.until_the_end(started)
    except KeyboardInterrupt:
        watch.interrupt()
        with contextlib.suppress(KeyboardInterrupt):
            watch.until_the_end(time.monotonic())
        return "interrupt"


class _Watch:
    """Looks at a running process again and again."""

    def __init__(self, process: "subprocess.Popen[bytes]", limits: Limits, on_line: Callable[[str], None]) -> None:
        assert process.stdout is not None
        self.peak_rss_mb: float | None = None
        self._process = process
        self._limits = limits
        self._on_line = on_line
        self._output = process.stdout
        self._rest = b""

    def interrupt(self) -> None:
        """Ask the process to end, and give it time for that instead of what it had."""
        self._process.send_signal(signal.SIGINT)
        self._limits = Limits(self._limits.memory_mb, _GRACE_S)

    def until_the_end(self, since: float) -> Cause:
        """Wait until the process ends, or has used up what it may; time counts from `since`."""
        while self._process.poll() is None:
            self._read(_PERIOD_S)
            rss_mb = session_rss_mb(self._process.pid)
            if rss_mb is not None:
                self.peak_rss_mb = max(rss_mb, self.peak_rss_mb or 0.0)
            if self._limits.memory_mb is not None and (rss_mb or 0.0) > self._limits.memory_mb:
                return "memory"
            if self._limits.timeout_s is not None and time.monotonic() - since > self._limits.timeout_s:
                return "time"
        self._read(0.0)
        return "itself"

    def close(self) -> None:
        """Let go of the output."""
        self._output.close()

    def _read(self, wait_s: float) -> None:
        """Pass on the lines that come within the time, all of it."""
        until = time.monotonic() + wait_s
        while True:
            left = max(0.0, until - time.monotonic())
            readable, _, _ = select.select([self._output], [], [], left)
            chunk = os.read(self._output.fileno(), 1 << 16) if readable else b""
            if not chunk:
                self._pause(bool(readable), left)
                return
            *lines, self._rest = (self._rest + chunk).split(b"\n")
            for line in lines:
                self._on_line(line.decode(errors="replace"))

    def _pause(self, is_closed: bool, left_s: float) -> None:
        """A process that closed its output would otherwise be looked at without a pause."""
        if is_closed and left_s > 0.0:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(left_s)


def session_rss_mb(session: int) -> float | None:
    """Resident memory of all processes in a session, 1024 x 1024 bytes each; None when there is none to be seen."""
    pages = 0
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it may have ended meanwhile
            fields = entry.read_bytes().rpartition(b")")[2].split()
            if int(fields[_SESSION]) == session:
                pages += int(fields[_RSS_PAGES])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20 if pages else None
