"""Attributes of points beside their coordinates: intensity, colour, ring, time."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import NDArray

AttributeName = Literal["intensity", "rgb", "ring", "time"]


@dataclass(frozen=True, eq=False)
class PointAttributes:
    """Attributes of N points; None where no point has one."""

    intensity: NDArray[np.float32] | None = None  # (N,) on the scale of the recording; NaN where there is none
    rgb: NDArray[np.uint8] | None = None  # (N, 3) red, green, blue; black where there is none
    ring: NDArray[np.int32] | None = None  # (N,) the laser; -1 where it is unknown
    time: NDArray[np.float64] | None = None  # (N,) seconds, on the clock of the scans' stamps

    def __post_init__(self) -> None:
        lengths = {name: len(values) for name, values in self.present()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"attributes of the same points differ in length: {lengths}")
        if self.rgb is not None and (self.rgb.ndim != 2 or self.rgb.shape[1] != 3):
            raise ValueError(f"rgb must be (N, 3), got {self.rgb.shape}")

    def present(self) -> Iterator[tuple[str, NDArray[np.generic]]]:
        """Names and values of those that there are."""
        named = ((field.name, getattr(self, field.name)) for field in fields(self))
        return ((name, values) for name, values in named if values is not None)

    def only(self, names: Collection[AttributeName]) -> "PointAttributes":
        """Those with some names."""
        return PointAttributes(**{name: values for name, values in self.present() if name in names})  # type: ignore[arg-type]

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "PointAttributes":
        """Those of some of the points, by a mask or by indices."""
        return PointAttributes(**{name: values[chosen] for name, values in self.present()})  # type: ignore[arg-type]
