"""A given trajectory as the odometry: wheel odometry, an INS, another program's result."""

from typing import Annotated

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.state import TRANSFORM
from lidarslam.core.trajectory import Trajectory
from lidarslam.odometry.interface import Motion, StatefulOdometry

# A scan this close to a given pose is covered by it, whatever lies on the other side.
_SAME_INSTANT_S = 1e-3


def longest_bridged_s(stamps: FloatArray) -> float:
    """The longest interval of poses (N,) that is no gap: a second, or five of the usual steps if those are longer."""
    return max(1.0, 5.0 * float(np.median(np.diff(stamps))))


class ExternalOdometry(StatefulOdometry):
    """Motions of a given trajectory T_odom_lidar, interpolated at the scans' stamps.

    A scan is extrapolated over `tolerance_s` at most, and not covered in a gap between two poses of more than a second,
    or five of the trajectory's median steps. InputError where there are fewer than two poses.
    """

    _T_odom_prev: Annotated[FloatArray, TRANSFORM] | None  # of the last scan that was covered
    _scans: int
    _uncovered: int  # scans without a pose

    def __init__(self, trajectory: Trajectory, tolerance_s: float = 0.1) -> None:
        if len(trajectory) < 2:
            raise InputError(f"a prior trajectory needs two poses or more, this one has {len(trajectory)}")
        self._trajectory = trajectory
        self._tolerance_s = tolerance_s
        self._largest_interval_s = longest_bridged_s(trajectory.stamps)
        self._T_odom_prev = None
        self._scans = self._uncovered = 0

    def require_overlap(self, first_stamp: float, last_stamp: float) -> None:
        """Refuse scans of another time altogether.

        InputError where the trajectory begins after the last scan, or ends before the first.
        """
        first, last = float(self._trajectory.stamps[0]), float(self._trajectory.stamps[-1])
        if first - self._tolerance_s > last_stamp or last + self._tolerance_s < first_stamp:
            raise InputError(
                f"the prior has poses from {first:.3f} to {last:.3f} s, the recording scans from {first_stamp:.3f} to"
                f" {last_stamp:.3f} s, so that none has a pose; is it of this recording, in seconds of the same clock?"
            )

    @property
    def warning(self) -> str | None:
        """Warning with the number of scans without a pose; None where all had one."""
        return f"the prior does not cover {self._uncovered} of {self._scans} scans" if self._uncovered else None

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the last scan that the trajectory covered."""
        self._scans += 1
        try:
            T_odom_curr = self._trajectory.at(np.array([scan.stamp]), self._tolerance_s)[0]
            self._require_no_gap(scan.stamp)
        except ValueError as error:
            self._uncovered += 1
            return Motion(np.eye(4), 0, f"the prior does not cover this scan: {error}")
        T_odom_prev, self._T_odom_prev = self._T_odom_prev, T_odom_curr
        return Motion(np.eye(4) if T_odom_prev is None else inverse(T_odom_prev) @ T_odom_curr, len(scan))

    def _require_no_gap(self, stamp: float) -> None:
        stamps = self._trajectory.stamps
        right = int(np.searchsorted(stamps, stamp, side="right"))
        if not 0 < right < len(stamps):
            return
        start, end = float(stamps[right - 1]), float(stamps[right])
        if end - start > self._largest_interval_s and min(stamp - start, end - stamp) > _SAME_INSTANT_S:
            raise ValueError(
                f"it has no pose from {start:.6f} to {end:.6f},"
                f" and at most {self._largest_interval_s:.3g} s are bridged"
            )
