"""What an `Annotated` hint says of the values of a state: the shape of an array, and the bounds of its numbers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Rounding of transforms that were chained over hours stays far below.
_RIGID = 1e-3
# Squares of floats are finite, and sums of counts fit into 64 bits.
_LARGEST_FLOAT, _LARGEST_COUNT = 1e100, float(1 << 53)


class Shape:
    """Expected shape of an array; None stands for any length."""

    def __init__(self, *lengths: int | None) -> None:
        self.lengths = lengths

    def fits(self, shape: tuple[int, ...]) -> bool:
        """Whether an array of that shape is one of these."""
        same = (wanted in (None, found) for wanted, found in zip(self.lengths, shape, strict=False))
        return len(shape) == len(self.lengths) and all(same)


class Transforms(Shape):
    """Expected shape (..., 4, 4) of an array of rigid transforms."""

    def __init__(self, *lengths: int | None) -> None:
        super().__init__(*lengths, 4, 4)


TRANSFORM = Transforms()


@dataclass(frozen=True)
class Within:
    """Bounds of numbers, both included. Without them integers are counts, from 0 to 2^53, and floats up to 1e100."""

    low: float = -math.inf
    high: float = math.inf


_FLOATS, _COUNTS = Within(-_LARGEST_FLOAT, _LARGEST_FLOAT), Within(0.0, _LARGEST_COUNT)
ANY_NUMBER = Within(math.nan, math.nan)


@dataclass(frozen=True)
class Values:
    """The annotations of one hint."""

    shape: Shape | None = None
    within: Within | None = None

    def require(self, values: NDArray[Any]) -> None:
        """Refuse numbers out of bounds, and transforms that are not rigid; a ValueError has the first of them."""
        if values.dtype.kind == "O":
            raise ValueError("an integer has more than 64 bits")
        if values.dtype.kind not in "iuf" or self.within is ANY_NUMBER or not values.size:
            return
        bounds = self.within or (_FLOATS if values.dtype.kind == "f" else _COUNTS)
        least, most = values.min().item(), values.max().item()  # NaN where any of the numbers is
        if not (np.isfinite(least) and np.isfinite(most) and bounds.low <= least and most <= bounds.high):
            raise ValueError(f"numbers from {least} to {most}, expected from {bounds.low} to {bounds.high}, finite")
        if isinstance(self.shape, Transforms):
            R, last = values[..., :3, :3], values[..., 3, :]
            error = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max()
            if max(error, np.abs(last - [0.0, 0.0, 0.0, 1.0]).max()) > _RIGID or np.linalg.det(R).min() < 0.0:
                raise ValueError("a transform is not rigid")


def values_of(notes: Sequence[Any]) -> Values:
    """Of the annotations of a hint."""
    shape = next((note for note in notes if isinstance(note, Shape)), None)
    return Values(shape, next((note for note in notes if isinstance(note, Within)), None))
