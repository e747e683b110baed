"""Status of a method in the comparison by the end of its process, and the reason."""

import signal
from pathlib import Path

from lidarslam.compare.methods.process import LOST
from lidarslam.compare.supervised import Ending, Limits
from lidarslam.evaluation.comparison.comparison import MethodStatus
from lidarslam.storage.directory import SUMMARY
from lidarslam.storage.finished_run import read_summary

_SIGNALS = {int(signal.SIGABRT): "aborted", int(signal.SIGSEGV): "segmentation fault"}
_MEMORY_ERRORS = ("MemoryError", "bad_alloc", "Cannot allocate memory")
_LONGEST_MESSAGE = 300


def judge(ending: Ending, folder: Path, log: Path, limits: Limits) -> tuple[MethodStatus, str]:
    """The status and, when it did not end well, the reason.

    Args:
        ending: of the process.
        folder: its run directory, which held no run before.
        log: its standard error.
        limits: of the process.
    """
    has_result = (folder / SUMMARY).is_file()
    if ending.cause == "memory":
        return "out of memory", f"took more than {limits.memory_mb:,.0f} MB"
    if ending.cause == "time":
        return "timed out", f"took more than {limits.timeout_s:g} s"
    if ending.cause == "interrupt":
        return ("stopped", "interrupted") if has_result else ("not run", "interrupted before there was a result")
    if has_result and ending.status in (0, LOST):
        return ("lost", _where_lost(folder)) if ending.status else ("ok", "")
    return _failed(ending.status, has_result, _last_words(log))


def _failed(status: int, has_result: bool, said: str) -> tuple[MethodStatus, str]:
    if any(words in said for words in _MEMORY_ERRORS):
        return "out of memory", said
    if status == -signal.SIGKILL:
        return "out of memory", "killed by the system (signal 9), as it does when memory runs out"
    if status < 0:
        reason = f"{_SIGNALS.get(-status, 'ended by the system')} (signal {-status})"
        return "failed", f"{reason}: {said}" if said else reason
    return ("stopped" if has_result else "failed"), said or f"ended with status {status} and said nothing"


def _where_lost(folder: Path) -> str:
    summary = read_summary(folder)
    if not summary["lost"] and not summary["map_contradictions"]:
        return f"{summary['unconstrained_m']:.1f} m of its way are hardly constrained"
    if not summary["lost"]:
        slid = summary["map_contradictions"][0]
        return f"its map contradicts itself between scans {slid['first']} and {slid['last']}"
    first = summary["lost"][0]
    return f"first lost on scan {first['first']}: {first['reason']}"


def _last_words(log: Path) -> str:
    """The last line on standard error, without the program's name before it."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return last.removeprefix("lidarslam: ")[:_LONGEST_MESSAGE]
