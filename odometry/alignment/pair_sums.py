"""What all pairs of points and planes say together of a motion: the sums that alignment solves and judges by.

Which point of one sweep belongs to which plane of another: that of the pixel it falls into. The target's pixels are as
measured, each at its own time: points are taken to that time, placed, and compared there.
"""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from odometry.alignment import pair_kernels as kernels
from odometry.alignment.alignment_config import AlignmentConfig
from odometry.images.sweeps import SweepImages, SweepPair

# Twice as many rows say hardly more if half as many points are taken of each.
_FULL_ROWS = 32


@dataclass(frozen=True, eq=False)
class Movement:
    """What alignment estimates of a pair of sweeps.

    Attributes:
        T_prev_curr: (4, 4) from the middle of the current sweep to the middle of the previous one.
        velocity: (6,) mean, between the two middles.
        bend: (6,) by how much the velocity in the middle of the current sweep is above the mean, and in that of the
            previous one below.
    """

    T_prev_curr: FloatArray
    velocity: FloatArray
    bend: FloatArray


@dataclass(frozen=True, eq=False)
class Tally:
    """Counts and sums over the points of a sweep at a motion; points lie well within twice the finest scale.

    Attributes:
        H: (12, 12) of the normal equations, each point that lies well with a weight of 1.
        in_view, matched: (3, 3) of the squares of normals in the previous frame: of all points in view, and of those
            that lie well.
        share_in_view, share: parts of the points with a normal that are in view, and that lie well.
        count: how many lie well.
        squares: sum of their squared distances from the planes.
    """

    H: FloatArray
    in_view: FloatArray
    matched: FloatArray
    share_in_view: float
    share: float
    count: int
    squares: float


class PairSums:
    """Sums over the points of a sweep, each held against the plane of the pixel of the other that it falls into."""

    def __init__(self, sweeps: SweepPair, config: AlignmentConfig) -> None:
        self._points = _points(sweeps.current, config.column_step)
        self._planes = _planes(sweeps.previous, config.fill_columns)
        self._gates = kernels.Gates(config.gate_m, config.gate_share, config.least_cosine)
        self._fine_m = config.fine_m

    def normal_equations(self, movement: Movement, scale_m: float) -> tuple[FloatArray, FloatArray]:
        """H (12, 12) and g (12,) of squared distances with Geman and McClure's weights of this scale,
        for changes of T_prev_curr from the left and of the bend.
        """
        H, g = np.empty((12, 12)), np.empty(12)
        kernels.normal_equations(self._points, self._planes, _motion(movement), scale_m, self._gates, H, g)
        return H, g

    def tally(self, movement: Movement) -> Tally:
        """How the sweeps lie on one another in the end."""
        H, in_view, matched = np.empty((12, 12)), np.empty((3, 3)), np.empty((3, 3))
        seen, count, squares = kernels.judge(
            self._points, self._planes, _motion(movement), self._fine_m, self._gates, H, in_view, matched
        )
        all_points = max(len(self._points.points), 1)
        return Tally(H, in_view, matched, seen / all_points, count / all_points, int(count), float(squares))


def _points(images: SweepImages, column_step: int) -> kernels.Sweep:
    """Every so-manieth pixel of each row that has a normal; the more rows, the fewer of each."""
    height, width = images.offsets.shape
    fewer = max(1, height // _FULL_ROWS)
    room = np.empty((height * (width // (fewer * column_step) + 1), 7), dtype=np.float32)
    count = kernels.sample(images.points, images.normals, images.offsets, column_step, fewer, room)
    return kernels.Sweep(room[:count])


def _planes(images: SweepImages, fill_columns: int) -> kernels.Planes:
    """Pixels without a normal stand for the nearest one in their row that has one, up to so many columns away.

    A point is held against a plane, which goes on beyond its pixel; the gate sees to it that it does not go too far.
    """
    height, width = images.offsets.shape
    pixels = np.empty((height * width, 7), dtype=np.float32)
    kernels.fill(images.points, images.normals, images.offsets, min(fill_columns, width - 1), pixels)
    return kernels.Planes(pixels, height, width, images.low, images.high, bool(images.offsets.any()))


def _motion(movement: Movement) -> kernels.Motion:
    T = np.ascontiguousarray(movement.T_prev_curr)
    return kernels.Motion(T, movement.velocity - movement.bend, movement.velocity + movement.bend)
