"""The folder `unfinished` in a run directory: the checkpoint of a run until it is finished."""

import contextlib
import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

from lidarslam.core.errors import InputError
from lidarslam.core.files import cannot_write, only_writer, remove_partial_files, replacing
from lidarslam.core.state.stateful import Saved
from lidarslam.storage.directory import ABOUT, STATE, UNFINISHED, RunDirectory, remove_files
from lidarslam.storage.state_file import read_state

logger = logging.getLogger(__name__)

_SUBMAPS, _TILES = "submaps.bin", "tiles.bin"
# Differences to another run that an error lists.
_LISTED = 3

# At work; stopped, its results so far written; at work, with the results of an earlier run still whole.
Standing = Literal["at work", "stopped", "over an earlier run"]
_STANDINGS: tuple[Standing, ...] = get_args(Standing)


@dataclass(frozen=True)
class About:
    """Which run is unfinished; the content of run.json."""

    description: dict[str, Any]  # everything that decides what it computes
    standing: Standing = "at work"
    resumed_after: tuple[int, ...] = ()  # how many scans were done each time it was resumed

    @classmethod
    def read(cls, run: Path) -> "About | None":
        """Of the run in a directory; None where none is unfinished.

        Raises:
            InputError: the file is damaged.
        """
        path = run / ABOUT
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            standing: Standing = next((one for one in _STANDINGS if one == values["standing"]), "at work")
            return cls(dict(values["description"]), standing, tuple(map(int, values["resumed_after"])))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: is damaged ({error}); begin again with --overwrite") from error

    def write(self, run: Path) -> None:
        """Write run.json, durably.

        Raises:
            OSError, OutputError: it cannot be written.
        """
        with replacing(run / ABOUT, durable=True) as partial:
            try:
                partial.write_text(json.dumps(vars(self), indent=2), encoding="utf-8")
            except OSError as error:
                raise cannot_write(run / ABOUT, error) from error

    def remedy(self, run: Path) -> str:
        """What to do about it, as the end of a sentence that begins with the directory."""
        if "merge" not in self.description:
            source = self.description.get("source", "SOURCE")
            return (
                f"this run did not finish; resume it with lidarslam run {source} --out {run} --resume"
                " and the options it was begun with"
            )
        sources = " ".join(map(str, self.description.get("sources", ["SOURCE..."])))
        out = run if self.description["merge"] == "all" else run.parent
        return (
            f"this merge did not finish; make it again with lidarslam merge {sources} --out {out} --overwrite"
            " and the options it was begun with"
        )


def require_whole(run: Path) -> None:
    """Refuse the results of a run that was killed or is at work, unless they are still those of the run before.

    Raises:
        InputError: they are.
    """
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


def remove_unfinished(run: Path) -> None:
    """Remove a run, or a part of a merge, that was killed, and its directory when nothing else lies there.

    Raises:
        OutputError: it is at work.
    """
    with only_writer(run):
        remove_partial_files(run)
        remove_files(run)
        Unfinished(run, About({})).end(stopped=False)
    if not any(run.iterdir()):
        run.rmdir()


class Unfinished:
    """The checkpoint of one run.

    Attributes:
        run: its directory.
        about: which run it is.
        saved: the state to go on from, None to begin.
        state, submaps, tiles: the files of the state, of the pose graph's submaps, and of the global map's tiles.
    """

    def __init__(self, run: Path, about: About, resumes: bool = False) -> None:
        self.run, self.about, self._resumes = run, about, resumes
        self._folder = run / UNFINISHED
        self.state, self.submaps, self.tiles = run / STATE, self._folder / _SUBMAPS, self._folder / _TILES
        self.saved: Saved | None = None
        self._keeps_earlier = False  # whether the results of an earlier run lie there, whole

    @classmethod
    @contextlib.contextmanager
    def claim(cls, directory: RunDirectory, description: dict[str, Any], resume: bool) -> Iterator["Unfinished"]:
        """Begin or resume a run in a directory that is locked.

        When the block fails, the folder is removed if there is nothing to resume; not if it marks results that are
        partly this run's and partly an earlier one's.

        Raises:
            InputError: there is nothing to resume, it is damaged, or it is another run.
            OutputError: the folder cannot be written.
        """
        run = directory.path
        about = About.read(run) if resume else None
        if resume and about is None:
            raise InputError(f"{run}: holds no run to resume; leave --resume out to begin one")
        if about is not None:
            _require_same(run, about.description, description)
        unfinished = cls(run, about or About(description), resume)
        try:
            unfinished._folder.mkdir(exist_ok=True)
        except OSError as error:
            raise cannot_write(unfinished._folder, error) from error
        for folder in (run, unfinished._folder):
            remove_partial_files(folder)  # of a run that was killed
        was_there = (run / ABOUT).exists()
        unfinished._keeps_earlier = directory.has_earlier and _holds_results(run)
        if about is None:
            unfinished._remove_files()
        elif unfinished.state.is_file():
            unfinished.saved = read_state(unfinished.state)
        directory.before_change = unfinished._replace_earlier
        try:
            yield unfinished
        except BaseException:
            if not was_there and not unfinished.state.is_file() and not directory.is_mixed:
                unfinished._remove()
            raise

    def begin(self, scans: int) -> None:
        """Mark the directory as one with a run at work; `scans` are done already where it resumes."""
        resumed = (*self.about.resumed_after, scans) if self._resumes else ()
        standing: Standing = "over an earlier run" if self._keeps_earlier else "at work"
        self.about = replace(self.about, standing=standing, resumed_after=resumed)
        self.about.write(self.run)

    def _replace_earlier(self) -> None:
        """Before the first result replaces one of an earlier run, mark these as not whole."""
        if self.about.standing == "over an earlier run":
            self.about = replace(self.about, standing="at work")
            self.about.write(self.run)

    def end(self, stopped: bool) -> None:
        """The results are written; the checkpoint of a run that was stopped is kept."""
        if stopped:
            replace(self.about, standing="stopped").write(self.run)
        else:
            self._remove()

    def _remove(self) -> None:
        (self.run / ABOUT).unlink(missing_ok=True)  # first: without it the other files are nothing
        self._remove_files()
        with contextlib.suppress(OSError):  # another file lies there
            self._folder.rmdir()

    def _remove_files(self) -> None:
        if self._folder.is_dir():
            remove_partial_files(self._folder)
        for path in (self.state, self.submaps, self.tiles):
            path.unlink(missing_ok=True)


def _holds_results(run: Path) -> bool:
    """Whether the results in a directory are whole: those of a run at work there may be mixed."""
    try:
        about = About.read(run)
    except InputError:
        return False
    return about is None or about.standing != "at work"


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
    """Values by their dotted names."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
