"""The readers and the choice among them, with what to do about paths that none recognises.

A reader's module is imported on use."""

import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from pkgutil import resolve_name
from typing import NamedTuple, cast

from lidarslam.core.errors import InputError
from lidarslam.core.plugins import PlugPoint, usable
from lidarslam.core.text import count, first_few
from lidarslam.datasets.cloud_recording import CloudRecording
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.fetched import is_url
from lidarslam.datasets.folders.scan_files import SCAN_SUFFIXES
from lidarslam.datasets.mounting import KITTI_DEG, MountedRecording
from lidarslam.datasets.published import evalio
from lidarslam.datasets.published.evalio import is_of_evalio, located
from lidarslam.datasets.recording import ROSBAG1_SUFFIXES, STORAGE_SUFFIXES, Recording, storage_files

logger = logging.getLogger(__name__)

# Depth of the search for recordings, and the largest number of entries of a folder.
_DEPTH, _MOST_ENTRIES = 3, 1000
# Of a run's config.yaml.
_SOURCE = re.compile(r"^  source: (.+?)(?: +#.*)?$", re.MULTILINE)

# Readers of recordings of many folders; scans and bags may be anywhere.
_LAYOUTS = ("kitti-odometry", "kitti-raw")


class Reader(NamedTuple):
    """One row of the table."""

    module: str  # has `open_recording(source: Path, config: ReaderConfig) -> Recording`, or that is `module:function`
    reads: str  # the layout, in words
    recognises: Callable[[Path], bool]  # whether names alone fit; no file is opened
    takes_sequence: bool = False  # whether --sequence chooses one of several in a source
    elevation_deg: float = 0.0  # angle by which its points have to be raised, unless it is configured


def _is_rosbag(source: Path) -> bool:
    if not source.is_dir():
        return source.name.endswith((*ROSBAG1_SUFFIXES, *STORAGE_SUFFIXES))
    if (source / "metadata.yaml").is_file() or _bag_of_folder(source).is_file() or storage_files(source):
        return True
    parts = len(storage_files(source, ROSBAG1_SUFFIXES))  # a map may lie beside them, and a bag beside scans
    return parts > 1 and parts >= sum(entry.suffix.lower() in SCAN_SUFFIXES for entry in source.iterdir())


def _bag_of_folder(folder: Path) -> Path:
    """The rosbag1 file that bears its folder's name, as simulated recordings have it next to their truth and map."""
    return folder / f"{folder.resolve().name}.bag"


def _has(*patterns: str) -> Callable[[Path], bool]:
    """Whether a folder has a path of one of these patterns; those that end in a slash are folders."""
    return lambda source: any(any(source.glob(pattern)) for pattern in patterns)


def _is_kitti_360(source: Path) -> bool:
    is_drive = source.resolve().parent.name == "data_3d_raw" and (source / "velodyne_points").is_dir()
    return is_drive or (source / "data_3d_raw").is_dir()


_HERE = "lidarslam.datasets"
READERS: dict[str, Reader] = {
    "evalio": Reader(
        f"{_HERE}.published.evalio",
        "data sets of evalio: evalio:DATASET/SEQUENCE, or that folder of its data (lidarslam datasets)",
        is_of_evalio,
    ),
    "kitti-odometry": Reader(
        f"{_HERE}.published.kitti:open_odometry",
        "KITTI odometry: the root (with --sequence) or one sequences/NN folder",
        _has("sequences/", "velodyne/"),
        takes_sequence=True,
        elevation_deg=KITTI_DEG,
    ),
    "kitti-360": Reader(
        f"{_HERE}.published.kitti:open_360",
        "KITTI-360: the root (with --sequence) or one data_3d_raw/..._sync folder",
        _is_kitti_360,
        takes_sequence=True,
    ),
    "kitti-raw": Reader(
        f"{_HERE}.published.kitti:KittiRawRecording",
        "KITTI raw: a ..._drive_NNNN_sync folder",
        _has("velodyne_points/data/"),
        elevation_deg=KITTI_DEG,
    ),
    "nuscenes": Reader(
        f"{_HERE}.published.nuscenes",
        "nuScenes: the root with v1.0-* (with --sequence)",
        _has("v1.0-*/scene.json"),
        True,
    ),
    "mulran": Reader(f"{_HERE}.published.mulran", "MulRan: a sequence with a folder Ouster", _has("Ouster/")),
    "nclt": Reader(f"{_HERE}.published.nclt", "NCLT: a session with a folder velodyne_sync", _has("velodyne_sync/")),
    "rosbag": Reader(f"{_HERE}.ros.rosbag", "rosbag1 .bag; rosbag2 .db3 or .mcap; a folder of either", _is_rosbag),
    "packets": Reader(
        f"{_HERE}.packets.velodyne",
        ".pcap of a Velodyne, or of an Ouster with its metadata .json beside it; Ouster's .osf",
        lambda source: source.suffix.lower() in (".pcap", ".pcapng", ".osf"),
    ),
    "scan-folder": Reader(
        f"{_HERE}.folders.scan_folder",
        "a folder of .bin, .pcd, .ply or .npy scans",
        lambda source: source.is_dir() and any(e.suffix.lower() in SCAN_SUFFIXES for e in source.iterdir()),
    ),
}

ALL_READERS = PlugPoint("reader", tuple(READERS))


def choose_reader(source: Path, name: str | None = None) -> str:
    """The name of the reader for a source: the given one, else the first in the table that recognises it."""
    source = located(source)
    try:
        exists = source.exists()
        if exists and source.is_dir():
            next(source.iterdir(), None)
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror}); check its permissions") from error
    if not exists:
        raise InputError(absent(source))
    if name is not None:
        try:
            return cast(str, ALL_READERS.check(name))
        except ValueError as error:
            raise InputError(str(error)) from None
    if (result := result_of_program(source)) is not None:
        raise InputError(result)
    if (found := recognise(source)) is not None:
        return found
    if source.is_dir() and all(entry.name.startswith(".") for entry in source.iterdir()):
        raise InputError(f"{source}: the folder is empty; name the one with the recording")
    if source.suffix.lower() in SCAN_SUFFIXES:
        raise InputError(
            f"{source}: is a single point cloud; give the folder with the scans, {source.absolute().parent}?"
        )
    if (other := _unrecognised(source)) is not None:
        raise InputError(other)
    raise InputError(
        f"{source}: {_kind(source)}not a recording that any reader recognises; expected a bag (.bag, .db3, .mcap, or"
        " the folder of a rosbag2), a folder of .bin, .pcd, .ply or .npy scans (unpack archives, convert text),"
        " packets (.pcap, .osf), KITTI, or a data set of `lidarslam datasets`"
    )


def is_recording(source: Path, name: str | None = None) -> bool:
    """Whether a reader was named for an existing source, or one recognises it."""
    source = located(source)
    return source.exists() and (name is not None or recognise(source) is not None)


def takes_sequence(source: Path, name: str | None = None) -> bool:
    """Whether the reader that was named, or recognises the source, takes a sequence."""
    reader = name or recognise(source)
    return reader is not None and _reader(reader).takes_sequence


def recognise(source: Path) -> str | None:
    """The first reader in the table, or else of another package, that recognises a path by its names."""
    with suppress(OSError):
        return next((name for name, reader in _readers() if reader.recognises(source)), None)
    return None


def _readers() -> Iterator[tuple[str, Reader]]:
    yield from READERS.items()
    yield from usable(ALL_READERS, Reader).items()


def _reader(name: str) -> Reader:
    return READERS.get(name) or cast(Reader, ALL_READERS.load(name, Reader))


def open_recording(source: Path, config: ReaderConfig | None = None) -> Recording:
    """Open a recording of whole sweeps, in upright axes, corrected, without the carrier; it is read later."""
    config, source = config or ReaderConfig(), located(source)
    name = choose_reader(source, config.name)
    reader = _reader(name)
    why = "because the names fit" if config.name is None else "as it was named"
    logger.info("reader: %s, %s: %s", name, why, reader.reads)
    if name == "rosbag" and source.is_dir() and _bag_of_folder(source).is_file():
        source = _bag_of_folder(source)
    opens = resolve_name(reader.module if ":" in reader.module else f"{reader.module}:open_recording")
    recording = cast(Recording, opens(source, config))
    time_scale = 1.0 if isinstance(recording, CloudRecording) else config.time_scale
    raised_deg = config.raised_deg(reader.elevation_deg)
    remove_carrier = config.carrier == "remove"
    if config.mounting == "upright" and not raised_deg and time_scale == 1.0 and not remove_carrier:
        return recording
    return MountedRecording(recording, config.mounting, raised_deg, time_scale, remove_carrier=remove_carrier)


def absent(source: Path) -> str:
    """Why a path does not exist, with similar names."""
    if is_url(source):
        return f"{source}: is an address; download the recording and name the file"
    if (missing_data_set := evalio.absent(source)) is not None:
        return missing_data_set
    if source.is_symlink():
        return f"{source}: is a link to {source.readlink()}, which is not there"
    parent = source.parent
    while not parent.is_dir() and parent != parent.parent:
        parent = parent.parent
    names: list[str] = []
    with suppress(OSError):
        names = [entry.name for entry in islice(parent.iterdir(), _MOST_ENTRIES)]
    missing = source.relative_to(parent).parts[0] if parent != Path() else source.parts[0]
    similar = ", ".join(str(parent / name) for name in get_close_matches(missing, names, n=3))
    hint = f"; did you mean {similar}?" if similar else ""
    return (
        f"{source}: no such file or folder" + f", there is no {parent / missing}" * (parent / missing != source) + hint
    )


def result_of_program(source: Path) -> str | None:
    """The kind of a path that the program has written itself, from a recording; None of any other."""
    folder = source if source.is_dir() else source.parent
    if source.is_file() and source.suffix.lower() not in SCAN_SUFFIXES and recognise(source) is not None:
        return None  # a run writes no bags and no packets
    if source.is_dir() and (folder / "comparison.json").is_file():
        return f"{source}: is a comparison, not a recording; open {folder / 'report.html'}"
    head = ""
    with suppress(OSError, UnicodeDecodeError), (folder / "config.yaml").open(encoding="utf-8") as file:
        head = file.read(4096)
    is_merge = "\n  sources:" in head.partition("\n\n")[0]
    if not head.startswith("run:") or not (is_merge or (folder / "trajectory.tum").is_file()):
        return None
    recording = f"; its recording is {match[1].strip(chr(39))}" if (match := _SOURCE.search(head)) else ""
    what = "merge" if is_merge else "run"
    kind = f"is a {what} directory" if source.is_dir() else f"is a file of the {what} {folder}"
    return f"{source}: {kind}, not a recording{recording}. lidarslam view {folder} shows it"


def _unrecognised(source: Path) -> str | None:
    """Another kind of path and what to do, as far as names alone show it; None where they do not."""
    for above in islice(source.resolve().parents, 2):
        reader = recognise(above)
        if reader in _LAYOUTS or (reader == "rosbag" and source.name == "metadata.yaml"):
            return f"{source}: lies in a recording ({reader}); name that: {above}"
    if found := dict(recordings_in([source])):
        (first, reader), *others = found.items()
        if not others:
            return f"{source}: holds the recording {first} ({reader}); name that"
        return f"{source}: holds {count(len(found), 'recording')} ({reader}); name one: {first_few([*found], 5)}"
    return None


def recordings_in(folders: Iterable[Path], but: str | None = None) -> Iterator[tuple[Path, str]]:
    """Recordings in folders, down to three below and in no other recording, with their readers; none of one reader."""
    level = list(folders)
    for _ in range(_DEPTH + 1):
        below: list[Path] = []
        for entry in level[:_MOST_ENTRIES]:
            reader = recognise(entry) if result_of_program(entry) is None else None
            if reader is not None and reader != but:
                yield entry, reader
            elif entry.is_dir():
                below += _entries(entry)
        level = below


def _entries(folder: Path) -> Iterator[Path]:
    with suppress(OSError):
        yield from sorted(e for e in islice(folder.iterdir(), _MOST_ENTRIES) if not e.name.startswith("."))


def _kind(source: Path) -> str:
    if not source.is_dir():
        return ""
    counts = Counter(entry.suffix.lower() for entry in _entries(source) if entry.is_file() and entry.suffix)
    return f"holds {counts.most_common(1)[0][0]} files, " if counts else ""
