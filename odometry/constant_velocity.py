"""The simplest prior: the sensor goes on moving as it did."""

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, log
from lidarslam.core.scan import Scan
from odometry.interface import Motion


class ConstantVelocity:
    """Predicts each motion from the one before, scaled by the real time between the scans.

    It measures nothing itself: the velocity comes from `correct`, that is, from scan-to-map refinement.
    """

    def __init__(self) -> None:
        self._velocity = np.zeros(6)
        self._stamp: float | None = None
        self._interval_s = 0.0

    def estimate(self, scan: Scan) -> Motion:
        """The motion at the last corrected velocity; identity until there is one."""
        self._interval_s = 0.0 if self._stamp is None else scan.stamp - self._stamp
        self._stamp = scan.stamp
        return Motion(exp(self._velocity * self._interval_s), points_used=0)

    def correct(self, T_prev_curr: FloatArray) -> None:
        """Take over the velocity of the corrected motion."""
        if self._interval_s > 0.0:
            self._velocity = log(T_prev_curr) / self._interval_s

    def close(self) -> None:
        """Nothing is held."""
