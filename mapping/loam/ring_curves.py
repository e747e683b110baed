"""How the rings of a scan bend, and where that can be trusted."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from mapping.loam.ring_layout import HALF_WINDOW, Floats, Indices, RingLayout

Mask = NDArray[np.bool_]

# A step in depth, squared metres, and the angle up to which it is one between neighbours, squared radians.
_JUMP_M2 = 0.1
_JUMP_ANGLE2 = 0.1**2
# And it is longer than the shorter of the steps before and after it, squared: on a wall along the beam all are long.
_JUMP_RATIO2 = 2.0**2
# What a step in depth hides from the next viewpoint: so many points on its far side.
_HIDDEN = 6
# A surface nearly along the beam: both steps longer than this share of the range, LOAM's, and than so many times the
# step on a surface that faces the sensor. That is the same for columns of 0.2 degrees, the sensor of LOAM's authors.
_GRAZING = 0.0002**0.5
_GRAZING_STEPS = 4.0
# Noise of the range turns up in the sum of ten neighbours - 10 p with 10 + 100 times its variance, in a second
# difference with 1 + 4 + 1 times, of which nine lie within a window.
_NOISE_GAIN = 110.0 / 6.0 / 9.0


@dataclass(frozen=True, eq=False)
class RingCurves:
    """What the places of a layout, M of them, are like.

    Attributes:
        layout: the places.
        gaps2: (M,) squared distance to the next place.
        curvature: (M,) LOAM's, squared metres.
        noise: (M,) what of it noise of the range would make, squared metres, estimated from each window.
        reliable: (M,) whether the place may be a feature: no repetition, no hole in its window, not hidden, not
            grazing.
        jumps: (M,) whether the window holds a step in depth.
        brinks: (M,) whether the step in depth begins or ends right here.
    """

    layout: RingLayout
    gaps2: Floats
    curvature: Floats
    noise: Floats
    reliable: Mask
    jumps: Mask
    brinks: Mask

    def lengths(self) -> FloatArray:
        """(M,) length of each place's ring up to it."""
        total = np.cumsum(np.sqrt(self.gaps2), dtype=np.float64)
        at_start = total[self.layout.starts - HALF_WINDOW]
        return np.asarray(total - np.repeat(at_start, self.layout.sizes + 2 * HALF_WINDOW))


def measure_curves(layout: RingLayout, max_gap_columns: float) -> RingCurves:
    """Measure curvatures; a window with a gap of more columns than that is not trusted."""
    ranges, gaps2 = layout.ranges, _gaps2(layout.xyz)
    gaps2[layout.starts + layout.sizes + HALF_WINDOW - 1] = 0.0  # from one ring to the next is no step
    # Law of cosines: 2 (1 - cos) of the angle between two neighbours, seen from the sensor.
    angles2 = np.zeros_like(gaps2)
    np.divide(gaps2[:-1] - np.diff(ranges) ** 2, ranges[:-1] * ranges[1:], out=angles2[:-1])
    widest = np.float32(max_gap_columns) * layout.spacing
    widest[:-1] = np.maximum(widest[:-1], widest[1:])
    jump = (gaps2 > _JUMP_M2) & (angles2 < _JUMP_ANGLE2)
    jump[1:-1] &= gaps2[1:-1] > np.float32(_JUMP_RATIO2) * np.minimum(gaps2[:-2], gaps2[2:])
    reliable = ~_within_window(angles2 > widest * widest)
    reliable &= ~_hidden(jump, ranges)
    longest = np.maximum(np.float32(_GRAZING_STEPS) * layout.spacing, np.float32(_GRAZING)) * ranges
    long_step = gaps2 > longest * longest
    reliable[1:] &= ~(long_step[1:] & long_step[:-1])
    for start, size in zip(layout.starts.tolist(), layout.sizes.tolist(), strict=True):
        reliable[start - HALF_WINDOW : start] = False
        reliable[start + size : start + size + HALF_WINDOW] = False
    brinks = jump.copy()
    brinks[1:] |= jump[:-1]
    noise = _noise(ranges)
    return RingCurves(layout, gaps2, _curvature(layout.xyz), noise, reliable, _within_window(jump), brinks)


def bend_across(curves: RingCurves, places: Indices) -> Floats:
    """Curvature (K,) at these places without its part along the curve, which uneven spacing makes on flat ground.

    Where the window holds a step in depth the curvature stays whole.
    """
    offsets = np.arange(1, HALF_WINDOW + 1)
    xyz = curves.layout.xyz
    here = HALF_WINDOW * xyz.take(places, axis=1)
    before = xyz.take(places[:, None] - offsets, axis=1).sum(axis=2) - here
    after = xyz.take(places[:, None] + offsets, axis=1).sum(axis=2) - here
    along = after - before
    bend = before + after
    length2 = np.maximum(np.einsum("ij,ij->j", along, along), np.float32(1e-12))
    across = np.einsum("ij,ij->j", bend, bend) - np.einsum("ij,ij->j", bend, along) ** 2 / length2
    return np.where(curves.jumps[places], curves.curvature[places], across)


def _gaps2(xyz: Floats) -> Floats:
    steps = np.diff(xyz, axis=1)
    gaps2 = np.zeros(xyz.shape[1], dtype=np.float32)
    np.einsum("ij,ij->j", steps, steps, out=gaps2[:-1])
    return gaps2


def _curvature(xyz: Floats) -> Floats:
    """(M,) |sum of the ten neighbours - 10 p|^2; 0 at either end."""
    pairs = xyz[:, :-1] + xyz[:, 1:]
    five = pairs[:, :-3] + pairs[:, 2:-1]
    five += xyz[:, 4:]
    bend = five[:, :-6] + five[:, 6:]
    bend -= np.float32(10.0) * xyz[:, HALF_WINDOW:-HALF_WINDOW]
    curvature = np.zeros(xyz.shape[1], dtype=np.float32)
    np.einsum("ij,ij->j", bend, bend, out=curvature[HALF_WINDOW:-HALF_WINDOW])
    return curvature


def _noise(ranges: Floats) -> Floats:
    """(M,) expectation of the curvature if the second differences of the range in its window are noise alone."""
    second = np.diff(np.diff(ranges))
    second *= second
    two = second[:-1] + second[1:]
    four = two[:-2] + two[2:]
    nine = four[:-5] + four[4:-1] + second[8:]
    noise = np.zeros_like(ranges)
    noise[HALF_WINDOW : HALF_WINDOW + len(nine)] = np.float32(_NOISE_GAIN) * nine
    return noise


def _within_window(steps: Mask) -> Mask:
    """Whether any of the ten steps around each place is marked; step i leads from place i to i + 1."""
    two = steps[:-1] | steps[1:]
    four = two[:-2] | two[2:]
    ten = four[:-6] | four[4:-2] | two[8:]
    marked = np.zeros_like(steps)
    marked[HALF_WINDOW : HALF_WINDOW + len(ten)] = ten
    return marked


def _hidden(jump: Mask, ranges: Floats) -> Mask:
    """The six places on the far side of every step in depth."""
    hidden = np.zeros_like(jump)
    at = np.flatnonzero(jump[:-1])
    farther = ranges[at] > ranges[at + 1]
    for k in range(_HIDDEN):
        places = np.where(farther, at - k, at + 1 + k)
        hidden[np.clip(places, 0, len(hidden) - 1)] = True
    return hidden
