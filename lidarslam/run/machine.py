"""What a measurement was made with: versions of the programs, and the machine."""

import contextlib
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PROGRAMS = ("lidarslam", "kiss-icp", "numpy", "open3d", "torch")


def versions() -> dict[str, str]:
    """Name -> version of the programs that results depend on, and the commit when it runs from a checkout."""
    found = {}
    for name in _PROGRAMS:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    found["python"] = platform.python_version()
    commit = _commit(Path(__file__).resolve().parents[2])
    return found if commit is None else found | {"commit": commit}


def machine() -> dict[str, str]:
    """Processor, cores this process may use, memory and system, in words; what is not known is left out."""
    words = {
        "processor": _processor(),
        "cores": str(_usable_cores()),
        "memory": _memory(),
        "system": f"{platform.system()} {platform.release()} ({platform.machine()})",
    }
    return {name: text for name, text in words.items() if text}


def _commit(folder: Path) -> str | None:
    """The commit of a checkout, marked where files differ from it; None where there is no checkout of ours."""
    if not (folder / ".git").exists():
        return None
    head = _git(folder, "rev-parse", "--short=12", "HEAD")
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return head and f"{head} and changes" if changed else head


def _git(folder: Path, *arguments: str) -> str | None:
    """What git says; None when it says nothing, is not installed, or does not answer."""
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def _processor() -> str:
    """Its name; the standard library knows only its architecture on Linux."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return " ".join(value.split())
    return platform.processor()


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.1f} GiB"
    except (OSError, ValueError):
        return ""
