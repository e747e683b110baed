"""Versions of the programs and description of the machine, for reports of measurements."""

import contextlib
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from lidarslam.core.tasks import usable_cores

_PROGRAMS = ("lidarslam", "kiss-icp", "numpy", "onnxruntime", "open3d", "open3d-cpu", "torch")


def versions() -> dict[str, str]:
    """Versions of the programs that results depend on, and the commit of a checkout."""
    found = {}
    for name in _PROGRAMS:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    found["python"] = platform.python_version()
    commit = _commit(Path(__file__).resolve().parents[2])
    return found if commit is None else found | {"commit": commit}


def machine() -> dict[str, str]:
    """Processor, cores of this process, memory and system; unknown entries are left out."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    system = f"{platform.system()} {platform.release()} ({platform.machine()})"
    described = {"processor": _processor(), "cores": str(usable_cores()), "memory": f"{memory:.1f} GiB"}
    return {name: text for name, text in (described | {"system": system}).items() if text}


def _commit(folder: Path) -> str | None:
    """The commit of a checkout, marked where files differ from it; None without git or checkout."""
    if not (folder / ".git").exists():
        return None
    command = ["git", "--no-optional-locks", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run([*command, "--exclude=*"], capture_output=True, text=True, timeout=10.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return " ".join(value.split())
    return platform.processor()
