"""The state of a computation, saved and restored, to resume a stopped run.

Values become trees of arrays, numbers and texts, and are made of these again by type hints; never code. Known are bool,
int, float, str, enumerations, `T | None`, `NDArray[dtype]` (with `Annotated[..., Shape(None, 3)]` the shape too),
`list[T]`, `tuple[T, ...]`, `tuple[A, B]`, `dict[K, V]`, dataclasses and `Stateful` classes, nested at will. Lists are
stored by columns: a list of a thousand (4, 4) arrays is one array (1000, 4, 4), a list of dataclasses a list for each
field. Arrays that are read back have the types and shapes of their hints; else the file is taken as this program wrote
it.
"""

import dataclasses
import inspect
import json
import os
import tempfile
import types
import typing
import weakref
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.files import ONE_READER, open_own, written

State = dict[str, Any]  # arrays, numbers, texts, None, lists of these, and further trees

# In a file: the member with the tree as JSON, and the key of a reference to an array.
_TREE, _ARRAY = "tree", "array"


class Shape:
    """Expected shape of an array, in an `Annotated` hint; None stands for any length."""

    def __init__(self, *lengths: int | None) -> None:
        self.lengths = lengths

    def fits(self, shape: tuple[int, ...]) -> bool:
        """Whether an array of that shape is one of these."""
        same = (wanted in (None, found) for wanted, found in zip(self.lengths, shape, strict=False))
        return len(shape) == len(self.lengths) and all(same)


TRANSFORM = Shape(4, 4)


@typing.runtime_checkable
class Restorable(typing.Protocol):
    """Carries a state from scan to scan."""

    def state(self) -> State | None:
        """The state it carries; None where it cannot be saved, nor a run resumed."""

    def restore(self, saved: State) -> None:
        """Resume from a state, before the first scan."""


class Stateful:
    """A mutable object whose state can be saved: exactly the attributes annotated in its class body.

    Attributes that are annotated nowhere, or only inside methods, are not saved: settings, caches, open files. An
    attribute that holds a `Stateful` object is restored in place. In lists and optionals such objects are created
    without `__init__`, so that their classes must declare every attribute, or rebuild the others in `_after_restore`.
    """

    def state(self) -> State:
        """The values of all declared attributes; arrays are not copied."""
        return {name: encode(getattr(self, name)) for name in _hints(type(self))}

    def restore(self, saved: State) -> None:
        """Take over a state; InputError where an array does not fit its hint."""
        for name, kind in _hints(type(self)).items():
            present, tree = getattr(self, name, None), saved[name]
            if tree is not None and isinstance(present, Restorable):
                present.restore(tree)
            else:
                setattr(self, name, decode(kind, tree))
        self._after_restore()

    def _after_restore(self) -> None:
        """Rebuild the attributes that are not saved."""


def encode(value: Any) -> Any:
    """The tree of a value."""
    if isinstance(value, Restorable):
        return value.state()
    if dataclasses.is_dataclass(value):
        return {field.name: encode(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {"keys": _column([*value]), "values": _column([*value.values()])}
    if isinstance(value, list | tuple):
        return _column(value) if isinstance(value, list) else [encode(one) for one in value]
    if isinstance(value, Enum):
        return value.name
    return value.item() if isinstance(value, np.generic) else value


def _column(values: list[Any]) -> Any:
    """One array where the values allow it, columns of columns for dataclasses, else a list of trees."""
    if any(value is None for value in values):
        known = np.array([value is not None for value in values])
        return {"known": known, "values": _column([value for value in values if value is not None])}
    kinds = {type(value) for value in values}
    kind = kinds.pop() if len(kinds) == 1 else object
    if issubclass(kind, bool | int | float | np.generic) and not issubclass(kind, Enum):
        return np.array(values)
    if issubclass(kind, np.ndarray) and len({(value.shape, value.dtype) for value in values}) == 1:
        return np.stack(values)
    if dataclasses.is_dataclass(kind) and not hasattr(kind, "restore"):
        names = [field.name for field in dataclasses.fields(kind)]
        return {name: _column([getattr(value, name) for value in values]) for name in names}
    return [encode(value) for value in values]


def decode(kind: Any, tree: Any) -> Any:
    """The value of a type that a tree of `encode` stands for; InputError where an array of it is another one."""
    kind, shape = _bare(kind)
    if (inner := _optional(kind)) is not None:
        return None if tree is None else decode(inner, tree)
    origin, items = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin is np.ndarray:
        return _array(items[1], shape, tree)
    if origin is dict:
        return dict(
            zip(*(_list(item, tree[name]) for item, name in zip(items, ("keys", "values"), strict=True)), strict=True)
        )
    if origin is list or Ellipsis in items:
        return origin(_list(items[0], tree))
    if origin is tuple:
        return tuple(decode(item, one) for item, one in zip(items, tree, strict=True))
    return _made(origin, tree)


def _made(kind: Any, tree: Any) -> Any:
    if hasattr(kind, "restore"):
        if inspect.isabstract(kind):  # the subclass with these attributes
            kind = next(one for one in kind.__subclasses__() if set(_hints(one)) == set(tree))
        made = kind.__new__(kind)
        made.restore(tree)
        return made
    if dataclasses.is_dataclass(kind):
        return kind(**{name: decode(hint, tree[name]) for name, hint in _hints(kind).items()})  # type: ignore[operator]
    return kind[tree] if issubclass(kind, Enum) else kind(tree)


def _array(dtype: Any, shape: Shape | None, tree: Any, of_list: bool = False) -> Any:
    """An array, or of a list of arrays the one that they are rows of."""
    (wanted,) = typing.get_args(dtype)
    lengths = tree.shape[1:] if of_list else tree.shape
    if not np.issubdtype(tree.dtype, typing.get_origin(wanted) or wanted) or not (shape is None or shape.fits(lengths)):
        expected = getattr(wanted, "__name__", wanted)
        raise InputError(
            f"the checkpoint is not what this program saves (expected an array of {expected}, got {tree.dtype}"
            f" {tree.shape}); begin again with --overwrite"
        )
    return tree if tree.flags.writeable and tree.flags.c_contiguous else tree.copy()


def _list(kind: Any, tree: Any) -> list[Any]:
    """The values of a column."""
    bare, shape = _bare(kind)
    if (inner := _optional(bare)) is not None and isinstance(tree, dict) and set(tree) == {"known", "values"}:
        present = iter(_list(inner, tree["values"]))
        return [next(present) if one else None for one in tree["known"]]
    if inner is not None:
        return _list(inner, tree)
    if isinstance(tree, np.ndarray):
        is_rows = typing.get_origin(bare) is np.ndarray
        return list(_array(typing.get_args(bare)[1], shape, tree, of_list=True)) if is_rows else tree.tolist()
    if isinstance(tree, dict):
        columns = [_list(hint, tree[name]) for name, hint in _hints(bare).items()]
        return [bare(*row) for row in zip(*columns, strict=True)]
    return [decode(kind, one) for one in tree]


def _hints(kind: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(kind, include_extras=True)
    if dataclasses.is_dataclass(kind):
        return {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    return {name: hint for name, hint in hints.items() if typing.get_origin(hint) is not typing.ClassVar}


def _bare(kind: Any) -> tuple[Any, Shape | None]:
    """A type without its annotations, and the shape that these name."""
    notes = getattr(kind, "__metadata__", ())
    return (typing.get_args(kind)[0] if notes else kind), next((one for one in notes if isinstance(one, Shape)), None)


def _optional(kind: Any) -> Any:
    is_union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return next(one for one in typing.get_args(kind) if one is not types.NoneType) if is_union else None


def write_state(path: Path, state: State) -> None:
    """Write a tree to an .npz file, or raise an OutputError.

    After a power failure, the earlier file or the whole new one exists.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_without_arrays(state, arrays))
    members = {f"{_ARRAY}{number}": array for number, array in enumerate(arrays)}
    members[_TREE] = np.frombuffer(text.encode(), dtype=np.uint8)
    with written(path, durable=True) as partial, partial.open("wb") as out:
        np.savez(out, allow_pickle=False, **members)


def read_state(path: Path) -> State:
    """Read a file of `write_state`, never a pickle; InputError where there is no such file, or it is damaged."""
    try:
        with ONE_READER, np.load(path, allow_pickle=False) as file:
            tree: State = _with_arrays(json.loads(file[_TREE].tobytes()), file)
            return tree
    except Exception as error:  # of nearly any kind
        raise InputError(f"{path}: is damaged ({error}); begin again with --overwrite") from error


def _without_arrays(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """The tree for JSON; arrays are appended to the list, and referred to by their numbers."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {_ARRAY: len(arrays) - 1}
    if isinstance(value, dict):
        return {name: _without_arrays(entry, arrays) for name, entry in value.items()}
    return [_without_arrays(entry, arrays) for entry in value] if isinstance(value, list) else value


def _with_arrays(value: Any, file: Any) -> Any:
    if isinstance(value, dict):
        if set(value) == {_ARRAY}:
            return file[f"{_ARRAY}{value[_ARRAY]}"]
        return {name: _with_arrays(entry, file) for name, entry in value.items()}
    return [_with_arrays(entry, file) for entry in value] if isinstance(value, list) else value


class BlockFile(Stateful):
    """Blocks of bytes in an append-only file, made with the first; a saved state has those written before it.

    A file without a name is kept in the directory, or the system's temporary one, while it is needed; one with a name
    outlives the program, for `restore`.
    """

    _ends: list[int]  # bytes

    def __init__(self, directory: Path | None = None, file: Path | None = None) -> None:
        self.directory, self._path = directory if file is None else file.parent, file
        self._open = self._is_closed = False
        self._ends = [0]

    def state(self) -> State:
        """Where blocks end; they are on the disk by now; OSError where the disk is full."""
        if self._open:
            self._file.flush()
            os.fsync(self._file.fileno())
        return super().state()

    def restore(self, saved: State) -> None:
        """Resume from a state; InputError where the file is too short."""
        super().restore(saved)
        self._opened()
        if self._file.seek(0, os.SEEK_END) < self._ends[-1]:
            raise InputError(f"{self._path}: is damaged (too short); begin again with --overwrite")

    def __len__(self) -> int:
        return len(self._ends) - 1

    @property
    def size_bytes(self) -> int:
        """Of all blocks."""
        return self._ends[-1]

    def write(self, block: bytes) -> None:
        """Append one; any data after the last block was written after the restored state.

        OSError where the disk is full.
        """
        self._opened()
        self._file.truncate(self._ends[-1])
        self._file.seek(self._ends[-1])
        self._file.write(block)
        self._ends.append(self._ends[-1] + len(block))

    def read(self, index: int) -> bytes:
        """One of them."""
        self._opened()
        self._file.seek(self._ends[index])
        return self._file.read(self._ends[index + 1] - self._ends[index])

    def close(self) -> None:
        """Free the space."""
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
