"""Where the raw values of a per-point time field lie, told robustly."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_QUANTILES = (0.005, 0.5, 0.995)


@dataclass(frozen=True)
class ValueSpread:
    """The values of one scan, in their own unit.

    Attributes:
        first, middle, last: near the smallest, the median and near the largest, a few stray values left out.
        span: last minus first, without the rounding of large values.
        resolution: the step between neighbouring values at this size.
    """

    first: float
    middle: float
    last: float
    span: float
    resolution: float


def value_spread(values: NDArray[np.generic]) -> ValueSpread | None:
    """The spread of integer or float values (N,), NaN left out; None when all, or all but a few, are alike."""
    whole = values.dtype.kind in "iu"
    with np.errstate(invalid="ignore"):  # damaged bytes may be a NaN of the signalling kind
        numbers = values.reshape(-1).astype(np.int64 if whole else np.float64)
    numbers = numbers[np.isfinite(numbers)]
    set_times = numbers[numbers != 0]
    # Among clock readings a zero is a missing return; among relative times it is a time.
    if len(set_times) and np.abs(set_times).min() > 10 * float(np.ptp(set_times)):
        numbers = set_times
    if len(numbers) < 2:
        return None
    base = numbers.min()
    first, middle, last = np.quantile((numbers - base).astype(np.float64), _QUANTILES)
    if last <= first:
        return None
    largest = np.abs(numbers).max()
    resolution = 1.0 if whole else float(np.spacing(values.dtype.type(largest)))
    return ValueSpread(float(base + first), float(base + middle), float(base + last), float(last - first), resolution)
