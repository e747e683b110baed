"""A tree of arrays, numbers and texts in one .npz file: atomic, with checksums, never a pickle."""

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.files import ONE_READER, cannot_write, replacing
from lidarslam.core.json_text import ANY_OBJECT, parse_json
from lidarslam.core.state import Saved, State

# An .npz file holds a checksum of each of its members, and is refused without its end.
_TREE, _ARRAY = "tree", "array"
_DAMAGE = (
    OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, NotImplementedError, RuntimeError,
    zipfile.BadZipFile, zlib.error, MemoryError, OverflowError,  # a damaged shape
)  # fmt: skip

_REMEDY = "begin again with --overwrite"


def write_state(path: Path, state: State) -> None:
    """Write the file, or raise an OutputError; after a power failure, the earlier one or the whole new one exists."""
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_encoded(state, arrays))
    members = {f"{_ARRAY}{number}": array for number, array in enumerate(arrays)}
    members[_TREE] = np.frombuffer(text.encode(), dtype=np.uint8)
    try:
        with replacing(path, durable=True) as partial, partial.open("wb") as out:
            np.savez(out, allow_pickle=False, **members)
    except OSError as error:
        raise cannot_write(path, error) from error


def read_state(path: Path) -> Saved:
    """Read a file of `write_state`; InputError where there is no such file, or it is damaged."""
    try:
        with ONE_READER, np.load(path, allow_pickle=False) as file:
            values = _decoded(parse_json(file[_TREE].tobytes(), ANY_OBJECT, any_number=True), file)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except _DAMAGE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: is damaged ({reason}); {_REMEDY}") from error
    return Saved(values, str(path), _REMEDY)


def _encoded(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """The tree as JSON; arrays are appended to the list, and referred to by their numbers."""
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
