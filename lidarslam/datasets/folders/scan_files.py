"""Files that hold one scan each: their order, their numbers, and the `.bin` format."""

import re
import stat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError

# No sweep is larger; reading on would fill the memory.
_LARGEST_BYTES = 1 << 31
# A larger number is no scan's, such as a time.
_MOST_SCANS = 10**9

SCAN_SUFFIXES = (".bin", ".pcd", ".ply", ".npy")
KITTI_FIELDS = ("x", "y", "z", "intensity")


def natural_key(name: str) -> list[tuple[bool, int, str]]:
    """Sort key that counts: scan_2 stands before scan_10."""
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in re.split(r"([0-9]+)", name)]


def scan_indices(count: int, start: int, stop: int | None, step: int) -> range:
    """The indices `range(start, stop, step)` of a recording of `count` scans, a stop past the end being the end.

    Raises:
        InputError: a negative start or stop, or a step below one.
    """
    if start < 0 or step < 1 or (stop is not None and stop < 0):
        raise InputError(
            f"expected start >= 0, stop >= 0 and step >= 1, got start {start}, stop {stop} and step {step}"
        )
    return range(start, count if stop is None else min(stop, count), step)


def numbered_scans(folder: Path, suffix: str = ".bin") -> tuple[list[Path], NDArray[np.intp]]:
    """The scan files of a folder with numbers for names, such as 000004.bin, in their order, and the numbers.

    The number is the scan's row in the stamp and pose files, since recordings may have gaps.

    Raises:
        InputError: there are none, a name is not a number, or a number occurs twice.
    """
    files = sorted(
        (f for f in folder.glob(f"*{suffix}") if not f.name.startswith(".")), key=lambda f: natural_key(f.stem)
    )
    if not files:
        raise InputError(f"{folder}: holds no {suffix} scan")
    for path in files:
        if not (path.stem.isascii() and path.stem.isdecimal() and int(path.stem) < _MOST_SCANS):
            raise InputError(
                f"{path}: expected a name that is the scan's number, such as 000004{suffix}, at most"
                f" {_MOST_SCANS - 1:,}; rename it or move it away"
            )
    numbers = np.array([int(path.stem) for path in files], dtype=np.intp)
    if (np.diff(numbers) == 0).any():
        twice = int(np.argmin(np.diff(numbers)))
        raise InputError(f"{folder}: {files[twice].name} and {files[twice + 1].name} have the same number; remove one")
    return files, numbers


def read_bytes(path: Path) -> bytes:
    """The content of a scan file.

    Raises:
        InputError: it cannot be read.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{path}: expected a file with a scan, it is none; move it away")
        if found.st_size > _LARGEST_BYTES:
            raise InputError(f"{path}: {found.st_size:,} bytes are no single scan; split it or move it away")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error})") from error


def read_bin(path: Path, columns: int = len(KITTI_FIELDS)) -> NDArray[np.float32]:
    """The (N, columns) little-endian float32 numbers of a `.bin` scan; an empty file is a scan of no points.

    Raises:
        InputError: the file cannot be read or its size is no whole number of points.
    """
    data = read_bytes(path)
    if len(data) % (4 * columns):
        raise InputError(
            f"{path}: expected points of {columns} float32 numbers, {4 * columns} bytes each, got {len(data)} bytes;"
            " the file is damaged or of another format: copy it again or remove it"
        )
    return np.frombuffer(data, dtype="<f4").astype(np.float32, copy=False).reshape(-1, columns)
