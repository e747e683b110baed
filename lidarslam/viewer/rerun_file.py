"""A file that Rerun writes through a pipe: its own writer may never end once the disk is full."""

import contextlib
import os
import threading
from pathlib import Path

# Where an open file of this process has a path.
_ENTRANCES = Path("/dev/fd")
# A pipe hands over this much at most.
_PIECE = 1 << 20
# What there was to write is in the pipe by the time anybody waits, and the disk takes it.
_LAST_PIECES_S = 60.0


class PipedFile:
    """A file, and a path through which another writer fills it without ever being told that it failed.

    Once a piece cannot be written, the file is emptied, which gives its room back, and the rest is swallowed.

    Attributes:
        entrance: what the other writer opens; it must be open there before `let_go`.
        failure: why the file could not be written; None as long as it could.
    """

    def __init__(self, path: Path) -> None:
        """Make the file.

        Raises:
            OSError: it cannot be made.
        """
        self._file = path.open("wb", buffering=0)
        self._outlet, self._inlet = os.pipe()
        self.entrance = _ENTRANCES / str(self._inlet)
        self.failure: OSError | None = None
        self._thread = threading.Thread(target=self._follow, name="recording", daemon=True)
        self._thread.start()

    def let_go(self) -> None:
        """The other writer holds the entrance open by now; when it closes it, the file ends."""
        if self._inlet >= 0:
            os.close(self._inlet)
            self._inlet = -1

    def finish(self) -> bool:
        """Wait until the other writer has closed the entrance and all is written; whether it came to that."""
        self.let_go()
        self._thread.join(_LAST_PIECES_S)
        return not self._thread.is_alive()

    def _follow(self) -> None:
        try:
            with self._file as file:
                while piece := os.read(self._outlet, _PIECE):
                    if self.failure is not None:
                        continue
                    try:
                        _write_all(file.fileno(), piece)
                    except OSError as error:
                        self.failure = error
                        with contextlib.suppress(OSError):  # a failing disk, or no file on one
                            file.truncate(0)
        finally:  # a writer that nobody reads waits for ever
            os.close(self._outlet)


def _write_all(handle: int, piece: bytes) -> None:
    """All of it: a disk that fills up takes a part first, and says so only of the next."""
    left = memoryview(piece)
    while left:
        left = left[os.write(handle, left) :]
