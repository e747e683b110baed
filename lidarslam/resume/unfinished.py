"""What a run leaves for `--resume` until it is finished: a folder in its directory, and who is at work there."""

import contextlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from lidarslam.core.directory_lock import only_writer
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.state import Saved
from lidarslam.resume.state_file import read_state, replacing_for_good
from lidarslam.run.directory import ABOUT, FILES, UNFINISHED

_STATE, _ROWS, _SUBMAPS = "state.npz", "scans.csv", "submaps.bin"
# Differences to what was asked for that are told.
_TOLD = 3

Standing = Literal["at work", "stopped"]


@dataclass(frozen=True)
class About:
    """Which run lies in a directory unfinished, and how far it is.

    Attributes:
        description: all that decides what it computes.
        standing: whether its results are yet to be written; those of a run that was stopped are there, as far as it
            came.
        resumed_after: how many scans were done each time it was resumed.
    """

    description: dict[str, Any]
    standing: Standing = "at work"
    resumed_after: tuple[int, ...] = ()

    @classmethod
    def read(cls, run: Path) -> "About | None":
        """Of the run in a directory; None where none is unfinished.

        Raises:
            InputError: the file is damaged.
        """
        path = run / ABOUT
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            standing: Standing = "stopped" if values["standing"] == "stopped" else "at work"
            return cls(dict(values["description"]), standing, tuple(map(int, values["resumed_after"])))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: is damaged ({error}); begin again with --overwrite") from error

    def write(self, run: Path) -> None:
        """Write it, for good.

        Raises:
            OutputError: it cannot be written.
        """
        with replacing_for_good(run / ABOUT) as out:
            out.write(json.dumps(vars(self), indent=2).encode())

    def remedy(self, run: Path) -> str:
        """What to do about it, as the end of a sentence that says where it lies."""
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
    """See that a directory's results are not those of a run that was killed or is at work.

    Raises:
        InputError: they are.
    """
    about = About.read(run)
    if about is not None and about.standing == "at work":
        raise InputError(f"{run}: {about.remedy(run)}")


def remove_unfinished(run: Path) -> None:
    """Remove a run, or a part of a merge, that was killed, and its directory when nothing else lies there.

    Raises:
        OutputError: somebody is at work on it.
    """
    with Unfinished.claim(run, {}, resume=False) as unfinished:
        for name in FILES:
            (run / name).unlink(missing_ok=True)
    unfinished.end(stopped=False)
    if not any(run.iterdir()):
        run.rmdir()


class Unfinished:
    """The folder of one run at work.

    Attributes:
        saved: the state to go on from, None to begin.
        about: which run it is.
    """

    def __init__(self, run: Path, about: About, saved: Saved | None) -> None:
        self._run = run
        self.about, self.saved = about, saved

    @classmethod
    @contextlib.contextmanager
    def claim(
        cls, run: Path, description: dict[str, Any], resume: bool, is_mixed: Callable[[], bool] = lambda: False
    ) -> Iterator["Unfinished"]:
        """Be the only one at work on a run, new or resumed; what nobody could resume is removed when this fails.

        It stays where some results are this run's by then and some an earlier one's, which `is_mixed` tells.

        Raises:
            InputError: there is nothing to resume, it is damaged, or another run than the described one.
            OutputError: somebody else is at work on it, or the folder cannot be written.
        """
        folder = run / UNFINISHED
        about = About.read(run) if resume else None
        if resume and about is None:
            raise InputError(f"{run}: holds no run to go on with; leave --resume out to begin one")
        if about is not None:
            _require_same(run, about.description, description)
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written ({error.strerror or error})") from error
        with contextlib.ExitStack() as held:
            try:
                held.enter_context(only_writer(folder))
            except OutputError:
                raise OutputError(f"{run}: somebody else is at work on this run; wait, or end that first") from None
            for partial in run.glob(".partial-*"):
                partial.unlink(missing_ok=True)  # of whoever was killed
            saved = read_state(folder / _STATE) if about is not None and (folder / _STATE).is_file() else None
            unfinished = cls(run, about or About(description), saved)
            was_there = (run / ABOUT).exists()  # and says so of results that are not whole, until others are there
            if about is None:
                unfinished._remove(_STATE, _ROWS, _SUBMAPS)
            try:
                yield unfinished
            except BaseException:
                if not was_there and not unfinished.state.is_file() and not is_mixed():
                    unfinished._remove_all()
                raise

    @property
    def state(self) -> Path:
        """The file of the state."""
        return self._run / UNFINISHED / _STATE

    @property
    def rows(self) -> Path:
        """The file of scans.csv so far."""
        return self._run / UNFINISHED / _ROWS

    @property
    def submaps(self) -> Path:
        """The file of a pose graph's submaps."""
        return self._run / UNFINISHED / _SUBMAPS

    def begin(self, scans: int | None) -> None:
        """From now on the results in the directory, if any, are not this run's; resumed after so many scans, or new."""
        resumed = self.about.resumed_after + (() if scans is None else (scans,))
        self.about = replace(self.about, standing="at work", resumed_after=resumed)
        self.about.write(self._run)

    def end(self, stopped: bool) -> None:
        """The results are written; of a run that was stopped, what it takes to go on is kept."""
        if stopped:
            replace(self.about, standing="stopped").write(self._run)
        else:
            self._remove_all()

    def _remove_all(self) -> None:
        """Remove the folder, that first which says what the others are: without it they are nothing."""
        self._remove(Path(ABOUT).name, _STATE, _ROWS, _SUBMAPS)
        with contextlib.suppress(OSError):  # something else lies there
            (self._run / UNFINISHED).rmdir()

    def _remove(self, *names: str) -> None:
        for name in names:
            for path in (name, f"{name}.partial"):
                (self._run / UNFINISHED / path).unlink(missing_ok=True)


def _require_same(run: Path, was: dict[str, Any], asked: dict[str, Any]) -> None:
    old, new = _flat(was), _flat(asked)
    names = [name for name in [*old, *(n for n in new if n not in old)] if old.get(name) != new.get(name)]
    if names:
        told = ", ".join(f"{name} {old.get(name)} (now {new.get(name)})" for name in names[:_TOLD])
        more = f" and {len(names) - _TOLD} more" if len(names) > _TOLD else ""
        raise InputError(
            f"{run}: was begun with {told}{more}; give what it was begun with, or begin again with --overwrite"
        )


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by their dotted names."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
