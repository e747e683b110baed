"""Blocks of bytes in an append-only file; a saved state has those that were written before it."""

import os
import tempfile
import weakref
import zlib
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.files import open_own
from lidarslam.core.state.stateful import Saved, State, Stateful
from lidarslam.core.state.tree import checked


class BlockFile(Stateful):
    """Blocks in a file, in order; the file is made with the first of them.

    Args:
        directory: where a file without a name lies while it is needed; None: the system's temporary directory.
        file: a file that outlives the program instead, for `restore`.
    """

    _ends: list[int]  # bytes
    _checksums: list[int]

    def __init__(self, directory: Path | None = None, file: Path | None = None) -> None:
        self.directory, self._path = directory if file is None else file.parent, file
        self._open = self._is_closed = False
        self._ends, self._checksums = [0], []

    def state(self) -> State:
        """Where blocks end; they are on the disk by now.

        Raises:
            OSError: the disk is full.
        """
        if self._open:
            self._file.flush()
            os.fsync(self._file.fileno())
        return super().state()

    def restore(self, saved: Saved) -> None:
        """Go on from a state.

        Raises:
            InputError: the file is damaged.
        """
        super().restore(saved)
        self._opened()
        is_short = self._file.seek(0, os.SEEK_END) < self.size_bytes
        for index, checksum in enumerate(self._checksums):
            block = b"" if is_short else self.read(index)
            if is_short or zlib.crc32(block) != checksum:
                raise InputError(f"{self._path}: is damaged (block {index}); begin again with --overwrite")
            checked(saved, lambda index=index, block=block: self._require(index, block))

    def _require(self, index: int, block: bytes) -> None:
        """Check the content of a block that is restored; a ValueError refuses it."""

    def _after_restore(self) -> None:
        count = len(self._checksums)
        if self._ends[:1] != [0] or len(self._ends) != count + 1 or min(np.diff(self._ends), default=0) < 0:
            raise ValueError(f"{count} blocks end at {self._ends[:2]}, ...")

    def __len__(self) -> int:
        return len(self._checksums)

    @property
    def size_bytes(self) -> int:
        """Of all blocks."""
        return self._ends[-1]

    def write(self, block: bytes) -> None:
        """Keep one more; what lies behind the last was written after the state that was restored.

        Raises:
            OSError: the disk is full.
        """
        self._opened()
        self._file.truncate(self._ends[-1])
        self._file.seek(self._ends[-1])
        self._file.write(block)
        self._ends.append(self._ends[-1] + len(block))
        self._checksums.append(zlib.crc32(block))

    def read(self, index: int) -> bytes:
        """One of them."""
        self._opened()
        self._file.seek(self._ends[index])
        return self._file.read(self._ends[index + 1] - self._ends[index])

    def close(self) -> None:
        """Give the space back."""
        self._is_closed = True
        if self._open:
            self._file.close()

    def _opened(self) -> None:
        if self._is_closed:
            raise ValueError("the file is closed")
        if not self._open:
            # Closed by `close`, at the latest with this object.
            self._file = tempfile.TemporaryFile(dir=self.directory) if self._path is None else open_own(self._path)  # noqa: SIM115
            self._open = True
            weakref.finalize(self, self._file.close)
