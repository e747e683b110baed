"""The state of a computation, saved and restored, to resume a stopped run.

Values become trees of arrays, numbers and texts, driven by type hints; never code. Known are bool, int, float, str,
enumerations, `T | None`, `NDArray[dtype]` (with `Annotated[..., Shape(None, 3)]` the shape too), `list[T]`,
`tuple[T, ...]`, `tuple[A, B]`, `dict[K, V]`, dataclasses and `Stateful` classes, nested at will. Lists are stored by
columns: a list of a thousand (4, 4) arrays is one array (1000, 4, 4), a list of dataclasses a list for each field.
Arrays that are read back have the types and shapes of their hints; else the file is taken as this program wrote it.
"""

import dataclasses
import inspect
import os
import tempfile
import types
import typing
import weakref
import zlib
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.files import open_own

State = dict[str, Any]  # arrays, numbers, texts, None, lists of these, and further trees


class Shape:
    """Expected shape of an array, in an `Annotated` hint; None stands for any length."""

    def __init__(self, *lengths: int | None) -> None:
        self.lengths = lengths

    def fits(self, shape: tuple[int, ...]) -> bool:
        """Whether an array of that shape is one of these."""
        same = (wanted in (None, found) for wanted, found in zip(self.lengths, shape, strict=False))
        return len(shape) == len(self.lengths) and all(same)


TRANSFORM = Shape(4, 4)


class Saved:
    """A tree read back from a file; the place of the tree and the remedy are for errors."""

    def __init__(self, values: Mapping[str, Any], place: str = "the state", remedy: str = "begin again") -> None:
        self._values = values
        self.place, self.remedy = place, remedy

    def value(self, name: str) -> Any:
        """The tree under a name; InputError where there is none."""
        if name not in self._values:
            raise self.refuse(f"{name} is missing")
        return self._values[name]

    def has(self, name: str) -> bool:
        """Whether the value under a name is not None."""
        return self.value(name) is not None

    def part(self, name: str) -> "Saved":
        """The branch under a name."""
        return self.branch(self.value(name))

    def branch(self, tree: Any) -> "Saved":
        """A branch at this place."""
        return Saved(tree, self.place, self.remedy)

    def refuse(self, reason: str) -> InputError:
        """The error for a tree of another version of the program."""
        return InputError(f"{self.place}: is not what this program saves ({reason}); {self.remedy}")


@typing.runtime_checkable
class Restorable(typing.Protocol):
    """Carries a state from scan to scan."""

    def state(self) -> State | None:
        """The state it carries; None where it cannot be saved, nor a run resumed."""

    def restore(self, saved: Saved) -> None:
        """Resume from a state, before the first scan."""


class Stateful:
    """A mutable object whose state can be saved: exactly the attributes annotated in its class body.

    Attributes that are annotated nowhere, or only inside methods, are not saved: settings, caches, open files. An
    attribute that holds a `Stateful` object is restored in place. In lists and optionals such objects are created
    without `__init__`, so that their classes must declare every attribute, or rebuild the others in `_after_restore`.
    """

    def state(self) -> State:
        """The values of all declared attributes; arrays are not copied."""
        return {name: encode(kind, getattr(self, name)) for name, kind in _hints(type(self)).items()}

    def restore(self, saved: Saved) -> None:
        """Take over a state; InputError where it lacks an attribute, or a value does not fit its hint."""
        for name, kind in _hints(type(self)).items():
            present, tree = getattr(self, name, None), saved.value(name)
            if tree is not None and isinstance(present, Restorable):
                present.restore(saved.part(name))
            else:
                setattr(self, name, decode(kind, tree, saved))
        self._after_restore()

    def _after_restore(self) -> None:
        """Rebuild the attributes that are not saved."""


def encode(kind: Any, value: Any) -> Any:
    """The tree of a value of that type."""
    kind, _ = _bare(kind)
    if (inner := _optional(kind)) is not None:
        return None if value is None else encode(inner, value)
    origin, items = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin is tuple and Ellipsis not in items:
        return [encode(item, one) for item, one in zip(items, value, strict=True)]
    if origin in (list, tuple):
        return _encode_list(items[0], list(value))
    if origin is dict:
        return {"keys": _encode_list(items[0], [*value]), "values": _encode_list(items[1], [*value.values()])}
    return _encode_plain(origin, value)


def _encode_plain(kind: Any, value: Any) -> Any:
    if isinstance(value, Restorable):
        return value.state()
    if dataclasses.is_dataclass(kind):
        return {name: encode(hint, getattr(value, name)) for name, hint in _hints(kind).items()}
    if isinstance(value, Enum):
        return value.name
    return value.item() if isinstance(value, np.generic) else value


def decode(kind: Any, tree: Any, saved: Saved) -> Any:
    """The value of that type that a tree of `encode` stands for; InputError where an array of it is another one."""
    kind, shape = _bare(kind)
    if (inner := _optional(kind)) is not None:
        return None if tree is None else decode(inner, tree, saved)
    origin, items = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin is np.ndarray:
        return _decode_array(items[1], shape, tree, saved)
    if origin is dict:
        keys, values = (
            _decode_list(item, tree[name], saved) for item, name in zip(items, ("keys", "values"), strict=True)
        )
        return dict(zip(keys, values, strict=True))
    if origin is list or Ellipsis in items:
        return origin(_decode_list(items[0], tree, saved))
    if origin is tuple:
        return tuple(decode(item, one, saved) for item, one in zip(items, tree, strict=True))
    return _decode_plain(origin, tree, saved)


def _decode_plain(kind: Any, tree: Any, saved: Saved) -> Any:
    if hasattr(kind, "restore"):
        kind = _concrete(kind, tree)
        made = kind.__new__(kind)
        made.restore(saved.branch(tree))
        return made
    if dataclasses.is_dataclass(kind):
        part = saved.branch(tree)
        return kind(**{name: decode(hint, part.value(name), saved) for name, hint in _hints(kind).items()})  # type: ignore[operator]
    return kind[tree] if issubclass(kind, Enum) else kind(tree)


def _concrete(kind: Any, tree: Any) -> Any:
    """The class itself, or of an abstract one the subclass whose attributes a tree has."""
    if not inspect.isabstract(kind):
        return kind
    return next(one for one in kind.__subclasses__() if set(_hints(one)) == set(tree))


def _decode_array(dtype: Any, shape: Shape | None, tree: Any, saved: Saved, of_list: bool = False) -> Any:
    """An array, or of a list of arrays the one that they are rows of."""
    (wanted,) = typing.get_args(dtype)
    lengths = tree.shape[1:] if of_list else tree.shape
    if not np.issubdtype(tree.dtype, typing.get_origin(wanted) or wanted) or not (shape is None or shape.fits(lengths)):
        expected = getattr(wanted, "__name__", wanted)
        raise saved.refuse(f"expected an array of {expected}, got {tree.dtype} {tree.shape}")
    return tree if tree.flags.writeable and tree.flags.c_contiguous else tree.copy()


# Plain values of a list become one array of this type.
_COLUMNS: dict[Any, type] = {float: np.float64, int: np.int64, bool: np.bool_}


def _encode_list(kind: Any, values: list[Any]) -> Any:
    """A column: one array where the values allow it, columns of columns for dataclasses, else a list of trees."""
    bare, _ = _bare(kind)
    if (inner := _optional(bare)) is not None:
        known = np.array([value is not None for value in values], dtype=np.bool_)
        return {"known": known, "values": _encode_list(inner, [value for value in values if value is not None])}
    if bare in _COLUMNS:
        return np.array(values, dtype=_COLUMNS[bare])
    if typing.get_origin(bare) is np.ndarray and len({(one.shape, one.dtype) for one in values}) == 1:
        return np.stack(values)
    if _is_columnar(bare):
        columns = {name: (hint, [getattr(one, name) for one in values]) for name, hint in _hints(bare).items()}
        return {name: _encode_list(*column) for name, column in columns.items()}
    return [encode(kind, value) for value in values]


def _decode_list(kind: Any, tree: Any, saved: Saved) -> Any:
    bare, shape = _bare(kind)
    if (inner := _optional(bare)) is not None:
        present = iter(_decode_list(inner, tree["values"], saved))
        return [next(present) if one else None for one in tree["known"]]
    if bare in _COLUMNS:
        return tree.tolist()
    if isinstance(tree, np.ndarray):
        return list(_decode_array(typing.get_args(bare)[1], shape, tree, saved, of_list=True))
    if _is_columnar(bare):
        part = saved.branch(tree)
        columns = [_decode_list(hint, part.value(name), saved) for name, hint in _hints(bare).items()]
        return [bare(*row) for row in zip(*columns, strict=True)]
    return [decode(kind, one, saved) for one in tree]


def _is_columnar(kind: Any) -> bool:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind) and not hasattr(kind, "restore")


def _hints(kind: Any) -> dict[str, Any]:
    """Names and types of the saved attributes of a class, in the order of their declaration."""
    hints = typing.get_type_hints(kind, include_extras=True)
    if dataclasses.is_dataclass(kind):
        return {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    return {name: hint for name, hint in hints.items() if typing.get_origin(hint) is not typing.ClassVar}


def _bare(kind: Any) -> tuple[Any, Shape | None]:
    """A type without its annotations, and the shape that these name."""
    notes = getattr(kind, "__metadata__", ())
    return (typing.get_args(kind)[0] if notes else kind), next((one for one in notes if isinstance(one, Shape)), None)


def _optional(kind: Any) -> Any:
    """T of `T | None`; None for another type."""
    is_union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return next(one for one in typing.get_args(kind) if one is not types.NoneType) if is_union else None


class BlockFile(Stateful):
    """Blocks of bytes in an append-only file, made with the first; a saved state has those written before it.

    A file without a name is kept in the directory, or the system's temporary one, while it is needed; one with a name
    outlives the program, for `restore`.
    """

    _ends: list[int]  # bytes
    _checksums: list[int]

    def __init__(self, directory: Path | None = None, file: Path | None = None) -> None:
        self.directory, self._path = directory if file is None else file.parent, file
        self._open = self._is_closed = False
        self._ends, self._checksums = [0], []

    def state(self) -> State:
        """Where blocks end; they are on the disk by now; OSError where the disk is full."""
        if self._open:
            self._file.flush()
            os.fsync(self._file.fileno())
        return super().state()

    def restore(self, saved: Saved) -> None:
        """Resume from a state; InputError where the file is damaged."""
        super().restore(saved)
        self._opened()
        is_short = self._file.seek(0, os.SEEK_END) < self.size_bytes
        for index, checksum in enumerate(self._checksums):
            if is_short or zlib.crc32(self.read(index)) != checksum:
                raise InputError(f"{self._path}: is damaged (block {index}); {saved.remedy}")

    def __len__(self) -> int:
        return len(self._checksums)

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
        self._checksums.append(zlib.crc32(block))

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
