"""What an object must remember to go on exactly where it was: a tree of arrays, numbers and texts, and no code.

Whatever carries something from scan to scan has `state()`, which gives such a tree, and beside it `restore(saved)` or a
class method that takes it back. Arrays in a tree are those of the object itself, not copies: it is written, or copied,
before the object goes on.
"""

from collections.abc import Callable, Mapping, Sequence
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

    def _unfit(self, name: str, wanted: str, found: str) -> InputError:
        return self.refuse(f"{name} should be {wanted}, and is {found}")


def stack(values: Sequence[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Arrays of one shape as a single one (N, *shape), which may hold none."""
    return np.array(values, dtype=np.float64).reshape(len(values), *shape)


def _fits(shape: Sequence[int], wanted: Sequence[int | None]) -> bool:
    return len(shape) == len(wanted) and all(w is None or n == w for n, w in zip(shape, wanted, strict=True))
