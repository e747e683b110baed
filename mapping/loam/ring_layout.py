"""The points of a scan laid out ring after ring, each ring closed on itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

Indices = NDArray[np.intp]
Floats = NDArray[np.float32]

# Neighbours to either side that a curvature is summed over; as many of a ring's points are repeated at its ends.
HALF_WINDOW = 5
# The angle between columns is taken from every so many points.
_SAMPLE_EVERY = 32
_SMALLEST_STEP = 1e-5
# More steps than this share leap this far when a ring's points are not stored in the order of azimuth.
_MOST_LEAPS = 0.2
_LEAP = 0.1
_LARGEST_STRIDE = 8


@dataclass(frozen=True, eq=False)
class RingLayout:
    """All rings in one row of M places, each with its own ends repeated so that windows close on themselves.

    Attributes:
        source: (M,) index of the scan's point at each place.
        xyz: (3, M) metres.
        ranges: (M,) metres.
        starts: (R,) place of each ring's first point, behind the repeated ones.
        sizes: (R,) points of each ring.
        spacing: (M,) angle between neighbours where there is no hole, radians.
    """

    source: Indices
    xyz: Floats
    ranges: Floats
    starts: Indices
    sizes: Indices
    spacing: Floats

    def sectors(self, places: Indices, per_ring: int) -> Indices:
        """A number (K,) for the sector that each place lies in; sectors of different rings differ."""
        ring = np.searchsorted(self.starts, places, side="right") - 1
        return ring * per_ring + (places - self.starts[ring]) * per_ring // self.sizes[ring]


def lay_out(points: FloatArray, rings: NDArray[np.integer], min_spacing_m: float) -> RingLayout | None:
    """Lay out the rings of points (N, 3), leaving points out where they are closer together than asked.

    None when no ring has enough points for a window. Points with a negative ring are left out.
    """
    order, bounds = _by_ring(rings)
    xyz = points.T.astype(np.float32)
    angles = _sampled_angles(xyz, order, bounds)
    if np.count_nonzero(angles > _LEAP) > _MOST_LEAPS * len(angles):
        order = _by_azimuth(points, order, bounds)
        angles = _sampled_angles(xyz, order, bounds)
    column = max(float(np.median(angles)), _SMALLEST_STEP) if len(angles) else 1.0
    ranges = np.sqrt(np.einsum("ij,ij->j", xyz, xyz))
    if min_spacing_m > 0.0:
        order, bounds = _thin(order, bounds, _strides(ranges, column, min_spacing_m))
    source, starts, sizes = _closed(order, bounds)
    if not len(sizes):
        return None
    ranges = ranges.take(source)
    spacing = np.float32(column) * _strides(ranges, column, min_spacing_m)
    return RingLayout(source, xyz.take(source, axis=1), ranges, starts, sizes, spacing)


def _by_ring(rings: NDArray[np.integer]) -> tuple[Indices, Indices]:
    """Point indices ring by ring, in their stored order, and where each ring starts, with the end."""
    narrow = rings.astype(np.int16)
    if (narrow[1:] >= narrow[:-1]).all():
        order, ordered = np.arange(len(narrow)), narrow
    else:
        order = np.argsort(narrow, kind="stable")  # a radix sort for 16 bits
        ordered = narrow[order]
    strays = int(np.searchsorted(ordered, 0))
    order, ordered = order[strays:], ordered[strays:]
    return order, np.concatenate([[0], np.flatnonzero(ordered[1:] != ordered[:-1]) + 1, [len(ordered)]])


def _by_azimuth(points: FloatArray, order: Indices, bounds: Indices) -> Indices:
    """The same rings, each in the order of azimuth."""
    azimuths = np.arctan2(points[order, 1], points[order, 0])
    ring = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
    return order[np.lexsort((azimuths, ring))]


def _sampled_angles(xyz: Floats, order: Indices, bounds: Indices) -> FloatArray:
    """Angles between neighbours along the rings; the sample does not depend on how the rings are numbered."""
    if len(order) < 2:
        return np.empty(0)
    every = _SAMPLE_EVERY if len(order) > 100 * _SAMPLE_EVERY else 1
    sampled = order[:-1] % every == 0
    sampled[bounds[1:-1] - 1] = False
    at = np.flatnonzero(sampled)
    a, b = (xyz.take(order[places], axis=1).astype(np.float64) for places in (at, at + 1))
    chords = a / np.linalg.norm(a, axis=0) - b / np.linalg.norm(b, axis=0)
    return np.asarray(np.linalg.norm(chords, axis=0))


def _strides(ranges: Floats, column: float, min_spacing_m: float) -> NDArray[np.uint8]:
    """Every how many columns (M,), 1, 2, 4 or 8, a point serves so that neighbours are as far apart as asked."""
    strides = np.ones(len(ranges), dtype=np.uint8)
    stride = 2
    while stride <= _LARGEST_STRIDE and min_spacing_m > 0.0:
        strides[ranges * np.float32(stride * column) <= min_spacing_m] = stride
        stride *= 2
    return strides


def _thin(order: Indices, bounds: Indices, strides: NDArray[np.uint8]) -> tuple[Indices, Indices]:
    """Only every so many points of each ring; the strides belong to the scan's points."""
    number = np.arange(len(order)) - np.repeat(bounds[:-1], np.diff(bounds))
    kept = (number.astype(np.uint8) & (strides.take(order) - np.uint8(1))) == 0
    before = np.concatenate([[0], np.cumsum(kept)])
    return order[kept], before[bounds]


def _closed(order: Indices, bounds: Indices) -> tuple[Indices, Indices, Indices]:
    """Source, starts and sizes of the rings that are longer than a window, ends repeated."""
    pieces, starts, sizes = [], [], []
    place = 0
    for begin, end in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        if end - begin <= 2 * HALF_WINDOW:
            continue
        pieces += [order[end - HALF_WINDOW : end], order[begin:end], order[begin : begin + HALF_WINDOW]]
        starts.append(place + HALF_WINDOW)
        sizes.append(end - begin)
        place += end - begin + 2 * HALF_WINDOW
    source = np.concatenate(pieces) if pieces else np.empty(0, dtype=np.intp)
    return source, np.array(starts, dtype=np.intp), np.array(sizes, dtype=np.intp)
