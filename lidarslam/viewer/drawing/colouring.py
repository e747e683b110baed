"""Colours of one run's picture by a quantity of the points of its map, or of the poses of its path."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.report.error_colours import viridis

Quantity = Literal["height", "intensity", "error", "rgb"]

UNKNOWN = (205, 205, 205)
"""Where there is no value."""
_CLIPPED_PERCENT = 2.0
_LEVELS = np.linspace(0.0, 1.0, 256)


def _ramp(stops: list[list[int]]) -> NDArray[np.uint8]:
    """Colours (256, 3) between even stops."""
    places = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(_LEVELS, places, stop) for stop in np.transpose(stops)], axis=1).astype(np.uint8)


# On white paper: light ground, dark tops; dark for little light returned; pale for small errors.
_RAMPS: dict[Quantity, NDArray[np.uint8]] = {
    "height": _ramp([[201, 209, 214], [140, 181, 199], [66, 138, 166], [41, 84, 135], [60, 28, 92]]),
    "intensity": _ramp([[45, 30, 70], [120, 50, 110], [200, 85, 80], [240, 155, 60], [250, 220, 130]]),
    "error": viridis(_LEVELS)[::-1],
}
_UNITS: dict[Quantity, tuple[str, str]] = {
    "height": ("z", " m"),
    "intensity": ("intensity", ""),
    "error": ("error", " m"),
}


@dataclass(frozen=True, eq=False)
class ColourScale:
    """Values as colours: the lowest and highest 2 % are clipped; errors begin at 0."""

    quantity: Quantity  # any but rgb
    low: float
    high: float

    @property
    def ramp(self) -> NDArray[np.uint8]:
        """Colours (256, 3) from the low end to the high one."""
        return _RAMPS[self.quantity]

    @property
    def ends(self) -> tuple[str, str]:
        """What stands on both sides of the scale."""
        (label, unit), digits = _UNITS[self.quantity], 1 if self.high >= 1.0 or self.quantity == "height" else 3
        return f"{label} {self.low:.{digits}f}", f"{self.high:.{digits}f}{unit}"

    def colours(self, values: FloatArray) -> NDArray[np.uint8]:
        """Colours (N, 3) of values (N,); grey where there is none."""
        level = (values - self.low) * (255.0 / max(self.high - self.low, 1e-6))
        colours = self.ramp[np.nan_to_num(np.clip(level, 0.0, 255.0)).astype(np.uint8)]
        colours[np.isnan(values)] = UNKNOWN
        return colours


def fit_scale(quantity: Quantity, values: FloatArray) -> ColourScale | None:
    """The scale that suits values (N,), NaN where there is none; None where there is none at all."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    low, high = np.percentile(known, [_CLIPPED_PERCENT, 100.0 - _CLIPPED_PERCENT])
    return ColourScale(quantity, 0.0 if quantity == "error" else float(low), float(high))
