"""Saved state of objects, driven by their type hints; trees of arrays, numbers and texts, never code.

Known are bool, int, float, str, enumerations, `T | None`, `NDArray[dtype]` (with `Annotated[..., Shape(None, 3)]` the
shape too), `list[T]`, `tuple[T, ...]`, `tuple[A, B]`, `dict[K, V]`, dataclasses and `Stateful` classes, nested at will.
Lists are stored by columns: a list of a thousand (4, 4) arrays is one array (1000, 4, 4), a list of dataclasses a list
for each field.
"""

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray

State = dict[str, Any]
"""Names and values: arrays, numbers, texts, None, lists of these, and further trees."""

T = TypeVar("T")


class Saved:
    """A tree read back; every value is looked at before it is used.

    Args:
        values: the tree.
        place: where it comes from, for errors.
    """

    def __init__(self, values: Mapping[str, Any], place: str = "the state") -> None:
        self._values = values
        self.place = place

    def has(self, name: str) -> bool:
        """Whether there is a value, and not None.

        Raises:
            InputError: the name is not there at all; so in the other methods, or where the value is another thing.
        """
        return self._value(name) is not None

    def array(self, name: str, shape: Sequence[int | None], dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """An array of this shape, None for any length, and type; whoever takes it may write to it."""
        value = self._value(name)
        if not isinstance(value, np.ndarray) or value.dtype != np.dtype(dtype) or not _fits(value.shape, shape):
            found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            raise self._unfit(name, f"{np.dtype(dtype)} {tuple(shape)}", found)
        return value if value.flags.writeable else value.copy()

    def optional_array(
        self, name: str, shape: Sequence[int | None], dtype: DTypeLike = np.float64
    ) -> NDArray[Any] | None:
        """Likewise, or None."""
        return self.array(name, shape, dtype) if self.has(name) else None

    def number(self, name: str) -> float:
        """A number."""
        value = self._value(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self._unfit(name, "a number", type(value).__name__)
        return float(value)

    def optional_number(self, name: str) -> float | None:
        """Likewise, or None."""
        return self.number(name) if self.has(name) else None

    def integer(self, name: str) -> int:
        """A whole number."""
        return self._typed(name, int, "a whole number")

    def flag(self, name: str) -> bool:
        """True or false."""
        return self._typed(name, bool, "true or false")

    def text(self, name: str) -> str:
        """A text."""
        return self._typed(name, str, "a text")

    def optional_text(self, name: str) -> str | None:
        """Likewise, or None."""
        return self.text(name) if self.has(name) else None

    def numbers(self, name: str) -> list[float]:
        """A list of numbers."""
        return [float(value) for value in self._list(name, int | float, "numbers")]

    def integers(self, name: str) -> list[int]:
        """A list of whole numbers."""
        return [int(value) for value in self._list(name, int, "whole numbers")]

    def texts(self, name: str) -> list[str]:
        """A list of texts."""
        return [str(value) for value in self._list(name, str, "texts")]

    def part(self, name: str) -> "Saved":
        """A tree within this one."""
        return Saved(self._typed(name, dict, "a tree"), self.place)

    def optional(self, name: str, make: Callable[["Saved"], T]) -> T | None:
        """What a tree within this one is made into, or None."""
        return make(self.part(name)) if self.has(name) else None

    def parts(self, name: str) -> list["Saved"]:
        """A list of trees."""
        return [Saved(value, self.place) for value in self._list(name, dict, "trees")]

    def refuse(self, reason: str) -> InputError:
        """The error for a tree that contradicts itself."""
        return InputError(f"{self.place}: is not what this program saves ({reason}); begin again with --overwrite")

    def _value(self, name: str) -> Any:
        if name not in self._values:
            raise self.refuse(f"{name} is missing")
        return self._values[name]

    def _typed(self, name: str, kind: type[T], wanted: str) -> T:
        value = self._value(name)
        if type(value) is not kind:  # a bool is an int otherwise
            raise self._unfit(name, wanted, type(value).__name__)
        return value

    def _list(self, name: str, kind: Any, wanted: str) -> list[Any]:
        values: list[Any] = self._typed(name, list, f"a list of {wanted}")
        if any(isinstance(value, bool) or not isinstance(value, kind) for value in values):
            raise self._unfit(name, f"a list of {wanted}", "others")
        return values

    def value(self, name: str) -> Any:
        """The tree under a name."""
        return self._value(name)

    def at(self, name: str) -> "Saved":
        """The same tree, for errors about the value under a name."""
        return Saved(self._values, f"{self.place}, {name}")

    def unfit(self, wanted: str, found: Any) -> InputError:
        """The error for a value of another type or shape."""
        what = f"{found.dtype} {found.shape}" if isinstance(found, np.ndarray) else type(found).__name__
        return self.refuse(f"expected {wanted}, got {what}")

    def _unfit(self, name: str, wanted: str, found: str) -> InputError:
        return self.refuse(f"{name} should be {wanted}, and is {found}")


@dataclass(frozen=True)
class Shape:
    """Expected shape of an array in an `Annotated` hint; None stands for any length."""

    lengths: tuple[int | None, ...]

    def __init__(self, *lengths: int | None) -> None:
        object.__setattr__(self, "lengths", lengths)

    def fits(self, shape: Sequence[int]) -> bool:
        """Whether an array of that shape is one of these."""
        return len(shape) == len(self.lengths) and all(
            wanted in (None, found) for wanted, found in zip(self.lengths, shape, strict=True)
        )


@typing.runtime_checkable
class _Restorable(typing.Protocol):
    def state(self) -> State | None: ...
    def restore(self, saved: Saved) -> None: ...


class Stateful:
    """A mutable object whose state can be saved: exactly the attributes annotated in its class body.

    Attributes that are annotated nowhere, or only inside methods, are not saved: settings, caches, open files. An
    attribute that holds a `Stateful` object is restored in place. In lists and optionals such objects are created
    without `__init__`, so that their classes must declare every attribute, or rebuild the others in `_after_restore`.
    """

    def state(self) -> State:
        """The values of all declared attributes; arrays are not copied."""
        return {name: _encode_attribute(kind, getattr(self, name)) for name, kind in _hints(type(self)).items()}

    def restore(self, saved: Saved) -> None:
        """Take over a state.

        Raises:
            InputError: it lacks an attribute, or a value does not fit its hint or the others.
        """
        for name, kind in _hints(type(self)).items():
            present, tree = getattr(self, name, None), saved.value(name)
            if tree is not None and isinstance(present, _Restorable):
                present.restore(saved.part(name))
            else:
                setattr(self, name, decode(kind, tree, saved.at(name)))
        _checked(saved, self._after_restore)

    def _after_restore(self) -> None:
        """Rebuild what is not saved, and check what belongs together; a ValueError refuses the state."""


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
        return {"keys": _encode_list(items[0], list(value)), "values": _encode_list(items[1], list(value.values()))}
    return _encode_plain(origin, value)


def _encode_plain(kind: Any, value: Any) -> Any:
    if hasattr(value, "state"):
        return value.state()
    if _is_dataclass(kind):
        return {name: encode(hint, getattr(value, name)) for name, hint in _hints(kind).items()}
    if isinstance(value, Enum):
        return value.name
    return value.item() if isinstance(value, np.generic) else value


def decode(kind: Any, tree: Any, saved: Saved) -> Any:
    """The value of that type that a tree stands for.

    Args:
        kind: the type hint.
        tree: made by `encode` with the same hint.
        saved: where it stands, for errors.

    Raises:
        InputError: the tree is another one.
    """
    kind, shape = _bare(kind)
    if (inner := _optional(kind)) is not None:
        return None if tree is None else decode(inner, tree, saved)
    origin, items = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin is np.ndarray:
        return _decode_array(items[1], shape, tree, saved)
    if origin is dict:
        parts = _tree(tree, saved)
        columns = [
            _decode_list(one, parts.get(name), saved) for one, name in zip(items, ("keys", "values"), strict=True)
        ]
        return _checked(saved, lambda: dict(zip(*columns, strict=True)))
    if origin is list or Ellipsis in items:
        return origin(_decode_list(items[0], tree, saved))
    if origin is tuple:
        if not isinstance(tree, list) or len(tree) != len(items):
            raise saved.unfit(f"{len(items)} values", tree)
        return tuple(decode(item, one, saved) for item, one in zip(items, tree, strict=True))
    return _decode_plain(origin, tree, saved)


def _decode_plain(kind: Any, tree: Any, saved: Saved) -> Any:
    if hasattr(kind, "restored"):
        return kind.restored(Saved(_tree(tree, saved), saved.place))
    if issubclass(kind, Stateful):
        made = kind.__new__(kind)
        made.restore(Saved(_tree(tree, saved), saved.place))
        return made
    if _is_dataclass(kind):
        part = Saved(_tree(tree, saved), saved.place)
        values = {name: decode(hint, part.value(name), part.at(name)) for name, hint in _hints(kind).items()}
        return _checked(saved, lambda: kind(**values))
    if issubclass(kind, Enum):
        if not isinstance(tree, str) or tree not in kind.__members__:
            raise saved.unfit(f"one of {', '.join(kind.__members__)}", tree)
        return kind[tree]
    if kind is float and type(tree) is int:
        return float(tree)
    if type(tree) is not kind:  # a bool is an int otherwise
        raise saved.unfit(kind.__name__, tree)
    return tree


def _decode_array(dtype: Any, shape: Shape | None, tree: Any, saved: Saved) -> Any:
    (wanted,) = typing.get_args(dtype)
    if not isinstance(tree, np.ndarray) or not np.issubdtype(tree.dtype, typing.get_origin(wanted) or wanted):
        raise saved.unfit(f"an array of {getattr(wanted, '__name__', wanted)}", tree)
    if shape is not None and not shape.fits(tree.shape):
        raise saved.unfit(f"an array of shape {shape.lengths}", tree)
    return tree if tree.flags.writeable else tree.copy()


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
        return {
            "count": len(values),
            **{name: _encode_list(hint, [getattr(one, name) for one in values]) for name, hint in _hints(bare).items()},
        }
    return [encode(kind, value) for value in values]


def _decode_list(kind: Any, tree: Any, saved: Saved) -> Any:
    bare, _ = _bare(kind)
    if (inner := _optional(bare)) is not None:
        part = Saved(_tree(tree, saved), saved.place)
        known = decode(_BOOLS, part.value("known"), part.at("known"))
        present = iter(_decode_list(inner, part.value("values"), part.at("values")))
        return _checked(saved, lambda: [next(present) if one else None for one in known])
    if bare in _COLUMNS:
        if not isinstance(tree, np.ndarray) or tree.ndim != 1 or tree.dtype != _COLUMNS[bare]:
            raise saved.unfit(f"an array of {bare.__name__}", tree)
        return tree.tolist()
    if isinstance(tree, np.ndarray):
        return [decode(kind, one, saved) for one in tree]
    if _is_columnar(bare):
        part = Saved(_tree(tree, saved), saved.place)
        columns = [_decode_list(hint, part.value(name), part.at(name)) for name, hint in _hints(bare).items()]
        if any(len(column) != part.value("count") for column in columns):
            raise saved.refuse(f"columns of {bare.__name__} differ in length")
        return _checked(saved, lambda: [bare(*row) for row in zip(*columns, strict=True)])
    if not isinstance(tree, list):
        raise saved.unfit("a list", tree)
    return [decode(kind, one, saved) for one in tree]


_BOOLS = np.ndarray[Any, np.dtype[np.bool_]]


def _is_dataclass(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind)


def _is_columnar(kind: Any) -> bool:
    return isinstance(kind, type) and _is_dataclass(kind) and not issubclass(kind, Stateful)


def _hints(kind: Any) -> Mapping[str, Any]:
    """Names and types of the saved attributes of a class, in the order of their declaration."""
    return _declared(kind)


@cache
def _declared(kind: Any) -> Mapping[str, Any]:
    hints = typing.get_type_hints(kind, include_extras=True)
    if _is_dataclass(kind):
        return {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    return {name: hint for name, hint in hints.items() if typing.get_origin(hint) is not typing.ClassVar}


def _encode_attribute(kind: Any, value: Any) -> Any:
    return value.state() if isinstance(value, _Restorable) else encode(kind, value)


def _bare(kind: Any) -> tuple[Any, Shape | None]:
    """A type without its annotations, and the shape among them."""
    if typing.get_origin(kind) is not typing.Annotated:
        return kind, None
    inner, *notes = typing.get_args(kind)
    return inner, next((note for note in notes if isinstance(note, Shape)), None)


def _optional(kind: Any) -> Any:
    """T of `T | None`; None for another type."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return None
    (inner,) = (one for one in typing.get_args(kind) if one is not types.NoneType)
    return inner


def _tree(tree: Any, saved: Saved) -> dict[str, Any]:
    if not isinstance(tree, dict):
        raise saved.unfit("a tree", tree)
    return tree


def _checked(saved: Saved, make: Any) -> Any:
    """The result of a function that may find the values contradictory."""
    try:
        return make()
    except (ValueError, TypeError, IndexError, RuntimeError, StopIteration) as error:
        raise saved.refuse(str(error) or type(error).__name__) from error


def stack(values: Sequence[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Arrays of one shape as a single one (N, *shape), which may hold none."""
    return np.array(values, dtype=np.float64).reshape(len(values), *shape)


def _fits(shape: Sequence[int], wanted: Sequence[int | None]) -> bool:
    return len(shape) == len(wanted) and all(w is None or n == w for n, w in zip(shape, wanted, strict=True))
