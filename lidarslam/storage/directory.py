"""The directory of one run: the names of its files, each whole or absent; the checkpoint until it is finished."""

import contextlib
import errno
import json
import logging
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import (
    cannot_write,
    make_directory,
    make_own_folder,
    only_writer,
    remove_partial_files,
    replacing,
    written,
)
from lidarslam.core.json_text import read_json
from lidarslam.core.state import State, read_state
from lidarslam.core.text import first_few

_TILE = re.compile(r"-?\d+_-?\d+\.laz")

# Errors of a full or failing disk.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)

# The section of config.yaml that describes the run, not its settings; its first.
RUN_SECTION = "run"

CONFIG = "config.yaml"
TRAJECTORY_TUM = "trajectory.tum"
TRAJECTORY_KITTI = "trajectory.kitti"
ODOMETRY_TUM = "odometry.tum"
MAP_PLY = "map.ply"
# Further formats of the map, by their names in `--map-format`.
MAPS = {"pcd": "map.pcd", "laz": "map.laz", "e57": "map.e57"}
# The folder of a large map's tiles, and the list of these.
MAP_TILES = "map"
MAP_INDEX = f"{MAP_TILES}/index.json"
POSE_GRAPH = "pose_graph.g2o"
SCANS_CSV = "scans.csv"
SUMMARY = "summary.json"
METRICS = "metrics.json"
RERUN = "recording.rrd"
REPORT = "report.html"
MAP_PNG = "map.png"
TRAJECTORY_PNG = "trajectory.png"
# The folder of trajectory and map in UTM.
UTM = "utm"
_UTM_FILES = ("map.laz", "trajectory_utm.tum", "trajectory.geojson", "trajectory.kml", "georeference.json")

FILES = (
    CONFIG, TRAJECTORY_TUM, TRAJECTORY_KITTI, ODOMETRY_TUM, MAP_PLY, *MAPS.values(), POSE_GRAPH, SCANS_CSV, SUMMARY,
    METRICS, RERUN, REPORT, MAP_PNG, TRAJECTORY_PNG, *(f"{UTM}/{name}" for name in _UTM_FILES),
)  # fmt: skip

# Columns of scans.csv: standard deviations of the pose about the axes of the LiDAR and along them, radians and metres.
SIGMAS = ("sigma_rx", "sigma_ry", "sigma_rz", "sigma_x", "sigma_y", "sigma_z")

# The checkpoint of a run that is running or was stopped: the state after the last scans, the submaps of the graph, the
# tiles of the global map; a recording of a merge that was tracked.
UNFINISHED = "unfinished"
ABOUT = f"{UNFINISHED}/run.json"
STATE = f"{UNFINISHED}/state.npz"
SUBMAPS = f"{UNFINISHED}/submaps.bin"
TILES = f"{UNFINISHED}/tiles.bin"
TRACKED = f"{UNFINISHED}/tracked.npz"


class RunDirectory:
    """Writes the files of a run; of the existing files, only those of an earlier run are replaced."""

    def __init__(self, path: Path, earlier: Iterable[str] = ()) -> None:
        self.path = path
        self._stale = set(earlier)
        self._written: set[str] = set()
        self.before_change: Callable[[], None] = lambda: None  # called before files are replaced or removed

    @classmethod
    @contextlib.contextmanager
    def create(cls, path: Path, overwrite: bool = False, resume: bool = False) -> Iterator["RunDirectory"]:
        """Make and lock the directory for the duration of a run.

        The files of an earlier run stay until the new ones replace them; the rest is removed when the block ends
        without an error. A directory made here is removed again when nothing was written to it. OutputError where it
        holds a run without `overwrite` or `resume`, or files that are not a run's, is in use, or cannot be written.
        """
        is_new = not path.exists()
        directory = cls(path, _earlier_run(path, overwrite, resume))
        make_directory(path)
        try:
            with only_writer(path):
                try:
                    yield directory
                except BaseException:
                    if not config_begins_with(path, RUN_SECTION):  # the next attempt would refuse its files
                        _remove(path, directory._written)
                    raise
                _remove(path, directory._stale)
        except OSError as error:
            if error.errno not in _NO_ROOM:
                raise
            raise cannot_write(path, error, "; make room, or name another directory") from error
        finally:
            with contextlib.suppress(OSError):  # another process may have changed it
                if is_new and not any(path.iterdir()):
                    path.rmdir()

    @property
    def has_earlier(self) -> bool:
        """Whether files of an earlier run remain that have not been replaced."""
        return bool(self._stale - {ABOUT})

    @contextlib.contextmanager
    def replacing(self, name: str) -> Iterator[Path]:
        """A path to write a file to; see `lidarslam.core.files.replacing`."""
        with replacing(self.path / name) as partial:
            yield partial
            self.before_change()
        self._stale.discard(name)
        self._written.add(name)

    def write_text(self, name: str, text: str) -> None:
        """Write a text file; OutputError where it cannot be written."""
        try:
            with self.replacing(name) as partial:
                partial.write_text(text, encoding="utf-8", newline="", errors="backslashreplace")
        except OSError as error:
            raise cannot_write(self.path / name, error) from error

    def write_json(self, name: str, value: dict[str, Any]) -> None:
        """Write a JSON file of finite numbers; OutputError where it cannot be written."""
        self.write_text(name, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def remove_files(path: Path) -> None:
    """Remove all files of a run."""
    _remove(path, (*tile_names(path), *FILES))


def files_in(path: Path) -> list[str]:
    """The existing files of a run in a directory."""
    return [*(name for name in FILES if (path / name).exists()), *tile_names(path)]


def tile_names(path: Path) -> list[str]:
    """The index of a map's tiles, and then the tiles, as far as they are in the directory of a run itself."""
    folder = path / MAP_TILES
    if folder.is_symlink() or not folder.is_dir():
        return []
    tiles = sorted(f"{MAP_TILES}/{file.name}" for file in folder.iterdir() if _TILE.fullmatch(file.name))
    return [*([MAP_INDEX] if (path / MAP_INDEX).exists() else []), *tiles]


def _remove(path: Path, names: Iterable[str]) -> None:
    """Remove files of a run, or the links in place of their folders, and the folders that are empty then.

    A folder in place of a file is not of the run.
    """
    for name in names:
        top = path / Path(name).parts[0]
        file = top if top.is_symlink() else path / name
        if file.is_symlink() or not file.is_dir():
            file.unlink(missing_ok=True)
    for folder in (path / MAP_TILES, path / UTM):
        if folder.is_dir() and not folder.is_symlink():
            remove_partial_files(folder)
            with contextlib.suppress(OSError):  # other files are there
                folder.rmdir()


def _earlier_run(path: Path, overwrite: bool, resume: bool) -> list[str]:
    """The files of a run that is in the directory already, if it may be replaced."""
    present = files_in(path)
    if (path / ABOUT).exists():  # the other files are of that run or merge, even without a config.yaml
        if not overwrite and not resume:
            raise OutputError(
                f"{path}: holds an unfinished run or merge; replace it with --overwrite, or resume a run with --resume"
            )
        return [*present, *([] if resume else [ABOUT])]
    if present and not resume:
        listed = first_few(present, 3)
        if not config_begins_with(path, RUN_SECTION):
            raise OutputError(f"{path}: holds files that are not those of a run ({listed}); name another directory")
        if not overwrite:
            raise OutputError(f"{path}: holds a run ({listed}); name another directory, or replace it with --overwrite")
    return present


def config_begins_with(path: Path, section: str) -> bool:
    """Whether there is a config.yaml with this as its first section, the one that describes a run or a training."""
    try:
        return (path / CONFIG).read_text(encoding="utf-8").startswith(f"{section}:")
    except (OSError, UnicodeDecodeError):
        return False


logger = logging.getLogger(__name__)

# Running; stopped, its results so far written; running, with the results of an earlier run still whole.
Standing = Literal["at work", "stopped", "over an earlier run"]


@dataclass(frozen=True)
class About:
    """Description of the unfinished run; the content of run.json."""

    description: dict[str, Any]  # everything that determines its results
    standing: Standing = "at work"
    resumed_after: tuple[int, ...] = ()  # number of scans done each time it was resumed

    @classmethod
    def read(cls, run: Path) -> "About | None":
        """Of the run in a directory; None where none is unfinished; InputError where the file is damaged."""
        path = run / ABOUT
        try:
            return read_json(path, _SHAPE)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: is damaged ({error}); begin again with --overwrite") from error

    def write(self, run: Path) -> None:
        """Write run.json, durably; OutputError where it cannot be written."""
        with written(run / ABOUT, durable=True) as partial:
            partial.write_text(json.dumps(vars(self), indent=2), encoding="utf-8")

    def remedy(self, run: Path) -> str:
        """The remedy, as the end of a sentence that begins with the directory."""
        kind, sources, out = "run", [self.description.get("source", "SOURCE")], run
        if "merge" in self.description:
            kind, sources = "merge", self.description["sources"]
            out = run if self.description["merge"] == "all" else run.parent
        return (
            f"this {kind} did not finish; resume it with lidarslam {kind} {' '.join(sources)} --out {out} --resume"
            " and the options it was begun with"
        )


_SHAPE = TypeAdapter(About)


def require_whole(run: Path) -> None:
    """Raise an InputError for results of a run that was killed or is running, unless they are of the run before."""
    about = About.read(run)
    if about is not None and about.standing == "at work":
        raise InputError(f"{run}: {about.remedy(run)}")
    if about is not None and about.standing == "over an earlier run":
        _warn_of_earlier(run)


@lru_cache
def _warn_of_earlier(run: Path) -> None:
    logger.warning(
        "%s: these are the results of an earlier run; the one that is to replace them is not done: it may be at work,"
        " be resumed with --resume, or be given up by removing the folder %s",
        run,
        run / UNFINISHED,
    )


def _require_same(run: Path, was: dict[str, Any], asked: dict[str, Any]) -> None:
    old, new = flat(was), flat(asked)
    names = [name for name in old | new if old.get(name) != new.get(name)]
    if names:
        changes = first_few([f"{name} {old.get(name)} (now {new.get(name)})" for name in names], 3)
        raise InputError(
            f"{run}: was begun with {changes}; give the options it was begun with, or begin again with --overwrite"
        )


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested dictionaries by their keys with dots between."""
    values: dict[str, Any] = {}
    for name, value in tree.items():
        values |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return values


def remove_checkpoint(run: Path) -> None:
    """Remove the checkpoint of a run, there or not, and its folder when it is empty then."""
    folder = run / UNFINISHED
    if folder.is_symlink():  # its target is not ours
        folder.unlink()
        return
    (run / ABOUT).unlink(missing_ok=True)  # first: without it the other files are useless
    _remove_saved_work(run)
    with contextlib.suppress(OSError):  # another file is there
        folder.rmdir()


def _remove_saved_work(run: Path) -> None:
    """The folder still names the unfinished run."""
    if (run / UNFINISHED).is_dir():
        remove_partial_files(run / UNFINISHED)
    for name in (STATE, SUBMAPS, TILES, TRACKED):
        (run / name).unlink(missing_ok=True)


def remove_run(run: Path) -> None:
    """Remove a run, finished or not, and its directory when it is empty then; OutputError where it is running."""
    with only_writer(run):
        remove_partial_files(run)
        if (run / ABOUT).exists() or config_begins_with(run, RUN_SECTION):
            remove_files(run)
            remove_checkpoint(run)
    if not any(run.iterdir()):
        run.rmdir()


class Unfinished:
    """The checkpoint of one run."""

    def __init__(self, run: Path, about: About, resumes: bool = False) -> None:
        self.run, self.about, self._resumes = run, about, resumes
        self.saved: State | None = None  # the state to resume from, None to begin
        self._keeps_earlier = False  # whether the whole results of an earlier run are there

    @classmethod
    @contextlib.contextmanager
    def claim(cls, directory: RunDirectory, description: dict[str, Any], resume: bool) -> Iterator["Unfinished"]:
        """Begin or resume a run in a locked directory; InputError where there is nothing to resume, or another run.

        When the block fails, the folder is removed if there is nothing to resume; not if it marks results that are
        partly this run's and partly an earlier one's.
        """
        run = directory.path
        about = About(description)
        if resume:
            if (begun := About.read(run)) is None:
                raise InputError(f"{run}: holds no run to resume; leave --resume out to begin one")
            _require_same(run, begun.description, description)
            about = begun
        unfinished = cls(run, about, resume)
        make_own_folder(run / UNFINISHED)
        for folder in (run, run / UNFINISHED):
            remove_partial_files(folder)  # of a run that was killed
        was_there = (run / ABOUT).exists()
        unfinished._keeps_earlier = directory.has_earlier and _holds_results(run)
        if not resume:
            _remove_saved_work(run)
        elif (run / STATE).is_file():
            unfinished.saved = read_state(run / STATE)
        directory.before_change = unfinished.replace_earlier
        try:
            yield unfinished
        except BaseException:
            is_mixed = directory._written and directory.has_earlier
            if not (was_there or unfinished.is_resumable or is_mixed):
                remove_checkpoint(run)
            raise

    @property
    def is_resumable(self) -> bool:
        """Whether there is saved work: its own, or of the parts of a merge."""
        return any((self.run / name).is_file() for name in (STATE, TRACKED)) or any(self.run.glob(f"*/{ABOUT}"))

    def begin(self, scans: int) -> None:
        """Mark the directory as one with a running run; `scans` are done already where it resumes."""
        resumed = (*self.about.resumed_after, scans) if self._resumes else ()
        standing: Standing = "over an earlier run" if self._keeps_earlier else "at work"
        self.about = replace(self.about, standing=standing, resumed_after=resumed)
        self.about.write(self.run)

    def replace_earlier(self) -> None:
        """Before the first result replaces one of an earlier run, mark these as not whole."""
        if self.about.standing == "over an earlier run":
            self.about = replace(self.about, standing="at work")
            self.about.write(self.run)

    def end(self, stopped: bool) -> None:
        """The results are written; the checkpoint of a run that was stopped is kept."""
        if stopped:
            replace(self.about, standing="stopped").write(self.run)
        else:
            remove_checkpoint(self.run)


def _holds_results(run: Path) -> bool:
    """Whether the results in a directory are whole: those of a running one may be mixed."""
    try:
        about = About.read(run)
    except InputError:
        return False
    return about is None or about.standing != "at work"
