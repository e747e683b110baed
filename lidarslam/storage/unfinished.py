"""The unfinished run of a directory, and its checkpoint until it is finished: the folder `unfinished`."""

import contextlib
import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from lidarslam.core.errors import InputError
from lidarslam.core.files import make_own_folder, only_writer, remove_partial_files, written
from lidarslam.core.json_text import read_json
from lidarslam.core.state import Saved, read_state
from lidarslam.storage.directory import ABOUT, STATE, UNFINISHED, RunDirectory, describes_run, remove_files

logger = logging.getLogger(__name__)

# Differences to another run that an error lists.
_LISTED = 3

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
    old, new = _flat(was), _flat(asked)
    names = [name for name in [*old, *(n for n in new if n not in old)] if old.get(name) != new.get(name)]
    if names:
        listed = ", ".join(f"{name} {old.get(name)} (now {new.get(name)})" for name in names[:_LISTED])
        more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
        raise InputError(
            f"{run}: was begun with {listed}{more}; give the options it was begun with, or begin again with --overwrite"
        )


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


class CheckpointFiles:
    """The files of a run's checkpoint, there or not."""

    def __init__(self, run: Path) -> None:
        self.run, self.folder = run, run / UNFINISHED
        self.state = run / STATE  # after the last scans
        self.submaps, self.tiles = self.folder / "submaps.bin", self.folder / "tiles.bin"  # of graph and global map
        self.tracked = self.folder / "tracked.npz"  # a recording of a merge that was tracked

    def remove(self) -> None:
        """Remove them, and their folder when it is empty then."""
        if self.folder.is_symlink():  # its target is not ours
            self.folder.unlink()
            return
        (self.run / ABOUT).unlink(missing_ok=True)  # first: without it the other files are useless
        self.clear()
        with contextlib.suppress(OSError):  # another file is there
            self.folder.rmdir()

    def clear(self) -> None:
        """Remove the saved work; the folder still names the unfinished run."""
        if self.folder.is_dir():
            remove_partial_files(self.folder)
        for path in (self.state, self.submaps, self.tiles, self.tracked):
            path.unlink(missing_ok=True)


def remove_run(run: Path) -> None:
    """Remove a run, finished or not, and its directory when it is empty then; OutputError where it is running."""
    with only_writer(run):
        remove_partial_files(run)
        if (run / ABOUT).exists() or describes_run(run):
            remove_files(run)
            CheckpointFiles(run).remove()
    if not any(run.iterdir()):
        run.rmdir()


class Unfinished:
    """The checkpoint of one run."""

    def __init__(self, run: Path, about: About, resumes: bool = False) -> None:
        self.run, self.about, self._resumes = run, about, resumes
        self.files = CheckpointFiles(run)
        self.saved: Saved | None = None  # the state to resume from, None to begin
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
        make_own_folder(unfinished.files.folder)
        for folder in (run, unfinished.files.folder):
            remove_partial_files(folder)  # of a run that was killed
        was_there = (run / ABOUT).exists()
        unfinished._keeps_earlier = directory.has_earlier and _holds_results(run)
        if not resume:
            unfinished.files.clear()
        elif unfinished.files.state.is_file():
            unfinished.saved = read_state(unfinished.files.state)
        directory.before_change = unfinished.replace_earlier
        try:
            yield unfinished
        except BaseException:
            if not was_there and not unfinished.is_resumable and not directory.is_mixed:
                unfinished.files.remove()
            raise

    @property
    def is_resumable(self) -> bool:
        """Whether there is saved work: its own, or of the parts of a merge."""
        return self.files.state.is_file() or self.files.tracked.is_file() or any(self.run.glob(f"*/{ABOUT}"))

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
            self.files.remove()


def _holds_results(run: Path) -> bool:
    """Whether the results in a directory are whole: those of a running one may be mixed."""
    try:
        about = About.read(run)
    except InputError:
        return False
    return about is None or about.standing != "at work"
