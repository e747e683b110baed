"""A tree of arrays, numbers and texts in one file: whole or absent, checked as it is read, and never a pickle."""

import contextlib
import json
import os
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.state import Saved, State

# An .npz file holds a checksum of each of its members, and without its end it is none.
_TREE, _ARRAY = "tree", "array"
_DAMAGE = (
    OSError, ValueError, KeyError, EOFError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error,
    MemoryError, OverflowError,  # of an array whose shape is not its own
)  # fmt: skip


def write_state(path: Path, state: State) -> None:
    """Write the file. Whenever this is cut short, be it by the power, the earlier file or the whole new one is there.

    Raises:
        OutputError: it cannot be written.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_encoded(state, arrays))
    members = {f"{_ARRAY}{number}": array for number, array in enumerate(arrays)}
    members[_TREE] = np.frombuffer(text.encode(), dtype=np.uint8)
    with replacing_for_good(path) as out:
        np.savez(out, allow_pickle=False, **members)


@contextlib.contextmanager
def replacing_for_good(path: Path) -> Iterator[BinaryIO]:
    """A file to write to, which takes its name when it is on the disk; the earlier one stays until then.

    Raises:
        OutputError: it cannot be written.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        with partial.open("wb") as out:
            yield out
            out.flush()
            os.fsync(out.fileno())
        partial.replace(path)
        _sync_directory(path.parent)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def read_state(path: Path) -> Saved:
    """Read what `write_state` wrote.

    Raises:
        InputError: there is no such file, or it is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            tree = json.loads(bytes(file[_TREE]))
            values = _decoded(tree, file)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except _DAMAGE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: is damaged ({reason}); begin again with --overwrite") from error
    return Saved(values, str(path))


def _sync_directory(path: Path) -> None:
    """See that the names in a directory are on the disk, where the system can do that."""
    with contextlib.suppress(OSError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _encoded(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """The tree as JSON has it; arrays are put aside, and their numbers in their places."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {_ARRAY: len(arrays) - 1}
    if isinstance(value, dict):
        if _ARRAY in value:
            raise ValueError(f"the name {_ARRAY!r} is taken")
        return {name: _encoded(entry, arrays) for name, entry in value.items()}
    if isinstance(value, list):
        return [_encoded(entry, arrays) for entry in value]
    return value


def _decoded(value: Any, file: Any) -> Any:
    if isinstance(value, dict):
        if set(value) == {_ARRAY}:
            return file[f"{_ARRAY}{value[_ARRAY]}"]
        return {name: _decoded(entry, file) for name, entry in value.items()}
    if isinstance(value, list):
        return [_decoded(entry, file) for entry in value]
    return value
