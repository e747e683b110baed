"""Whether the learned odometry is needed at a scan: not where the motion before predicts it well enough.

Registration converges from within about a cell of the local map. Where the constant velocity of the registered poses
has predicted the last ones to a fraction of that, the network adds nothing and costs half of the time.
"""

from collections import deque
from collections.abc import Callable
from typing import Annotated

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray, displacement_m, exp, inverse, log
from lidarslam.core.scan import Scan
from lidarslam.core.state import TRANSFORM, Shape, State, Stateful
from lidarslam.core.tracking import Status
from lidarslam.odometry.interface import ExpectingOdometry, Motion, Odometry, SkippingOdometry
from lidarslam.pipeline.estimates import ScanEstimate

# Scans in a row that have to be ok before one does without the odometry.
_LEAST_OK = 10
# Largest error of the predictions, as a share of the local map's cells, and its remaining share after a scan.
_LARGEST_ERROR, _FADING = 0.25, 0.9
# Range at which an error of the rotation is counted, metres.
_RANGE_M = 10.0
# Largest interval over which a velocity is taken as constant, seconds, and its largest ratio to the one before.
_LONGEST_S, _LARGEST_RATIO = 0.15, 1.5
# Results that may be pending: only those are waited for that could make a difference.
_MOST_WAITING = 8


class OdometryGate(Stateful):
    """Asks the learned odometry where it is needed; implements `Odometry`.

    The decision for a scan uses all results that were given to `follow` but the last, whether or not that has arrived:
    registration does not wait, and poses do not depend on timing.
    """

    _odometry: SkippingOdometry
    _ok: int  # ok scans in a row
    _error_cells: float  # of the last predictions, in cells of the local map: the largest, fading
    _before: tuple[int, float]  # both before the last result
    _stamp: float | None  # of the last scan that was given to `estimate`
    _interval_s: float | None  # between the last two
    _T_world_last: Annotated[FloatArray, TRANSFORM] | None  # pose of the last ok scan, unless another one followed
    _last_stamp: float  # its stamp
    _velocity: Annotated[FloatArray, Shape(6)] | None  # (6,) up to it

    def __init__(self, odometry: SkippingOdometry) -> None:
        self._odometry = odometry
        self._waiting: deque[Callable[[], ScanEstimate]] = deque()
        self._ok, self._error_cells, self._before = 0, 0.0, (0, 0.0)
        self._stamp = self._interval_s = self._T_world_last = self._velocity = None
        self._last_stamp = 0.0

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the previous scan, where it is needed; else the mapping predicts it."""
        interval_s = None if self._stamp is None else scan.stamp - self._stamp
        before, self._stamp, self._interval_s = self._interval_s, scan.stamp, interval_s
        is_gap = before is None or interval_s is None or interval_s > min(_LONGEST_S, _LARGEST_RATIO * before)
        if not is_gap and len(scan):
            self.wait()
        if is_gap or not len(scan) or not self._may_be_skipped():
            return self._odometry.estimate(scan)
        self._odometry.skip(scan)
        return Motion(np.eye(4), 0, "not needed", is_asked=False)

    def expect(self, velocity: FloatArray) -> None:
        if isinstance(self._odometry, ExpectingOdometry):
            self._odometry.expect(velocity)

    def wait(self) -> None:
        """Wait for the results that decide about the next scan, so that `estimate` is timed without the wait."""
        while self._may_be_skipped() and len(self._waiting) > 1:
            self._take()

    def follow(self, estimate: Callable[[], ScanEstimate]) -> None:
        """Take the result of the next scan, which is computed on another thread."""
        self._waiting.append(estimate)
        if len(self._waiting) > _MOST_WAITING:
            self._take()

    def state(self) -> State:
        """The state it carries from scan to scan; all results have arrived."""
        while self._waiting:
            self._take()
        return super().state()

    def close(self) -> None:
        self._odometry.close()

    def _may_be_skipped(self) -> bool:
        """Whether the next scan can do without, if all pending results are as good as possible."""
        waiting = max(1, len(self._waiting))
        ok, error_cells = (self._ok, self._error_cells) if self._waiting else self._before
        return ok + waiting >= _LEAST_OK and error_cells * _FADING**waiting < _LARGEST_ERROR

    def _take(self) -> None:
        estimate, self._before = self._waiting.popleft()(), (self._ok, self._error_cells)
        if estimate.status is not Status.OK or not estimate.is_connected or not estimate.cells_m:
            self._ok, self._T_world_last, self._velocity = 0, None, None
            return
        before, self._T_world_last = self._T_world_last, estimate.T_world_lidar
        interval_s, self._last_stamp = estimate.stamp - self._last_stamp, estimate.stamp
        if before is None:
            self._ok = 1
            return
        motion = log(inverse(before) @ estimate.T_world_lidar)
        if self._velocity is not None:
            error = log(inverse(exp(self._velocity * interval_s)) @ exp(motion))
            error_cells = displacement_m(error, _RANGE_M) / estimate.cells_m[0]
            self._error_cells = max(_FADING * self._error_cells, error_cells)
            self._ok += 1
        self._velocity = motion / interval_s


def where_needed(odometry: Odometry, config: Config) -> Odometry:
    """The odometry, asked only where it is needed if it can be skipped and the configuration says so."""
    if config.odometry.learned.when == "always" or not config.mapping.enabled:
        return odometry
    return OdometryGate(odometry) if isinstance(odometry, SkippingOdometry) else odometry
