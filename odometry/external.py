"""Someone else's trajectory as the odometry: wheel odometry, an INS, another program's result."""

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from odometry.interface import Motion


class ExternalOdometry:
    """Reads each motion off a given trajectory, interpolated at the scans' stamps.

    Args:
        trajectory: T_odom_lidar at its own stamps; its world does not matter, only its motions do.
        tolerance_s: how far outside the trajectory's time a scan may lie and still be extrapolated.
    """

    def __init__(self, trajectory: Trajectory, tolerance_s: float = 0.1) -> None:
        self._trajectory = trajectory
        self._tolerance_s = tolerance_s
        self._T_odom_prev: FloatArray | None = None

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the last scan that lay within the trajectory's time."""
        try:
            T_odom_curr = self._trajectory.at(np.array([scan.stamp]), self._tolerance_s)[0]
        except ValueError as error:
            return Motion(np.eye(4), 0, f"the prior does not cover this scan: {error}")
        T_odom_prev, self._T_odom_prev = self._T_odom_prev, T_odom_curr
        if T_odom_prev is None:
            return Motion(np.eye(4), len(scan))
        return Motion(inverse(T_odom_prev) @ T_odom_curr, len(scan))

    def correct(self, T_prev_curr: FloatArray) -> None:
        """A recorded trajectory does not learn."""

    def close(self) -> None:
        """Nothing is held."""
