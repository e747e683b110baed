"""The directory of one run: the names of its files, each of them whole or absent."""

import contextlib
import errno
import json
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from lidarslam.core.errors import OutputError
from lidarslam.core.files import cannot_write, make_directory, only_writer, remove_partial_files, replacing

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

FILES = (
    CONFIG, TRAJECTORY_TUM, TRAJECTORY_KITTI, ODOMETRY_TUM, MAP_PLY, *MAPS.values(), POSE_GRAPH, SCANS_CSV, SUMMARY,
    METRICS, RERUN, REPORT, MAP_PNG, TRAJECTORY_PNG,
)  # fmt: skip

# Columns of scans.csv: standard deviations of the pose about the axes of the LiDAR and along them, radians and metres.
SIGMAS = ("sigma_rx", "sigma_ry", "sigma_rz", "sigma_x", "sigma_y", "sigma_z")

# The checkpoint of a run that is running or was stopped, see `lidarslam.storage.unfinished`.
UNFINISHED = "unfinished"
ABOUT = f"{UNFINISHED}/run.json"
STATE = f"{UNFINISHED}/state.npz"


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
                    if not describes_run(path):  # files that no config.yaml describes would obstruct the next attempt
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

    @property
    def is_mixed(self) -> bool:
        """Whether some of an earlier run's files have been replaced, and some have not."""
        return bool(self._written) and self.has_earlier

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
    """Remove files of a run, or the links in place of their folders, and the folder of tiles that is empty then.

    A folder in place of a file is not of the run.
    """
    for name in names:
        top = path / Path(name).parts[0]
        file = top if top.is_symlink() else path / name
        if file.is_symlink() or not file.is_dir():
            file.unlink(missing_ok=True)
    folder = path / MAP_TILES
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
        listed = f"{', '.join(present[:3])}{', ...' if len(present) > 3 else ''}"
        if not describes_run(path):
            raise OutputError(f"{path}: holds files that are not those of a run ({listed}); name another directory")
        if not overwrite:
            raise OutputError(f"{path}: holds a run ({listed}); name another directory, or replace it with --overwrite")
    return present


def describes_run(path: Path) -> bool:
    """Whether there is a run's config.yaml: its first section describes the run."""
    try:
        return (path / CONFIG).read_text(encoding="utf-8").startswith(f"{RUN_SECTION}:")
    except (OSError, UnicodeDecodeError):
        return False
