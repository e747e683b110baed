"""Motion between the middles of two sweeps, and its interpolation to the stamps of the scans."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.core.state import TRANSFORM, Shape, Stateful
from lidarslam.odometry.images.sweep_images import SweepImages

Twist = Annotated[FloatArray, Shape(6)]


@dataclass(frozen=True, eq=False)
class SweepMotion:
    """Motion of constant acceleration between the middles of two sweeps."""

    velocity: Twist  # (6,) mean, rotation first, in radians and metres a second
    velocity_change: Twist  # (6,) velocity in the later middle above the mean, and in the earlier one below
    interval_s: float  # from one middle to the other, positive

    def pose_after(self, seconds: float) -> FloatArray:
        """(4, 4) in the frame of the earlier middle, `seconds` after it."""
        return exp(self.velocity * seconds + self.velocity_change * (seconds * (seconds / self.interval_s - 1.0)))


@dataclass(frozen=True, eq=False)
class SweepPair:
    """A sweep and the one before it."""

    # current, previous: the sweeps; their images may differ in size
    current: SweepImages
    previous: SweepImages
    interval_s: float  # from the middle of the previous one to that of the current one
    last: SweepMotion | None = None  # the motion that ended in the middle of the previous one; None where unknown


class StampInterpolator(Stateful):
    """Follows the motion through the middles of sweeps and interpolates it at the stamps of their scans.

    A stamp at the start of a sweep lies half a sweep before its middle; taken for one another, the two make an odometry
    run ahead by half a sweep.
    """

    last: SweepMotion | None
    _T_middle_stamp: Annotated[FloatArray, TRANSFORM]  # of the last scan: from its stamp to the middle of its sweep

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Restart: the next motion does not follow on the last."""
        self.last, self._T_middle_stamp = None, np.eye(4)

    def between_stamps(
        self, T_prev_curr: FloatArray, change: FloatArray, middles: tuple[float, float], stamps: tuple[float, float]
    ) -> FloatArray:
        """The motion (4, 4) between the stamps of two scans, the previous first, from that between their middles.

        `change` (6,) is the `velocity_change` of T_prev_curr (4, 4), the motion between the middles, which increase.
        """
        interval_s = middles[1] - middles[0]
        motion = SweepMotion(log(T_prev_curr) / interval_s, change, interval_s)
        if self.last is None:
            self._T_middle_stamp = motion.pose_after(stamps[0] - middles[0])
        # The stamp mostly lies between the two middles.
        T_last_middle_stamp = motion.pose_after(stamps[1] - middles[0])
        T_prev_curr_stamps = inverse(self._T_middle_stamp) @ T_last_middle_stamp
        self.last, self._T_middle_stamp = motion, inverse(T_prev_curr) @ T_last_middle_stamp
        return np.asarray(T_prev_curr_stamps, dtype=np.float64)
