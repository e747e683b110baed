"""One scan after another through odometry and into the map: no files, no printing, no window.

Odometry is where the time goes, and one scan's motion must be known before the next can be estimated. What follows
from a motion (compensating the sweep, checking the motion, adding to the map) happens on a second thread meanwhile,
one scan later, when the motion after the scan is known as well.
"""

import time
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from lidarslam.core.errors import LidarSlamError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.tracking import Status
from mapping.config import GlobalMapConfig
from mapping.deskew import body_velocity, deskew
from mapping.global_map import GlobalMap, voxel_size_for
from odometry.consistency import Consistency, ConsistencyCheck
from odometry.interface import Motion, Odometry

# How many scans the second thread may lag behind: the map now and then takes as long as several scans to tidy up.
_MAX_BEHIND = 8

STAGES = ("read", "odometry", "deskew", "check", "map")


@dataclass(frozen=True, eq=False)
class ScanResult:
    """What became of one scan.

    Attributes:
        stamp: seconds.
        T_world_lidar: (4, 4), the final pose at the stamp; the world is the first scan's LiDAR frame.
        T_odom_lidar: (4, 4), what the odometry alone says.
        status: whether to believe the pose, and `message` why not.
        points: (N, 3) in the LiDAR frame at the stamp, motion compensated, within the map's range, one a voxel.
        points_read, points_dropped: valid points of the raw scan, and how many were left out as invalid.
        points_used: how many the motion rests on.
        residual_m, inlier_ratio: how the scan lies on the previous one; None when that cannot be told.
        stage_ms: wall time of each of the `STAGES`; read is the time spent waiting for the scan.
    """

    stamp: float
    T_world_lidar: FloatArray
    T_odom_lidar: FloatArray
    status: Status
    message: str
    points: FloatArray
    points_read: int
    points_dropped: int
    points_used: int
    residual_m: float | None
    inlier_ratio: float | None
    stage_ms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Estimated:
    """A scan whose motion is known, and what else is needed to go on with it."""

    scan: Scan
    motion: Motion
    T_odom_lidar: FloatArray
    interval_s: float | None  # that the motion took; None when nothing was measured
    stage_ms: dict[str, float]

    @property
    def velocity(self) -> FloatArray | None:
        """(6,) between the previous stamp and this one; None when it was not measured."""
        return None if self.interval_s is None else body_velocity(self.motion.T_prev_curr, self.interval_s)


@dataclass(frozen=True, eq=False)
class _Compensated:
    """A scan that waits to be added to the map until the motion it was compensated with is checked."""

    thinned: Scan
    velocity_before: FloatArray | None
    points: FloatArray
    T_world_lidar: FloatArray


class Pipeline:
    """Turns a stream of scans into a stream of results and a global map."""

    def __init__(self, odometry: Odometry, check: ConsistencyCheck, config: GlobalMapConfig) -> None:
        self._odometry = odometry
        self._check = check
        self._config = config
        self._voxel_size_m = config.voxel_size_m
        self._waiting: _Compensated | None = None
        self.global_map: GlobalMap | None = None

    def run(self, scans: Iterable[Scan]) -> Iterator[ScanResult]:
        """Process the scans in order; each result comes while later scans' odometry is at work.

        An error of the scans' reader is raised after the results of the scans before it.
        """
        jobs: deque[Future[ScanResult]] = deque()
        error: Exception | None = None
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="map") as pool:
            estimates = _with_next(self._estimate(scans))
            while error is None:
                try:
                    estimated, following = next(estimates)
                except StopIteration:
                    break
                except LidarSlamError as reason:
                    error = reason
                    continue
                jobs.append(pool.submit(self._follow, estimated, following))
                if len(jobs) > _MAX_BEHIND:
                    yield jobs.popleft().result()
            while jobs:
                yield jobs.popleft().result()
        self._add_waiting(Status.OK)
        if error is not None:
            raise error

    def _estimate(self, scans: Iterable[Scan]) -> Iterator[_Estimated]:
        """Read and estimate scan after scan."""
        T_odom_lidar = np.eye(4)
        measured_stamp: float | None = None  # of the scan before, unless its motion was only predicted
        started = time.perf_counter()
        for scan in scans:
            read = time.perf_counter()
            motion = self._odometry.estimate(scan)
            stage_ms = {"read": _ms(started, read), "odometry": _ms(read, time.perf_counter())}
            measured = motion.failure is None
            interval_s = scan.stamp - measured_stamp if measured and measured_stamp is not None else None
            measured_stamp = scan.stamp if measured else None
            T_odom_lidar = T_odom_lidar @ motion.T_prev_curr
            yield _Estimated(scan, motion, T_odom_lidar, interval_s, stage_ms)
            started = time.perf_counter()

    def _follow(self, estimated: _Estimated, following: _Estimated | None) -> ScanResult:
        """Everything that follows from a motion: compensate the sweep, check the motion, add to the map."""
        scan, motion = estimated.scan, estimated.motion
        started = time.perf_counter()
        before, after = estimated.velocity, following.velocity if following else None
        thinned = self._thin(scan)
        points = _compensate(thinned, before, after)
        compensated = time.perf_counter()
        fit = self._check.check(_compensate(self._check.sample(scan), before, after), motion.T_prev_curr)
        checked = time.perf_counter()
        status, message = _judge(motion, fit)
        self._add_waiting(status)
        if status is not Status.LOST:  # a pose that is not believed must not draw walls
            self._waiting = _Compensated(thinned, before, points, estimated.T_odom_lidar)
        followed_ms = {
            "deskew": _ms(started, compensated),
            "check": _ms(compensated, checked),
            "map": _ms(checked, time.perf_counter()),
        }
        return ScanResult(
            stamp=scan.stamp,
            T_world_lidar=estimated.T_odom_lidar,
            T_odom_lidar=estimated.T_odom_lidar,
            status=status,
            message=message,
            points=points,
            points_read=len(scan),
            points_dropped=scan.dropped,
            points_used=motion.points_used,
            residual_m=fit.residual_m,
            inlier_ratio=fit.inlier_ratio,
            stage_ms=estimated.stage_ms | followed_ms,
        )

    def _thin(self, scan: Scan) -> Scan:
        """The points within the map's range, one a voxel of the map: more would not change it."""
        if not len(scan):
            return scan
        if self._voxel_size_m is None:
            self._voxel_size_m = voxel_size_for(scan.points)
        thinned = scan.select(one_per_cell(scan.points, self._voxel_size_m))
        squared = np.einsum("ij,ij->i", thinned.points, thinned.points)
        return thinned.select((squared >= self._config.min_range_m**2) & (squared <= self._config.max_range_m**2))

    def _add_waiting(self, next_status: Status) -> None:
        """Add the scan before to the map; not as compensated with a motion that has turned out to be wrong."""
        scan, self._waiting = self._waiting, None
        if scan is None or self._voxel_size_m is None:  # no scan had a point so far
            return
        points = scan.points
        if next_status is Status.LOST:
            points = _compensate(scan.thinned, scan.velocity_before, None)
        if self.global_map is None:
            self.global_map = GlobalMap(self._voxel_size_m)
        self.global_map.add(points, scan.T_world_lidar)


def _with_next(items: Iterable[_Estimated]) -> Iterator[tuple[_Estimated, _Estimated | None]]:
    """Each item with the one after it, None after the last."""
    held: _Estimated | None = None
    error: LidarSlamError | None = None
    try:
        for item in items:
            if held is not None:
                yield held, item
            held = item
    except LidarSlamError as reason:  # the last item before it still has its turn
        error = reason
    if held is not None:
        yield held, None
    if error is not None:
        raise error


def _compensate(scan: Scan, before: FloatArray | None, after: FloatArray | None) -> FloatArray:
    """The scan's points as seen from the pose at its stamp.

    A sweep lies between two motions. Stamps stand at its start in most recordings, so that going on with the motion
    before would be a guess; the one after it is known by now.
    """
    known = [velocity for velocity in (before, after) if velocity is not None]
    if scan.time_offsets is None or not known:
        return scan.points
    return deskew(scan.points, scan.time_offsets, known[0], known[-1])


def _judge(motion: Motion, fit: Consistency) -> tuple[Status, str]:
    """A motion that was not measured is lost, whatever it fits; else the fit decides."""
    if motion.failure is not None:
        return Status.LOST, motion.failure
    if fit.status is Status.OK:
        return Status.OK, ""
    if fit.inlier_ratio is None:
        return fit.status, "too few planes to check the motion against the previous scan"
    return fit.status, f"only {100.0 * fit.inlier_ratio:.0f} % of the scan lies on the previous one"


def _ms(start: float, end: float) -> float:
    return 1e3 * (end - start)
