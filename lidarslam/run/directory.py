"""One run on disk: names every file of it and writes each so that it is whole or absent."""

import contextlib
import errno
import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TextIO

from lidarslam.core.directory_lock import only_writer
from lidarslam.core.errors import OutputError

# What a full or failing disk says.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)

# The section of config.yaml that says what was run, not how; its first.
RUN_SECTION = "run"

CONFIG = "config.yaml"
TRAJECTORY_TUM = "trajectory.tum"
TRAJECTORY_KITTI = "trajectory.kitti"
ODOMETRY_TUM = "odometry.tum"
MAP_PLY = "map.ply"
MAP_PCD = "map.pcd"
POSE_GRAPH = "pose_graph.g2o"
SCANS_CSV = "scans.csv"
SUMMARY = "summary.json"
METRICS = "metrics.json"
RERUN = "recording.rrd"

# Exists while a run is at work, and after it was stopped; `lidarslam.resume.unfinished` knows what it holds.
UNFINISHED = "unfinished"
ABOUT = f"{UNFINISHED}/run.json"

FILES = (
    CONFIG,
    TRAJECTORY_TUM,
    TRAJECTORY_KITTI,
    ODOMETRY_TUM,
    MAP_PLY,
    MAP_PCD,
    POSE_GRAPH,
    SCANS_CSV,
    SUMMARY,
    METRICS,
    RERUN,
)


class RunDirectory:
    """The directory of one run; only an earlier run's files named above are ever replaced or removed."""

    def __init__(self, path: Path, earlier: Iterable[str] = ()) -> None:
        self.path = path
        self._stale = set(earlier)
        self._written: set[str] = set()

    @classmethod
    @contextlib.contextmanager
    def create(cls, path: Path, overwrite: bool = False, resume: bool = False) -> Iterator["RunDirectory"]:
        """Make the directory, or take over an existing one, for the time of a run.

        An earlier run stays as it is until the new one's files take their places; what they leave over is removed when
        the block ends well. A directory made here is removed again when nothing was written to it.

        Raises:
            OutputError: the directory holds a run, be it unfinished, and neither `overwrite` nor `resume` is given;
                holds files with a run's names that are no run's; or cannot be written.
        """
        is_new = not path.exists()
        directory = cls(path, _earlier_run(path, overwrite, resume))
        try:
            path.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path, prefix=".partial-"):
                pass
        except (FileExistsError, NotADirectoryError) as error:
            raise OutputError(f"{path}: a file is in the way; name another directory") from error
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
        try:
            with only_writer(path):
                try:
                    yield directory
                except BaseException:
                    directory._discard_unless_run()
                    raise
                for name in directory._stale:
                    (path / name).unlink(missing_ok=True)
        except OSError as error:
            if error.errno not in _NO_ROOM:
                raise
            raise OutputError(
                f"{path}: cannot be written ({error.strerror}); make room, or name another directory"
            ) from error
        finally:
            with contextlib.suppress(OSError):  # somebody may have put something there, or taken it away
                if is_new and not any(path.iterdir()):
                    path.rmdir()

    @property
    def is_mixed(self) -> bool:
        """Whether some of an earlier run's files were replaced by now, and some were not."""
        return bool(self._written) and bool(self._stale - {ABOUT})

    def __getitem__(self, name: str) -> Path:
        return self.path / name

    @contextlib.contextmanager
    def replacing(self, name: str) -> Iterator[Path]:
        """A path to write to; it takes the name when the block ends without an error, and is gone otherwise."""
        final = self.path / name
        if final.exists() and not final.is_file():  # a device would be replaced by a file of its name
            raise OutputError(f"{final}: is {'a folder' if final.is_dir() else 'no ordinary file'}; name another file")
        partial = final.with_name(f".partial-{os.getpid()}-{name}")
        partial.unlink(missing_ok=True)  # whatever lies there, a link elsewhere too, is not written to
        try:
            yield partial
            try:
                partial.replace(final)
            except OSError as error:
                raise OutputError(f"{final}: cannot be written ({error.strerror or error})") from error
            self._stale.discard(name)
            self._written.add(name)
        finally:
            partial.unlink(missing_ok=True)

    def _discard_unless_run(self) -> None:
        """Files without their run's description would be nobody's, and in the way of the next attempt."""
        if not _is_run(self.path):
            for name in self._written:
                (self.path / name).unlink(missing_ok=True)

    @contextlib.contextmanager
    def open_text(self, name: str) -> Iterator[TextIO]:
        """A text file to write to, whole or absent."""
        with (
            self.replacing(name) as partial,
            partial.open("w", encoding="utf-8", newline="", errors="backslashreplace") as out,
        ):
            yield out

    def write_text(self, name: str, text: str) -> None:
        """Write one text file.

        Raises:
            OutputError: it cannot be written.
        """
        try:
            with self.open_text(name) as out:
                out.write(text)
        except OSError as error:
            raise OutputError(f"{self.path / name}: cannot be written ({error.strerror or error})") from error

    def write_json(self, name: str, value: dict[str, Any]) -> None:
        """Write one JSON file; a number that is not finite is a mistake of ours and refused."""
        self.write_text(name, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def remove_run(path: Path) -> None:
    """Remove a run's files, and its directory when nothing else lies there; leave alone what is no run."""
    if _is_run(path):
        for name in FILES:
            (path / name).unlink(missing_ok=True)
        if not any(path.iterdir()):
            path.rmdir()


def _earlier_run(path: Path, overwrite: bool, resume: bool) -> list[str]:
    """The files of a run that lies in the directory already, if it may be replaced."""
    present = [name for name in FILES if (path / name).exists()]
    if (path / ABOUT).exists():  # whatever lies beside it is of that run or merge, be its description missing
        if not overwrite and not resume:
            raise OutputError(
                f"{path}: holds what did not finish; replace it with --overwrite, or go on with a run by --resume"
            )
        return [*present, *([] if resume else [ABOUT])]
    if not present or resume:
        return present
    listed = f"{', '.join(present[:3])}{', ...' if len(present) > 3 else ''}"
    if not _is_run(path):
        raise OutputError(f"{path}: holds files that are not those of a run ({listed}); name another directory")
    if not overwrite:
        raise OutputError(
            f"{path}: holds a run already ({listed}); name another directory, or replace it with --overwrite"
        )
    return present


def _is_run(path: Path) -> bool:
    """Whether a run's own description lies there: its first section says what was run."""
    try:
        return (path / CONFIG).read_text(encoding="utf-8").startswith(f"{RUN_SECTION}:")
    except (OSError, UnicodeDecodeError):
        return False
