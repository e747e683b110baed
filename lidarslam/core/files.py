"""Files that are whole or absent, directories with one writer, arrays read by one thread at a time, bounded text."""

import contextlib
import errno
import fcntl
import os
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError, LidarSlamError, OutputError
from lidarslam.core.text import reason

ONE_READER = threading.Lock()
"""To be held while arrays are read in another way than by `read_array`.

NumPy parses the header of an array as Python. Up to Python 3.11.7 two threads that parse at a time disturb one another,
and one of them has a SystemError (python/cpython#106905).
"""

_PARTIAL = ".partial-"
_LOCKED = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)
_POLL_S = 0.2
# Ten million poses and more, in a file and in a line.
_LONGEST_BYTES, _LONGEST_LINE = 1 << 30, 1 << 16
_MARK = b"\xef\xbb\xbf"  # of byte order


@contextlib.contextmanager
def replacing(path: Path, durable: bool = False) -> Iterator[Path]:
    """Write a file atomically: a temporary path next to it, renamed to it when the block ends without an error.

    With `durable`, content and name are flushed to the disk, so that a power failure leaves the earlier file or the new
    one. OutputError where the path is a folder or a device, or the temporary file cannot take its name.
    """
    if path.exists() and not path.is_file():  # a device would be replaced by a file of its name
        raise OutputError(f"{path}: is {'a folder' if path.is_dir() else 'no ordinary file'}; name another file")
    partial = path.with_name(f"{_PARTIAL}{os.getpid()}-{path.name}")
    partial.unlink(missing_ok=True)  # a link there is not followed
    try:
        yield partial
        try:
            if durable:
                _sync(partial)
            partial.replace(path)
        except OSError as error:
            raise cannot_write(path, error) from error
        if durable:
            with contextlib.suppress(OSError):  # not every file system syncs directories
                _sync(path.parent)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


@contextlib.contextmanager
def written(path: Path, remedy: str = "", durable: bool = False) -> Iterator[Path]:
    """As `replacing`; the errors of the system are for the user."""
    try:
        with replacing(path, durable) as partial:
            yield partial
    except OSError as error:
        raise cannot_write(path, error, remedy) from error


def remove_partial_files(directory: Path) -> None:
    """Remove the files that `replacing` left in a directory when the process was killed."""
    for partial in directory.glob(f"{_PARTIAL}*"):
        if not partial.is_dir():
            partial.unlink(missing_ok=True)


def make_directory(path: Path) -> None:
    """Make a directory with its parents, unless it exists; OutputError where files cannot be written to it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path, prefix=_PARTIAL):
            pass
    except (FileExistsError, NotADirectoryError) as error:
        raise OutputError(f"{path}: a file is in the way; name another directory") from error
    except OSError as error:
        raise cannot_write(path, error) from error


def open_own(path: Path, anew: bool = False) -> BinaryIO:
    """Open a file of this program for reading and writing, or make it; `anew`, an existing one is replaced.

    The target of a link is never written: OutputError where it is one, has a second name elsewhere (a hard link), or is
    no ordinary file.
    """
    if anew:
        path.unlink(missing_ok=True)
    if path.is_symlink() or (path.exists() and (not path.is_file() or path.stat().st_nlink > 1)):
        raise OutputError(f"{path}: is a link to a file elsewhere, or no ordinary file; remove it, or begin again")
    path.touch()
    return path.open("r+b")


def make_own_folder(path: Path) -> None:
    """Make a folder in a directory of results, unless it exists; a link there is replaced, not followed."""
    if path.is_symlink():
        path.unlink()
    path.mkdir(exist_ok=True)


def require_no_link(places: Iterable[Path]) -> None:
    """Refuse to write where a link in a directory of results leads; OutputError where one of the places is a link."""
    link = next((place for place in places if place.is_symlink()), None)
    if link is not None:
        raise OutputError(f"{link}: is a link to another place, where nothing is written; remove it")


@contextlib.contextmanager
def only_writer(directory: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Hold an advisory lock on an existing directory; it ends with the process, however that ends.

    Where the file system has no locks, nothing is locked. OutputError where another process holds it, for longer than
    `patience_s`.
    """
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        until = time.monotonic() + patience_s
        while not _is_locked(descriptor):
            if time.monotonic() >= until:
                raise OutputError(
                    f"{directory}: another lidarslam is writing there; wait until it is done, or name another directory"
                )
            time.sleep(_POLL_S)
        yield
    finally:
        os.close(descriptor)


def _is_locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in _LOCKED
    return True


def cannot_write(path: Path, error: Exception, remedy: str = "") -> OutputError:
    """The error for the user when a file cannot be written."""
    return OutputError(f"{path}: cannot be written ({getattr(error, 'strerror', None) or error}){remedy}")


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def reading(place: Path, fault: str, remedy: str) -> Iterator[None]:
    """InputError of the fault for any error in the block: libraries meet damaged data with nearly anything."""
    try:
        yield
    except LidarSlamError:
        raise
    except Exception as error:
        raise InputError(f"{place}: {fault} ({reason(error)}); {remedy}") from error


def read_array(file: IO[bytes]) -> NDArray[Any]:
    """Read one array in NumPy's format, never a pickle; nearly any Exception where the file is damaged."""
    with ONE_READER:
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def bounded_lines(path: Path) -> Iterator[str]:
    """The lines of a text file without their ends; InputError where it is missing, no UTF-8, or too long."""
    read = 0
    try:
        with path.open("rb") as file:
            while line := file.readline(_LONGEST_LINE + 1):
                if len(line) > _LONGEST_LINE:
                    raise InputError(f"{path}: cannot be read as text (a line has more than {_LONGEST_LINE:,} bytes)")
                line = line.removeprefix(_MARK) if read == 0 else line
                read += len(line)
                if read > _LONGEST_BYTES:
                    raise InputError(f"{path}: is longer than a gigabyte, which no text of a recording is")
                yield line.decode("utf-8").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from error
