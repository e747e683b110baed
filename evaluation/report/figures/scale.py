"""From numbers to pixels: scales, round ticks and their texts."""

import math
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray

_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)


@dataclass(frozen=True)
class Scale:
    """Takes values from `low` to `high` to pixels from `start` to `end`."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, values: FloatArray) -> FloatArray:
        """Pixels of values, of any shape; values outside fall outside."""
        return self.start + (values - self.low) * self.per_unit

    def at(self, value: float) -> float:
        """The pixel of one value."""
        return self.start + (value - self.low) * self.per_unit

    @property
    def per_unit(self) -> float:
        """Pixels of one unit; negative where the axis runs backwards, as y does on a screen."""
        return (self.end - self.start) / (self.high - self.low)


def round_up(value: float) -> float:
    """The next larger number of the form 1, 2, 2.5 or 5 times a power of ten."""
    if not value > 0.0 or not math.isfinite(value):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(r * power for r in _ROUND if value <= r * power * (1.0 + 1e-9))


def ticks(low: float, high: float, count: int = 5) -> FloatArray:
    """Round values inside the range, as near to `count` of them as round steps allow."""
    power = 10.0 ** math.floor(math.log10((high - low) / max(count, 1)))
    steps = [r * p * power for p in (1.0, 10.0) for r in _ROUND[:-1]]
    first, last, step = min(
        (_inside(low, high, step) for step in steps), key=lambda found: (abs(found[1] - found[0] + 1 - count), found[2])
    )
    return np.asarray(step * np.arange(first, last + 1), dtype=np.float64)


def _inside(low: float, high: float, step: float) -> tuple[int, int, float]:
    """First and last multiple of the step in the range, and the step."""
    return math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6), step


def tick_texts(values: FloatArray) -> list[str]:
    """The ticks' texts, all with the decimals that their distance asks for."""
    if len(values) < 2:
        return [f"{value:g}".replace("-", "\N{MINUS SIGN}") for value in values]
    step = float(values[1] - values[0])
    decimals = next((d for d in range(9) if abs(round(step, d) - step) < 1e-6 * step), 9)
    texts = [f"{value if abs(value) > 1e-6 * step else 0.0:.{decimals}f}" for value in values]
    return [text.replace("-", "\N{MINUS SIGN}") for text in texts]


def widened(low: float, high: float, share: float = 0.04, least: float = 1e-9) -> tuple[float, float]:
    """The range with a margin on both sides, never empty."""
    margin = max(share * (high - low), least)
    return low - margin, high + margin
