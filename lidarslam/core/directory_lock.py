"""One writer a directory: two runs into one place would mix their files."""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from lidarslam.core.errors import OutputError

_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


@contextlib.contextmanager
def only_writer(path: Path) -> Iterator[None]:
    """Hold an existing directory for the time of the block; the lock ends with the process, however that ends.

    It is the directory itself that is locked, so that nothing is left lying there. Where the file system knows no
    locks, there is none.

    Raises:
        OutputError: somebody else holds it.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _TAKEN:
                raise OutputError(
                    f"{path}: another lidarslam is writing there; wait until it is done, or name another directory"
                ) from None
        yield
    finally:
        os.close(descriptor)
