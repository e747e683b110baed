"""Values as trees of arrays, numbers and texts, driven by type hints; never code.

Known are bool, int, float, str, enumerations, `T | None`, `NDArray[dtype]` (with `Annotated[..., Shape(None, 3)]` the
shape too), `list[T]`, `tuple[T, ...]`, `tuple[A, B]`, `dict[K, V]`, dataclasses and `Stateful` classes, nested at will.
Lists are stored by columns: a list of a thousand (4, 4) arrays is one array (1000, 4, 4), a list of dataclasses a list
for each field. What is read back has the types, shapes and bounds of its hints, see `lidarslam.core.state.values`.
"""

import dataclasses
import inspect
import types
import typing
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.state.values import Shape, Values, values_of

State = dict[str, Any]  # arrays, numbers, texts, None, lists of these, and further trees


class Saved:
    """A tree read back from a file.

    Args:
        values: the tree.
        place: the file, and where in it, for errors.
    """

    def __init__(self, values: Mapping[str, Any], place: str = "the state") -> None:
        self._values = values
        self.place = place

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
        return Saved(_tree(self.value(name), self.at(name)), self.place)

    def at(self, name: str) -> "Saved":
        """The same tree, for errors about the value under a name."""
        return Saved(self._values, f"{self.place}, {name}")

    def refuse(self, reason: str) -> InputError:
        """The error for a tree that contradicts itself."""
        return InputError(f"{self.place}: is not what this program saves ({reason}); begin again with --overwrite")

    def unfit(self, wanted: str, found: Any) -> InputError:
        """The error for a value of another type or shape."""
        what = f"{found.dtype} {found.shape}" if isinstance(found, np.ndarray) else type(found).__name__
        return self.refuse(f"expected {wanted}, got {what}")


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
        return dict(
            zip(_DICT, (_encode_list(items[0], [*value]), _encode_list(items[1], [*value.values()])), strict=True)
        )
    return _encode_plain(origin, value)


def _encode_plain(kind: Any, value: Any) -> Any:
    if hasattr(value, "state"):
        return value.state()
    if _is_dataclass(kind):
        return {name: encode(hint, getattr(value, name)) for name, hint in hints_of(kind).items()}
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
    kind, values = _bare(kind)
    if (inner := _optional(kind)) is not None:
        return None if tree is None else decode(inner, tree, saved)
    origin, items = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin is np.ndarray:
        return _decode_array(items[1], values, tree, saved)
    if origin is dict:
        parts = _tree(tree, saved)
        keys, values = (_decode_list(one, parts.get(name), saved) for one, name in zip(items, _DICT, strict=True))
        return checked(saved, lambda: dict(zip(keys, values, strict=True)))
    if origin is list or Ellipsis in items:
        return origin(_decode_list(items[0], tree, saved))
    if origin is tuple:
        if not isinstance(tree, list) or len(tree) != len(items):
            raise saved.unfit(f"{len(items)} values", tree)
        return tuple(decode(item, one, saved) for item, one in zip(items, tree, strict=True))
    return _decode_plain(origin, values, tree, saved)


def _decode_plain(kind: Any, values: Values, tree: Any, saved: Saved) -> Any:
    if hasattr(kind, "restore"):
        kind = _concrete(kind, tree)
        made = kind.__new__(kind)
        made.restore(Saved(_tree(tree, saved), saved.place))
        return made
    if _is_dataclass(kind):
        part = Saved(_tree(tree, saved), saved.place)
        fields = {name: decode(hint, part.value(name), part.at(name)) for name, hint in hints_of(kind).items()}
        return checked(saved, lambda: kind(**fields))
    if issubclass(kind, Enum):
        if not isinstance(tree, str) or tree not in kind.__members__:
            raise saved.unfit(f"one of {', '.join(kind.__members__)}", tree)
        return kind[tree]
    if type(tree) is not kind and not (kind is float and type(tree) is int):  # a bool is an int otherwise
        raise saved.unfit(kind.__name__, tree)
    if kind in (int, float):
        checked(saved, lambda: values.require(np.asarray(tree)))
    return kind(tree)


def _concrete(kind: Any, tree: Any) -> Any:
    """The class itself, or of an abstract one the subclass whose attributes a tree has."""
    if not inspect.isabstract(kind):
        return kind
    names = set(tree) if isinstance(tree, dict) else set()
    return next((one for one in kind.__subclasses__() if set(hints_of(one)) == names), kind.__subclasses__()[0])


def _decode_array(dtype: Any, values: Values, tree: Any, saved: Saved, of_list: bool = False) -> Any:
    """An array, or of a list of arrays the one that they are rows of."""
    (wanted,) = typing.get_args(dtype)
    is_array = isinstance(tree, np.ndarray) and tree.dtype.isnative
    if not is_array or not np.issubdtype(tree.dtype, typing.get_origin(wanted) or wanted):
        raise saved.unfit(f"an array of {getattr(wanted, '__name__', wanted)}", tree)
    if values.shape is not None and not values.shape.fits(tree.shape[1:] if of_list else tree.shape):
        raise saved.unfit(f"an array of shape {values.shape.lengths}", tree)
    checked(saved, lambda: values.require(tree))
    return tree if tree.flags.writeable and tree.flags.c_contiguous else tree.copy()


_DICT = ("keys", "values")
_BOOLS = typing.Annotated[np.ndarray[Any, np.dtype[np.bool_]], Shape(None)]
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
        columns = {name: (hint, [getattr(one, name) for one in values]) for name, hint in hints_of(bare).items()}
        return {"count": len(values)} | {name: _encode_list(*column) for name, column in columns.items()}
    return [encode(kind, value) for value in values]


def _decode_list(kind: Any, tree: Any, saved: Saved) -> Any:
    bare, values = _bare(kind)
    if (inner := _optional(bare)) is not None:
        part = Saved(_tree(tree, saved), saved.place)
        known = decode(_BOOLS, part.value("known"), part.at("known"))
        present = iter(_decode_list(inner, part.value("values"), part.at("values")))
        return checked(saved, lambda: [next(present) if one else None for one in known])
    if bare in _COLUMNS:
        if not isinstance(tree, np.ndarray) or tree.ndim != 1 or tree.dtype != _COLUMNS[bare]:
            raise saved.unfit(f"an array of {bare.__name__}", tree)
        checked(saved, lambda: values.require(tree))
        return tree.tolist()
    if isinstance(tree, np.ndarray) and typing.get_origin(bare) is np.ndarray and tree.ndim:
        return list(_decode_array(typing.get_args(bare)[1], values, tree, saved, of_list=True))
    if _is_columnar(bare):
        part = Saved(_tree(tree, saved), saved.place)
        columns = [_decode_list(hint, part.value(name), part.at(name)) for name, hint in hints_of(bare).items()]
        if type(part.value("count")) is not int or any(len(column) != part.value("count") for column in columns):
            raise saved.refuse(f"columns of {bare.__name__} differ in length")
        return checked(saved, lambda: [bare(*row) for row in zip(*columns, strict=True)])
    if not isinstance(tree, list):
        raise saved.unfit("a list", tree)
    return [decode(kind, one, saved) for one in tree]


def _is_dataclass(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind)


def _is_columnar(kind: Any) -> bool:
    return isinstance(kind, type) and _is_dataclass(kind) and not hasattr(kind, "restore")


def hints_of(kind: Any) -> dict[str, Any]:
    """Names and types of the saved attributes of a class, in the order of their declaration."""
    hints = typing.get_type_hints(kind, include_extras=True)
    if _is_dataclass(kind):
        return {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    return {name: hint for name, hint in hints.items() if typing.get_origin(hint) is not typing.ClassVar}


def _bare(kind: Any) -> tuple[Any, Values]:
    """A type without its annotations, and what these say of its values."""
    notes = getattr(kind, "__metadata__", ())
    return (typing.get_args(kind)[0] if notes else kind), values_of(notes)


def _optional(kind: Any) -> Any:
    """T of `T | None`; None for another type."""
    is_union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return next(one for one in typing.get_args(kind) if one is not types.NoneType) if is_union else None


def _tree(tree: Any, saved: Saved) -> dict[str, Any]:
    if not isinstance(tree, dict):
        raise saved.unfit("a tree", tree)
    return tree


def checked(saved: Saved, make: Any) -> Any:
    """The result of a function that may find the values contradictory."""
    try:
        return make()
    except (ValueError, TypeError, IndexError, RuntimeError, OverflowError, StopIteration) as error:
        raise saved.refuse(str(error) or type(error).__name__) from error
