"""The folder `unfinished` in a run directory: the checkpoint of a run until it is finished."""

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, NonNegativeInt, TypeAdapter, with_config
from typing_extensions import TypedDict

from lidarslam.core.errors import InputError
from lidarslam.core.files import cannot_write, make_own_folder, only_writer, remove_partial_files, replacing
from lidarslam.core.state.stateful import Saved
from lidarslam.core.text.json_text import read_json
from lidarslam.storage.directory import ABOUT, STATE, UNFINISHED, RunDirectory, remove_files
from lidarslam.storage.state_file import read_state

_SUBMAPS, _TILES, _TRACKED = "submaps.bin", "tiles.bin", "tracked.npz"
# Differences to another run that an error lists.
_LISTED = 3

Standing = Literal["at work", "stopped"]


@with_config(ConfigDict(extra="allow"))
class _Description(TypedDict, total=False):
    source: str
    reader: dict[str, Any]
    merge: Literal["all", "part"]
    sources: list[str]
    parts: list[str]


class _About(TypedDict):
    description: _Description
    standing: Standing
    resumed_after: list[NonNegativeInt]


_SHAPE = TypeAdapter(_About)


@dataclass(frozen=True)
class About:
    """Which run is unfinished; the content of run.json."""

    description: dict[str, Any]  # everything that decides what it computes
    standing: Standing = "at work"  # at work, or stopped with its results so far written
    resumed_after: tuple[int, ...] = ()  # how many scans were done each time it was resumed

    @classmethod
    def read(cls, run: Path) -> "About | None":
        """Of the run in a directory; None where none is unfinished.

        Raises:
            InputError: the file is damaged.
        """
        path = run / ABOUT
        try:
            values = read_json(path, _SHAPE)
            return cls({**values["description"]}, values["standing"], tuple(values["resumed_after"]))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError) as error:
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
        sources = " ".join(self.description.get("sources", ["SOURCE..."]))
        out = run if self.description["merge"] == "all" else run.parent
        return (
            f"this merge did not finish; resume it with lidarslam merge {sources} --out {out} --resume"
            " and the options it was begun with"
        )


def require_whole(run: Path) -> None:
    """Refuse the results of a run that was killed or is at work.

    Raises:
        InputError: they are.
    """
    about = About.read(run)
    if about is not None and about.standing == "at work":
        raise InputError(f"{run}: {about.remedy(run)}")


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
        folder: where its files lie.
        state, submaps, tiles: the files of the state, of the pose graph's submaps, and of the global map's tiles.
        tracked: the file of a recording of a merge that was tracked.
    """

    def __init__(self, run: Path, about: About, resumes: bool = False) -> None:
        self.run, self.about, self._resumes = run, about, resumes
        self.folder = run / UNFINISHED
        self.state, self.submaps, self.tiles = run / STATE, self.folder / _SUBMAPS, self.folder / _TILES
        self.tracked = self.folder / _TRACKED
        self.saved: Saved | None = None

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
        if resume and (run / UNFINISHED).is_symlink():
            raise InputError(f"{run / UNFINISHED}: is a link to another place; begin again with --overwrite")
        about = About.read(run) if resume else None
        if resume and about is None:
            raise InputError(f"{run}: holds no run to resume; leave --resume out to begin one")
        if about is not None:
            _require_same(run, about.description, description)
        unfinished = cls(run, about or About(description), resume)
        try:
            make_own_folder(unfinished.folder)
        except OSError as error:
            raise cannot_write(unfinished.folder, error) from error
        for folder in (run, unfinished.folder):
            remove_partial_files(folder)  # of a run that was killed
        was_there = (run / ABOUT).exists()
        if about is None:
            unfinished._remove_files()
        elif unfinished.state.is_file():
            unfinished.saved = read_state(unfinished.state)
        try:
            yield unfinished
        except BaseException:
            if not was_there and not unfinished.is_resumable and not directory.is_mixed:
                unfinished._remove()
            raise

    @property
    def is_resumable(self) -> bool:
        """Whether something was done that need not be done again: by it, or by the parts of a merge."""
        return self.state.is_file() or self.tracked.is_file() or any(self.run.glob(f"*/{ABOUT}"))

    def begin(self, scans: int) -> None:
        """Mark the results in the directory, if any, as not this run's; `scans` are done already where it resumes."""
        resumed = (*self.about.resumed_after, scans) if self._resumes else ()
        self.about = replace(self.about, standing="at work", resumed_after=resumed)
        self.about.write(self.run)

    def end(self, stopped: bool) -> None:
        """The results are written; the checkpoint of a run that was stopped is kept."""
        if stopped:
            replace(self.about, standing="stopped").write(self.run)
        else:
            self._remove()

    def remove_checkpoint(self) -> None:
        """All scans are tracked: nothing goes on from the state."""
        for path in (self.state, self.tiles):
            path.unlink(missing_ok=True)

    def _remove(self) -> None:
        if self.folder.is_symlink():  # what it leads to is not ours
            self.folder.unlink()
            return
        (self.run / ABOUT).unlink(missing_ok=True)  # first: without it the other files are nothing
        self._remove_files()
        with contextlib.suppress(OSError):  # another file lies there
            self.folder.rmdir()

    def _remove_files(self) -> None:
        if self.folder.is_dir():
            remove_partial_files(self.folder)
        for path in (self.state, self.submaps, self.tiles, self.tracked):
            path.unlink(missing_ok=True)


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
