"""Rows of sums over the points of a voxel: what of them every map has, and the attributes that its scans have.

Intensity and colour are summed over the points that have one. Ring and time are those of the earliest point.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.scan import PointAttributes

POSITION, VIEW, COUNT = slice(0, 3), slice(3, 6), 6
_GEOMETRY = 7
_INTENSITY, _RGB, _FIRST = 2, 4, 3
# Of a point without a time: later than all others, its low part, and its ring.
_NO_FIRST = (np.inf, 0.0, -1.0)

Rows = NDArray[np.float32]


@dataclass(frozen=True)
class Layout:
    """The columns of rows (N, width) beside position (3), direction to the sensor (3) and number of points."""

    intensity: bool = False  # its sum, and how many points have one
    rgb: bool = False  # the sums of red, green and blue, and how many points have them
    # the time of the earliest point as the sum of two float32, exact to some microseconds since 1970, and its ring
    first: bool = False

    @classmethod
    def of(cls, attributes: PointAttributes) -> "Layout":
        """Columns for these attributes."""
        return cls(attributes.intensity is not None, attributes.rgb is not None, attributes.time is not None)

    @classmethod
    def union(cls, layouts: "Sequence[Layout]") -> "Layout":
        """The columns that any of them has."""
        return cls(*(any(getattr(one, name) for one in layouts) for name in ("intensity", "rgb", "first")))

    @property
    def summed(self) -> int:
        """How many columns are sums, the first ones."""
        return _GEOMETRY + _INTENSITY * self.intensity + _RGB * self.rgb

    @property
    def width(self) -> int:
        """How many columns there are."""
        return self.summed + _FIRST * self.first

    def parts(self, rows: Rows) -> tuple[Rows, Rows, Rows]:
        """Views of the columns of intensity (N, 2), colour (N, 4) and earliest point (N, 3), as far as they exist."""
        at = _GEOMETRY + _INTENSITY * self.intensity
        return rows[:, _GEOMETRY:at], rows[:, at : self.summed], rows[:, self.summed :]

    def write(self, attributes: PointAttributes, rows: Rows) -> None:
        """Write the attributes of N points into their rows (N, width)."""
        intensity, rgb, first = self.parts(rows)
        if attributes.intensity is not None:
            known = np.isfinite(attributes.intensity)
            intensity[:, 0], intensity[:, 1] = np.where(known, attributes.intensity, 0.0), known
        if attributes.rgb is not None:
            rgb[:, :3], rgb[:, 3] = attributes.rgb, 1.0
        if attributes.time is not None:
            first[:, 0] = attributes.time
            first[:, 1] = attributes.time - first[:, 0].astype(np.float64)
            first[:, 2] = -1.0 if attributes.ring is None else attributes.ring

    def widened(self, rows: Rows, layout: "Layout") -> Rows:
        """Rows with the columns of another layout, which has all of these."""
        if layout == self:
            return rows
        wide = np.zeros((len(rows), layout.width), dtype=np.float32)
        wide[:, :_GEOMETRY] = rows[:, :_GEOMETRY]
        if layout.first:
            wide[:, layout.summed :] = _NO_FIRST
        for old, new in zip(self.parts(rows), layout.parts(wide), strict=True):
            if old.shape[1]:
                new[:] = old
        return wide

    def largest_intensity(self, rows: Rows) -> float:
        """The largest mean intensity; 0 where none is known."""
        intensity = self.parts(rows)[0]
        return float(np.nanmax(_means(intensity, unknown=np.nan), initial=0.0)) if self.intensity else 0.0

    def attributes(self, rows: Rows) -> PointAttributes:
        """Means of intensity and colour, ring and time of the earliest point; rings as far as one is known."""
        intensity, rgb, first = self.parts(rows)
        ring = first[:, 2].astype(np.int32) if self.first else None
        return PointAttributes(
            intensity=_means(intensity, unknown=np.nan)[:, 0] if self.intensity else None,
            rgb=np.round(_means(rgb, unknown=0.0)).astype(np.uint8) if self.rgb else None,
            ring=None if ring is None or (ring < 0).all() else ring,
            time=first[:, 0].astype(np.float64) + first[:, 1] if self.first else None,
        )


def _means(sums: Rows, unknown: float) -> NDArray[np.float32]:
    """Sums divided by their last column, how many they are of."""
    counts = sums[:, -1:]
    return np.where(counts > 0.0, sums[:, :-1] / np.maximum(counts, 1.0), np.float32(unknown))
