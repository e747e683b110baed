"""Explanations of paths that no reader recognises, and what to do about them."""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

from lidarslam.core.text import count
from lidarslam.datasets.published import evalio

ReaderOf = Callable[[Path], str | None]
"""The name of the reader that recognises a path; None where none does."""

_LISTED = 5
# Depth of the search for recordings, and the largest number of entries of a folder.
_DEPTH, _MOST_ENTRIES = 3, 1000
_URL = re.compile(r"[a-z][a-z0-9+]+:/", re.IGNORECASE)
# Of a run's config.yaml.
_SOURCE = re.compile(r"^  source: (.+?)(?: +#.*)?$", re.MULTILINE)

# Readers of recordings of many folders; scans and bags may be anywhere.
_LAYOUTS = ("kitti-odometry", "kitti-raw")
_CONVERT = "convert each scan to .ply, .pcd or .npy"
_KINDS: tuple[tuple[tuple[str, ...], str, str], ...] = (
    ((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"), "images", "name the folder with the LiDAR's scans"),
    ((".mp4", ".avi", ".mkv", ".mov"), "video", "name the recording of the LiDAR"),
    (
        (".zip", ".tar", ".gz", ".tgz", ".xz", ".bz2", ".7z", ".rar", ".zst"),
        "packed",
        "unpack it and name the result",
    ),
    ((".las", ".laz", ".e57"), "survey formats, which are not read as scans", _CONVERT),
    ((".csv", ".xyz", ".pts", ".asc"), "points as text, which are not read as scans", _CONVERT),
    ((".tum", ".g2o"), "poses, not scans", "name the recording; lidarslam evaluate compares trajectories"),
    ((".rrd",), "a Rerun recording", "lidarslam view shows it"),
    (
        (".txt",),
        "text",
        "name the folder or the bag with the scans; scans as text have to be converted to .ply or .npy",
    ),
)


def absent(source: Path) -> str:
    """Why a path does not exist, with similar names."""
    if _URL.match(str(source)):
        return f"{source}: is an address; download the recording and name the file"
    if (missing_data_set := evalio.absent(source)) is not None:
        return missing_data_set
    parent = source.parent
    while not parent.is_dir() and parent != parent.parent:
        parent = parent.parent
    names: list[str] = []
    with suppress(OSError):
        names = [entry.name for entry in islice(parent.iterdir(), _MOST_ENTRIES)]
    missing = source.relative_to(parent).parts[0] if parent != Path() else source.parts[0]
    similar = get_close_matches(missing, names, n=3)
    hint = f"; did you mean {', '.join(str(parent / name) for name in similar)}?" if similar else ""
    within = f", there is no {parent / missing}" if parent / missing != source else ""
    return f"{source}: no such file or folder{within}{hint}"


def result_of_program(source: Path) -> str | None:
    """The kind of a path that the program has written itself, from a recording; None of any other."""
    folder = source if source.is_dir() else source.parent
    if source.is_dir() and (folder / "comparison.json").is_file():
        return (
            f"{source}: is a comparison, not a recording; open {folder / 'report.html'}, or name the recording that"
            " was compared"
        )
    head = ""
    with suppress(OSError, UnicodeDecodeError), (folder / "config.yaml").open(encoding="utf-8") as file:
        head = file.read(4096)
    if not head.startswith("run:") or not (folder / "trajectory.tum").is_file():
        return None
    match = _SOURCE.search(head)
    recording = f"; its recording is {match[1].strip(chr(39))}" if match else ""
    is_run = "is a run directory" if source.is_dir() else f"is a file of the run {folder}"
    return (
        f"{source}: {is_run}, not a recording{recording}. lidarslam view {folder} shows it, lidarslam evaluate {folder}"
        " gives its errors"
    )


def unrecognised(source: Path, reader_of: ReaderOf) -> str | None:
    """Another kind of path and what to do, as far as names alone show it; None where they do not."""
    for above in islice(source.resolve().parents, 2):
        reader = _reader(above, reader_of)
        if reader in _LAYOUTS or (reader == "rosbag" and source.name == "metadata.yaml"):
            return f"{source}: lies in a recording ({reader}); name that: {above}"
    if source.is_dir() and (found := _recordings_in(source, reader_of)):
        reader = reader_of(found[0])
        if len(found) == 1:
            return f"{source}: holds the recording {found[0]} ({reader}); name that"
        more = f" and {len(found) - _LISTED:,} more" if len(found) > _LISTED else ""
        listed = ", ".join(str(path) for path in found[:_LISTED])
        return f"{source}: holds {count(len(found), 'recording')} ({reader}); name one: {listed}{more}"
    results = [entry for entry in _entries(source) if entry.is_dir() and result_of_program(entry) is not None]
    if results:
        return f"{source}: holds results of lidarslam, such as {results[0]}, and no recording; name the recording"
    return _other_kind(source)


def _recordings_in(folder: Path, reader_of: ReaderOf) -> list[Path]:
    """The recordings nearest to a folder, all at one depth."""
    level = [folder]
    for _ in range(_DEPTH):
        level = [entry for one in level for entry in _entries(one)][:_MOST_ENTRIES]
        found = [entry for entry in level if result_of_program(entry) is None and _reader(entry, reader_of) is not None]
        if found:
            return found
        level = [entry for entry in level if entry.is_dir()]
    return []


def _entries(folder: Path) -> Iterator[Path]:
    with suppress(OSError):
        yield from sorted(e for e in islice(folder.iterdir(), _MOST_ENTRIES) if not e.name.startswith("."))


def _reader(path: Path, reader_of: ReaderOf) -> str | None:
    with suppress(OSError):
        return reader_of(path)
    return None


def _other_kind(source: Path) -> str | None:
    files = [source] if source.is_file() else [entry for entry in _entries(source) if entry.is_file()]
    counts = Counter(path.suffix.lower() for path in files)
    for suffixes, kind, remedy in _KINDS:
        suffix = max(suffixes, key=lambda suffix: counts[suffix])
        if 2 * counts[suffix] >= max(1, len(files)):
            is_what = f"holds {suffix} files" if source.is_dir() else f"is a {suffix} file"
            return f"{source}: {is_what}, {kind}; {remedy}"
    return None
