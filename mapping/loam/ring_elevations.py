"""Rings of a spinning sensor from the elevations of its lasers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved

# Histogram of elevations: fine beside the third of a degree between the lasers of dense sensors.
_BIN_DEG = 0.02
BINS = round(180.0 / _BIN_DEG)
# A bin belongs to a laser when it holds this share of what the fullest within a degree holds; the rest is strays.
_LEAST_SHARE = 0.02
_AROUND = round(1.0 / _BIN_DEG)
# How wide one laser's elevations may be spread, and how many points may be strays.
_WIDEST_DEG = 0.2
_MOST_STRAYS = 0.02
# The lasers of a sensor leave this much of the elevations between them free, or they are not told apart.
_MOST_COVERED = 0.5
_MOST_RINGS = 512
# The nearer part of a scan tells less: a laser beside the sensor's axis is seen under an elevation that depends on
# the range.
_NEAR_SHARE = 0.3
# Cells of the table that elevations are looked up in; by tangent, which costs no arc tangent a point.
_CELLS = 1 << 15


@dataclass(frozen=True, eq=False)
class ElevationTable:
    """Which laser an elevation belongs to.

    Attributes:
        labels: ring of each cell, 0 the lowest, -1 between the lasers.
        lowest: tangent at the first cell.
        cells_per_unit: of tangent.
    """

    labels: NDArray[np.int16]
    lowest: float
    cells_per_unit: float

    @classmethod
    def restored(cls, saved: Saved) -> "ElevationTable":
        """What was saved, which is all of it."""
        labels = saved.array("labels", (_CELLS,), np.int16)
        return cls(labels, saved.number("lowest"), saved.number("cells_per_unit"))

    def rings(self, points: FloatArray) -> NDArray[np.int16]:
        """The ring (N,) of each point (N, 3), -1 where none fits."""
        x, y, z = points.T.astype(np.float32)
        x *= x
        y *= y
        x += y
        np.sqrt(x, out=x)
        with np.errstate(divide="ignore", invalid="ignore"):
            np.divide(z, x, out=z)
        z -= np.float32(self.lowest)
        z *= np.float32(self.cells_per_unit)
        np.nan_to_num(z, copy=False, nan=0.0)
        # The first and the last cell lie outside of all lasers.
        cells = np.clip(z, 0.0, len(self.labels) - 1.0, out=z).astype(np.intp)
        return np.asarray(self.labels.take(cells), dtype=np.int16)


def elevation_histogram(points: FloatArray) -> NDArray[np.int64]:
    """How many of the points (N, 3), the nearest of each degree left out, lie in each bin of elevation."""
    elevations = np.rad2deg(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    bins = np.clip(((elevations + 90.0) / _BIN_DEG).astype(np.int64), 0, BINS - 1)
    # The nearest of each degree: low lasers meet the ground near by only.
    order = np.lexsort((np.linalg.norm(points, axis=1), bins // _AROUND))
    counts = np.bincount(bins // _AROUND, minlength=BINS // _AROUND)
    rank = np.arange(len(points)) - np.repeat(np.cumsum(counts) - counts, counts)
    far = order[rank >= _NEAR_SHARE * np.repeat(counts, counts)]
    return np.bincount(bins[far], minlength=BINS)


def elevation_table(histogram: NDArray[np.int64]) -> ElevationTable | None:
    """The lasers that a histogram of elevations shows; None when it shows none."""
    from scipy.ndimage import maximum_filter1d

    if not histogram.any():
        return None
    crest = maximum_filter1d(histogram, 2 * _AROUND + 1, mode="constant")
    full = histogram > _LEAST_SHARE * crest
    edges = np.flatnonzero(np.diff(full.astype(np.int8), prepend=0, append=0))
    first, last = edges[::2], edges[1::2]
    covered = full.sum() / max(1, last[-1] - first[0])
    strays = 1.0 - histogram[full].sum() / histogram.sum()
    too_wide = ((last - first) * _BIN_DEG > _WIDEST_DEG).any()
    if len(first) > _MOST_RINGS or too_wide or strays > _MOST_STRAYS or (len(first) > 1 and covered > _MOST_COVERED):
        return None
    held = histogram * np.arange(BINS)
    centres = np.add.reduceat(held, edges)[::2] / np.add.reduceat(histogram, edges)[::2]
    return _table((centres + 0.5) * _BIN_DEG - 90.0)


def _table(centres_deg: FloatArray) -> ElevationTable:
    """Cells around the lasers at these increasing elevations, each up to half way to the next one."""
    half = 0.5 * np.diff(centres_deg)
    reach = float(np.median(half)) if len(half) else _WIDEST_DEG
    low = centres_deg - np.minimum(np.concatenate([[reach], half]), 1.5 * reach)
    high = centres_deg + np.minimum(np.concatenate([half, [reach]]), 1.5 * reach)
    lowest, highest = np.tan(np.deg2rad(np.clip([low[0] - _BIN_DEG, high[-1] + _BIN_DEG], -89.0, 89.0)))
    cells = np.rad2deg(np.arctan(lowest + (np.arange(_CELLS) + 0.5) * (highest - lowest) / _CELLS))
    ring = np.clip(np.searchsorted(low, cells, side="right") - 1, 0, len(low) - 1)
    inside = (cells >= low[ring]) & (cells <= high[ring])
    labels = np.where(inside, ring, -1).astype(np.int16)
    return ElevationTable(labels, float(lowest), _CELLS / float(highest - lowest))
