"""The folder `unfinished` in a run directory: the files of a checkpoint, whichever run's it is."""

import contextlib
from dataclasses import dataclass
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.core.files import cannot_write, make_own_folder, remove_partial_files
from lidarslam.storage.directory import ABOUT, STATE, UNFINISHED


@dataclass(frozen=True)
class CheckpointFiles:
    """The files of a run's checkpoint, there or not."""

    run: Path  # the directory of the run

    @property
    def folder(self) -> Path:
        """Where the others lie."""
        return self.run / UNFINISHED

    @property
    def state(self) -> Path:
        """The state after the last scans."""
        return self.run / STATE

    @property
    def submaps(self) -> Path:
        """The submaps of the pose graph."""
        return self.folder / "submaps.bin"

    @property
    def tiles(self) -> Path:
        """The tiles of the global map."""
        return self.folder / "tiles.bin"

    @property
    def tracked(self) -> Path:
        """A recording of a merge that was tracked."""
        return self.folder / "tracked.npz"

    def require_own(self) -> None:
        """Before anything is resumed from them, or locked.

        Raises:
            InputError: their folder is a link.
        """
        if self.folder.is_symlink():
            raise InputError(f"{self.folder}: is a link to another place; begin again with --overwrite")

    def make_folder(self) -> None:
        """Make the folder, unless it exists; a link there is replaced.

        Raises:
            OutputError: it cannot be made.
        """
        try:
            make_own_folder(self.folder)
        except OSError as error:
            raise cannot_write(self.folder, error) from error

    def remove(self) -> None:
        """Remove them, and their folder when nothing else lies there."""
        if self.folder.is_symlink():  # what it leads to is not ours
            self.folder.unlink()
            return
        (self.run / ABOUT).unlink(missing_ok=True)  # first: without it the other files are nothing
        self.clear()
        with contextlib.suppress(OSError):  # another file lies there
            self.folder.rmdir()

    def clear(self) -> None:
        """Remove what was done; the folder still says which run is unfinished."""
        if self.folder.is_dir():
            remove_partial_files(self.folder)
        for path in (self.state, self.submaps, self.tiles, self.tracked):
            path.unlink(missing_ok=True)
