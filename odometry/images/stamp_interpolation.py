"""From motions between the middles of sweeps, which is what two scans show, to motions between their stamps."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.core.state import Saved, State


@dataclass(frozen=True, eq=False)
class Leg:
    """A motion between the middles of two sweeps.

    Attributes:
        velocity: (6,) its mean, rotation first, in radians and metres a second.
        bend: (6,) velocity in the later middle less the mean, and in the earlier one the mean less the velocity.
        interval_s: how long it took.
    """

    velocity: FloatArray
    bend: FloatArray
    interval_s: float

    @classmethod
    def restored(cls, saved: Saved) -> "Leg":
        """The leg with a state, which is all of it."""
        return cls(saved.array("velocity", (6,)), saved.array("bend", (6,)), saved.number("interval_s"))

    def pose_after(self, seconds: float) -> FloatArray:
        """(4, 4) in the frame of the earlier middle, so long after it: the velocity changes evenly."""
        return exp(self.velocity * seconds + self.bend * (seconds * (seconds / self.interval_s - 1.0)))


class Retimer:
    """Follows the motion through the middles of sweeps, and tells where the sensor was at their stamps.

    A stamp at the start of a sweep lies half a sweep before its middle; taken for one another, the two make an odometry
    run ahead by half a sweep.
    """

    def __init__(self) -> None:
        self.last: Leg | None = None
        self._T_middle_stamp = np.eye(4)  # of the last scan: from its stamp to the middle of its sweep

    def forget(self) -> None:
        """The way on is not known: the next motion begins anew."""
        self.last, self._T_middle_stamp = None, np.eye(4)

    def state(self) -> State:
        """The last leg, and where its scan's stamp lies."""
        return {"last": None if self.last is None else dict(vars(self.last)), "T_middle_stamp": self._T_middle_stamp}

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        self.last = saved.optional("last", Leg.restored)
        self._T_middle_stamp = saved.array("T_middle_stamp", (4, 4))

    def between_stamps(
        self, T_prev_curr: FloatArray, bend: FloatArray, middles: tuple[float, float], stamps: tuple[float, float]
    ) -> FloatArray:
        """The motion (4, 4) between the stamps of two scans, the previous first, from that between their middles.

        Args:
            T_prev_curr: (4, 4) from the middle of the current sweep to that of the previous one.
            bend: (6,) as in `Leg`.
            middles, stamps: of the previous and of the current scan, seconds; middles increase.
        """
        interval_s = middles[1] - middles[0]
        leg = Leg(log(T_prev_curr) / interval_s, bend, interval_s)
        if self.last is None:  # nothing is known of the motion before
            self._T_middle_stamp = leg.pose_after(stamps[0] - middles[0])
        # The stamp mostly lies between the two middles, on the way from one to the other.
        T_last_middle_stamp = leg.pose_after(stamps[1] - middles[0])
        motion = inverse(self._T_middle_stamp) @ T_last_middle_stamp
        self.last, self._T_middle_stamp = leg, inverse(T_prev_curr) @ T_last_middle_stamp
        return np.asarray(motion, dtype=np.float64)
