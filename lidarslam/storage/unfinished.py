"""An unfinished run in its directory: which run it is, and its checkpoint until it is finished."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from lidarslam.core.errors import InputError
from lidarslam.core.files import only_writer, remove_partial_files
from lidarslam.core.state.stateful import Saved
from lidarslam.storage.about import About, Standing, require_same
from lidarslam.storage.checkpoint_files import CheckpointFiles
from lidarslam.storage.directory import ABOUT, RunDirectory, remove_files
from lidarslam.storage.state_file import read_state


def remove_unfinished(run: Path) -> None:
    """Remove a run, or a part of a merge, that was killed, and its directory when nothing else lies there.

    Raises:
        OutputError: it is at work.
    """
    with only_writer(run):
        remove_partial_files(run)
        remove_files(run)
        CheckpointFiles(run).remove()
    if not any(run.iterdir()):
        run.rmdir()


class Unfinished:
    """The checkpoint of one run.

    Attributes:
        run: its directory.
        about: which run it is.
        saved: the state to go on from, None to begin.
        files: those of its checkpoint.
    """

    def __init__(self, run: Path, about: About, resumes: bool = False) -> None:
        self.run, self.about, self._resumes = run, about, resumes
        self.files = CheckpointFiles(run)
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
        if resume:
            CheckpointFiles(run).require_own()
        about = About.read(run) if resume else None
        if resume and about is None:
            raise InputError(f"{run}: holds no run to resume; leave --resume out to begin one")
        if about is not None:
            require_same(run, about.description, description)
        unfinished = cls(run, about or About(description), resume)
        unfinished.files.make_folder()
        for folder in (run, unfinished.files.folder):
            remove_partial_files(folder)  # of a run that was killed
        was_there = (run / ABOUT).exists()
        unfinished._keeps_earlier = directory.has_earlier and _holds_results(run)
        if about is None:
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
        """Whether something was done that need not be done again: by it, or by the parts of a merge."""
        return self.files.state.is_file() or self.files.tracked.is_file() or any(self.run.glob(f"*/{ABOUT}"))

    def begin(self, scans: int) -> None:
        """Mark the directory as one with a run at work; `scans` are done already where it resumes."""
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

    def remove_checkpoint(self) -> None:
        """All scans are tracked: nothing goes on from the state."""
        for path in (self.files.state, self.files.tiles):
            path.unlink(missing_ok=True)


def _holds_results(run: Path) -> bool:
    """Whether the results in a directory are whole: those of a run at work there may be mixed."""
    try:
        about = About.read(run)
    except InputError:
        return False
    return about is None or about.standing != "at work"
