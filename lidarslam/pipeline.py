"""One scan after another through odometry and into the map: no files, no printing, no window.

Odometry is where the time goes, and one scan's motion must be known before the next can be estimated. What follows
from a motion (checking it, compensating the sweep, adding it to the map) happens on a second thread meanwhile.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.tracking import Status
from mapping.config import GlobalMapConfig
from mapping.deskew import deskew
from mapping.global_map import GlobalMap, voxel_size_for
from odometry.consistency import Consistency, ConsistencyCheck
from odometry.interface import Motion, Odometry

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


class Pipeline:
    """Turns a stream of scans into a stream of results and a global map."""

    def __init__(self, odometry: Odometry, check: ConsistencyCheck, config: GlobalMapConfig) -> None:
        self._odometry = odometry
        self._check = check
        self._config = config
        self._T_odom_lidar = np.eye(4)
        self._previous_stamp: float | None = None
        self._voxel_size_m = config.voxel_size_m
        self._waiting: Scan | None = None  # the first scan, until a motion says how to compensate it
        self.global_map: GlobalMap | None = None

    def run(self, scans: Iterable[Scan]) -> Iterator[ScanResult]:
        """Process the scans in order; each result comes while the next scan's odometry is at work."""
        job: Future[ScanResult] | None = None
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="map") as pool:
            for follow in self._lead(scans):
                if job is not None:
                    yield job.result()
                job = pool.submit(follow)
            if job is not None:
                yield job.result()
        if self._waiting is not None:  # there never was a second scan
            self._add(self._waiting.points, np.eye(4))

    def _lead(self, scans: Iterable[Scan]) -> Iterator[Callable[[], ScanResult]]:
        """Read and estimate scan after scan; what is left to do for each is handed out as a function."""
        started = time.perf_counter()
        for scan in scans:
            read = time.perf_counter()
            motion = self._odometry.estimate(scan)
            stage_ms = {"read": _ms(started, read), "odometry": _ms(read, time.perf_counter())}
            interval_s = 0.0 if self._previous_stamp is None else scan.stamp - self._previous_stamp
            self._previous_stamp = scan.stamp
            self._T_odom_lidar = self._T_odom_lidar @ motion.T_prev_curr
            yield partial(self._follow, scan, motion, self._T_odom_lidar, interval_s, stage_ms)
            started = time.perf_counter()

    def _follow(
        self, scan: Scan, motion: Motion, T_odom_lidar: FloatArray, interval_s: float, stage_ms: dict[str, float]
    ) -> ScanResult:
        """Everything that follows from a motion: compensate the sweep, check the motion, add to the map."""
        started = time.perf_counter()
        thinned = self._thin(scan)
        points = _compensate(thinned, motion.T_prev_curr, interval_s)
        compensated = time.perf_counter()
        fit = self._check.check(points, motion.T_prev_curr)
        checked = time.perf_counter()
        status, message = _judge(motion, fit)
        if interval_s == 0.0:
            self._waiting = thinned
        else:
            self._add_waiting(motion.T_prev_curr, interval_s)
            if status is not Status.LOST:  # a pose that is not believed must not draw walls
                self._add(points, T_odom_lidar)
        stage_ms["deskew"] = _ms(started, compensated)
        stage_ms["check"] = _ms(compensated, checked)
        stage_ms["map"] = _ms(checked, time.perf_counter())
        return ScanResult(
            stamp=scan.stamp,
            T_world_lidar=T_odom_lidar,
            T_odom_lidar=T_odom_lidar,
            status=status,
            message=message,
            points=points,
            points_read=len(scan),
            points_dropped=scan.dropped,
            points_used=motion.points_used,
            residual_m=fit.residual_m,
            inlier_ratio=fit.inlier_ratio,
            stage_ms=stage_ms,
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

    def _add_waiting(self, T_prev_curr: FloatArray, interval_s: float) -> None:
        """Add the first scan, which waited for the second's motion to be compensated with."""
        first, self._waiting = self._waiting, None
        if first is not None:
            self._add(_compensate(first, T_prev_curr, interval_s), np.eye(4))

    def _add(self, points: FloatArray, T_world_lidar: FloatArray) -> None:
        if self._voxel_size_m is None:  # no scan had a point so far
            return
        if self.global_map is None:
            self.global_map = GlobalMap(self._voxel_size_m)
        self.global_map.add(points, T_world_lidar)


def _compensate(scan: Scan, T_prev_curr: FloatArray, interval_s: float) -> FloatArray:
    """The scan's points as seen from the pose at its stamp."""
    if scan.time_offsets is None:
        return scan.points
    return deskew(scan.points, scan.time_offsets, T_prev_curr, interval_s)


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
