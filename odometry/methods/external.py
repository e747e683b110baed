"""Someone else's trajectory as the odometry: wheel odometry, an INS, another program's result."""

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from lidarslam.core.trajectory import Trajectory
from odometry.interface import Motion

# A hole is never shorter than this, nor than so many of the trajectory's usual steps.
_LEAST_HOLE_S = 1.0
_LEAST_HOLE_STEPS = 5.0
# A scan this close to a given pose is covered by it, whatever lies on the other side.
_SAME_INSTANT_S = 1e-3


class ExternalOdometry:
    """Reads each motion off a given trajectory, interpolated at the scans' stamps.

    Args:
        trajectory: T_odom_lidar at its own stamps; its world does not matter, only its motions do.
        tolerance_s: how far outside the trajectory's time a scan may lie and still be extrapolated.
        largest_interval_s: poses farther apart in time are not bridged, a scan between them is not covered;
            None: a second, or five times the trajectory's median step where that is longer.

    Raises:
        InputError: the trajectory has fewer than two poses.
    """

    def __init__(
        self, trajectory: Trajectory, tolerance_s: float = 0.1, largest_interval_s: float | None = None
    ) -> None:
        if len(trajectory) < 2:
            raise InputError(
                f"a prior trajectory needs two poses or more to read motions from, this one has {len(trajectory)}"
            )
        self._trajectory = trajectory
        self._tolerance_s = tolerance_s
        if largest_interval_s is None:
            median_step_s = float(np.median(np.diff(trajectory.stamps)))
            largest_interval_s = max(_LEAST_HOLE_S, _LEAST_HOLE_STEPS * median_step_s)
        self._largest_interval_s = largest_interval_s
        self._T_odom_prev: FloatArray | None = None

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the last scan that the trajectory covered."""
        try:
            T_odom_curr = self._trajectory.at(np.array([scan.stamp]), self._tolerance_s)[0]
        except ValueError as error:
            return Motion(np.eye(4), 0, f"the prior does not cover this scan: {error}")
        hole = self._hole_around(scan.stamp)
        if hole is not None:
            start, end = hole
            return Motion(
                np.eye(4),
                0,
                f"the prior does not cover this scan: it has no pose from {start:.6f} to {end:.6f},"
                f" and at most {self._largest_interval_s:.3g} s are bridged",
            )
        T_odom_prev, self._T_odom_prev = self._T_odom_prev, T_odom_curr
        if T_odom_prev is None:
            return Motion(np.eye(4), len(scan))
        return Motion(inverse(T_odom_prev) @ T_odom_curr, len(scan))

    def _hole_around(self, stamp: float) -> tuple[float, float] | None:
        """First and last instant of the hole in the trajectory that the stamp lies in, None where there is none."""
        stamps = self._trajectory.stamps
        right = int(np.searchsorted(stamps, stamp, side="right"))
        if not 0 < right < len(stamps):
            return None
        start, end = float(stamps[right - 1]), float(stamps[right])
        is_hole = end - start > self._largest_interval_s
        return (start, end) if is_hole and min(stamp - start, end - stamp) > _SAME_INSTANT_S else None

    def state(self) -> State:
        """The pose of the last scan that was covered."""
        return {"T_odom_prev": self._T_odom_prev}

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first scan."""
        self._T_odom_prev = saved.optional_array("T_odom_prev", (4, 4))

    def close(self) -> None:
        """Nothing is held."""
