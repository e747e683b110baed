"""One method on one recording: a run in a process of its own, and its result however it ended.

The process is this module itself. Its arguments are the working directory and the method's run as JSON. After every
scan a line goes to standard output: its number from 1, and the total. Libraries' output goes to standard error. The
exit status is that of `lidarslam run`.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import psutil
from pydantic import ConfigDict, TypeAdapter, with_config
from typing_extensions import TypedDict

from lidarslam.compare.peers.estimation import describe_peer, execute_peer, peer_named
from lidarslam.config.settings import dump_yaml
from lidarslam.core.errors import ConfigError, InputError, LidarSlamError
from lidarslam.core.files import open_own, remove_partial_files
from lidarslam.core.json_text import read_json
from lidarslam.core.tasks import bound
from lidarslam.datasets.recording import Recording
from lidarslam.evaluation.comparison.comparison import WHOLE, MethodResult, MethodStatus
from lidarslam.run.request import RunRequest, describe_run, written_request
from lidarslam.run.run import execute
from lidarslam.storage import directory as files
from lidarslam.storage.directory import SUMMARY, RunDirectory
from lidarslam.storage.finished_run import read_summary, where_astray

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


# In addition to a run's own files: how its process ended, and its standard error.
PROCESS, LOG = "process.json", "process.log"
COMMAND = (sys.executable, "-m", "lidarslam.compare.method_run")
# The process starts here, so that no package in the user's folder is found first.
_ROOT = Path(__file__).resolve().parents[2]

_MEMORY_ERRORS = ("MemoryError", "bad_alloc", "Cannot allocate memory")
_LONGEST_MESSAGE = 300
_STOPPED, _LOST = 1, 3  # exit statuses


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


_RUN = TypeAdapter(MethodRun)


@with_config(ConfigDict(extra="forbid"))
class _Recorded(TypedDict):
    status: MethodStatus
    message: str
    wall_s: float | None
    peak_rss_mb: float | None


_SHAPE = TypeAdapter(_Recorded)


def obstacle(run: MethodRun, recording: Recording) -> str | None:
    """Why a method cannot run on a recording; None where it can."""
    if run.peer is None:
        return None
    try:
        peer_named(run.peer).require(lambda: recording.imu is not None)
    except LidarSlamError as error:
        return str(error)
    return None


def run_method(
    run: MethodRun, limits: Limits, progress: Callable[[int, int], None], command: Sequence[str] = COMMAND
) -> tuple[MethodResult, bool]:
    """Run a method to any end; its result, and whether Ctrl-C interrupted it.

    An earlier run of a comparison in its directory is replaced. `progress` is called after every scan with its number
    from 1 and the total; the encoded request is the command's last arguments.
    """
    folder = run.request.out
    clear(folder)

    def see(line: str) -> None:
        words = line.split()
        if len(words) == 2 and all(word.isdecimal() for word in words):
            progress(int(words[0]), int(words[1]))

    # It overwrites, and saves no state and draws no page, which would count as its time.
    request = replace(run.request, overwrite=True, resumable=False, report=False)
    encoded = _RUN.dump_json(replace(run, request=request)).decode()
    ending = supervise([*command, str(Path.cwd()), encoded], folder / LOG, limits, see, _ROOT)
    remove_partial_files(folder)
    status, message = judge(ending, folder, folder / LOG, limits)
    result = MethodResult(folder.name, status, message, wall_s=ending.wall_s, peak_rss_mb=ending.peak_rss_mb)
    RunDirectory(folder).write_json(PROCESS, {name: getattr(result, name) for name in _Recorded.__annotations__})
    return _collect(run, result), ending.cause == "interrupt"


def clear(folder: Path) -> None:
    """Make a method's directory, or remove the files of a run of an earlier comparison."""
    for one in (folder.parent, folder):
        if one.is_symlink():  # its target is not of this comparison
            one.unlink()
    if (folder / LOG).is_file():
        files.remove_files(folder)
        (folder / PROCESS).unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)


def finished_before(run: MethodRun) -> MethodResult | None:
    """The result of an earlier run of the same request, if it was completed.

    The same are the source, its scans, the prior, the program's version and the configuration; the content of the
    source and the prior is not compared. Of a peer, its version counts too.
    """
    try:
        folder = run.request.out
        result = MethodResult(run.name, **read_json(folder / PROCESS, _SHAPE))
        was_run, was = written_request(folder, run.request.config)
        peer = None if run.peer is None else peer_named(run.peer)
        described = describe_run(run.request) if peer is None else describe_peer(run.request, peer, run.range_m)
        is_same = was == run.request.config and all(was_run.get(key) == value for key, value in described.items())
    except (ConfigError, OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    return _collect(run, result) if is_same and result.status in WHOLE else None


def _collect(run: MethodRun, result: MethodResult) -> MethodResult:
    """The result with the content of its run directory; a damaged one counts as a failure."""
    from lidarslam.viewer.run_report import with_run  # loads the pictures

    result = replace(result, settings=dump_yaml(run.request.config))
    result = result if run.peer is None else replace(result, times_cover="registration")
    if result.status not in (*WHOLE, "stopped"):
        return result
    try:
        return replace(with_run(result, run.request.out), run=f"{run.request.out.parent.name}/{run.name}")
    except (InputError, OSError) as error:
        return replace(result, status="failed", message=f"its run directory cannot be read: {error}")


def judge(ending: Ending, folder: Path, log: Path, limits: Limits) -> tuple[MethodStatus, str]:
    """The status of a process by its run directory, which held no run before, and its log; the reason if it failed."""
    has_result = (folder / SUMMARY).is_file()
    if ending.cause == "memory":
        return "out of memory", f"took more than {limits.memory_mb:,.0f} MB"
    if ending.cause == "time":
        return "timed out", f"took more than {limits.timeout_s:g} s"
    if ending.cause == "interrupt":
        return ("stopped", "interrupted") if has_result else ("not run", "interrupted before there was a result")
    if has_result and ending.status in (0, _LOST):
        return ("lost", where_astray(read_summary(folder)) or "") if ending.status else ("ok", "")
    return _failed(ending.status, has_result, log)


def _failed(status: int, has_result: bool, log: Path) -> tuple[MethodStatus, str]:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    said = next((line.strip() for line in reversed(lines) if line.strip()), "")
    said = said.removeprefix("lidarslam: ")[:_LONGEST_MESSAGE]
    if any(words in said for words in _MEMORY_ERRORS):
        return "out of memory", said
    if status == -signal.SIGKILL:
        return "out of memory", "killed by the system (signal 9), as it does when memory runs out"
    if status < 0:
        return "failed", f"{signal.strsignal(-status)} (signal {-status}){said and f': {said}'}"
    return ("stopped" if has_result else "failed"), said or f"ended with status {status} and said nothing"


def main() -> int:
    """Run; the exit status."""
    folder, text = sys.argv[1:]
    os.chdir(folder)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])  # its Ctrl-C is ours; processes of Ray block it
    with os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8") as out:
        os.dup2(2, 1)
        try:
            run, progress = _RUN.validate_json(text), partial(print, file=out)
            if run.peer is not None:
                outcome = execute_peer(run.request, peer_named(run.peer), progress, run.range_m)
            else:
                outcome = execute(run.request, lambda number, total, _: progress(number, total))
        except LidarSlamError as error:
            print(f"lidarslam: {error}", file=sys.stderr)
            return _STOPPED
    if outcome.stopped is not None:
        print(f"lidarslam: stopped after {outcome.summary.scans} scans: {outcome.stopped}", file=sys.stderr)
        return _STOPPED
    return _LOST if outcome.summary.went_astray else 0


if __name__ == "__main__":
    sys.exit(main())
