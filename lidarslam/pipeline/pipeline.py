"""One scan after another through odometry and into the map: no files, no printing, no window.

One scan's motion must be known before the next can be estimated. What follows from a motion (laying the scan on the map
or holding it against the one before, and adding it to the global map) happens on a second thread meanwhile, one scan
later, when the motion after the scan is known as well. A pose graph, where there is one, follows on a third.
"""

import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from threadpoolctl import threadpool_limits

from lidarslam.core.errors import LidarSlamError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.tracking import Status
from lidarslam.pipeline.background_worker import Behind, Follower, graph_scan
from lidarslam.pipeline.localisation import Estimated, Localised, Localiser, SweepMotion
from lidarslam.pipeline.pending_scans import Compensated, Timed
from mapping.config import GlobalMapConfig
from mapping.global_map.global_map import GlobalMap, voxel_size_for
from mapping.global_map.moved_points import Views
from mapping.slides.slides import SlideCheck
from odometry.interface import Odometry

# How many scans the second thread may lag behind: the map now and then takes as long as several scans to tidy up.
_MAX_BEHIND = 8

STAGES = ("read", "odometry", "refine", "check", "deskew", "map")


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
        points_used: how many the pose rests on.
        residual_m, inlier_ratio: how the scan lies on the map or on the previous one; None when that cannot be told.
        degenerate: names of the directions of motion that the scan says nothing about.
        covariance: (6, 6) of the pose, rotation first, in the LiDAR frame; None when there is none.
        stage_ms: wall time of those of the `STAGES` that were gone through; read is the time waited for the scan.
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
    degenerate: tuple[str, ...] = ()
    covariance: FloatArray | None = None
    stage_ms: dict[str, float] = field(default_factory=dict)


class Keeper(Protocol):
    """Keeps now and then what is needed to go on after the program was killed."""

    def is_due(self) -> bool:
        """Whether it is time; asked after every scan."""

    def keep(self, pipeline: "Pipeline") -> None:
        """Keep the pipeline's state; nothing is at work meanwhile, and all results up to here are out."""


class Pipeline:
    """Turns a stream of scans into a stream of results and a global map.

    Args:
        odometry, localiser: where scans are.
        config: of the global map.
        graph: follows what comes of it on a thread of its own, and is up to date when the last result has come.
        keeper: keeps its state now and then.
    """

    def __init__(
        self,
        odometry: Odometry,
        localiser: Localiser,
        config: GlobalMapConfig,
        graph: Follower | None = None,
        keeper: Keeper | None = None,
    ) -> None:
        self._odometry = odometry
        self._localiser = localiser
        self._config = config
        self._graph = None if graph is None else Behind(graph)
        self._voxel_size_m = config.voxel_size_m
        self._waiting: Compensated | None = None
        self._keeper = keeper
        self._held: Timed | None = None  # whose successor is not known yet
        self._measured_stamp: float | None = None  # of the last scan, unless its motion was only predicted
        self._followed = 0  # scans that are done but for the map
        self.global_map: GlobalMap | None = None
        self.slides = SlideCheck()
        self.views = Views()  # none where the configuration does not ask for them

    @property
    def held(self) -> Scan | None:
        """The last scan that was read, while its result waits for the next one."""
        return None if self._held is None else self._held.estimated.scan

    def state(self) -> State:
        """What is remembered of the scans so far; to be had by a `Keeper` only, but for the graph's part.

        The odometry's part is None where it has to be given the scans again.
        """
        return {
            "odometry": self._odometry.state(),
            "localiser": self._localiser.state(),
            "voxel_size_m": self._voxel_size_m,
            "waiting": None if self._waiting is None else self._waiting.state(),
            "held": None if self._held is None else self._held.state(),
            "measured_stamp": self._measured_stamp,
            "followed": self._followed,
            "global_map": None if self.global_map is None else self.global_map.state(),
            "views": self.views.state(),
            "slides": self.slides.state(),
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state, with the scans after the one that was held; not with the odometry's part."""
        self._localiser.restore(saved.part("localiser"))
        self._voxel_size_m = saved.optional_number("voxel_size_m")
        self._waiting = saved.optional("waiting", Compensated.restored)
        self._held = saved.optional("held", Timed.restored)
        self._measured_stamp = saved.optional_number("measured_stamp")
        self._followed = saved.integer("followed")
        self.global_map = saved.optional("global_map", GlobalMap.restored)
        self.views.restore(saved.part("views"))
        self.slides.restore(saved.part("slides"))

    def run(self, scans: Iterable[Scan]) -> Generator[ScanResult, None, None]:
        """Process the scans in order; each result comes while later scans' odometry is at work.

        An error of the scans' reader is raised after the results of the scans before it.
        """
        try:
            yield from self._results(scans)
        finally:
            if self._graph is not None:
                self._graph.finish()

    def _results(self, scans: Iterable[Scan]) -> Iterator[ScanResult]:
        jobs: deque[Future[ScanResult]] = deque()
        error: Exception | None = None
        # Matrices here are small: a BLAS of several threads spends its time on waiting, and takes it from the others.
        with threadpool_limits(1, "blas"), ThreadPoolExecutor(max_workers=1, thread_name_prefix="map") as pool:
            estimates = self._with_next(self._estimate(scans))
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
                if self._keeper is not None and following is not None and self._keeper.is_due():
                    while jobs:
                        yield jobs.popleft().result()
                    if self._graph is not None:
                        self._graph.catch_up()
                    self._keeper.keep(self)
            while jobs:
                yield jobs.popleft().result()
        self._add_waiting(Status.OK)
        self.slides.finish()
        if error is not None:
            raise error

    def _estimate(self, scans: Iterable[Scan]) -> Iterator[Timed]:
        """Read and estimate scan after scan."""
        started = time.perf_counter()
        for scan in scans:
            read = time.perf_counter()
            motion = self._odometry.estimate(scan)
            stage_ms = {"read": _ms(started, read), "odometry": _ms(read, time.perf_counter())}
            measured = motion.failure is None
            before = self._measured_stamp
            interval_s = scan.stamp - before if measured and before is not None else None
            self._measured_stamp = scan.stamp if measured else None
            yield Timed(Estimated(scan, motion, interval_s), stage_ms)
            started = time.perf_counter()

    def _with_next(self, items: Iterable[Timed]) -> Iterator[tuple[Timed, Timed | None]]:
        """Each item with the one after it, None after the last."""
        error: LidarSlamError | None = None
        try:
            for item in items:
                held, self._held = self._held, item
                if held is not None:
                    yield held, item
        except LidarSlamError as reason:  # the last item before it still has its turn
            error = reason
        held, self._held = self._held, None
        if held is not None:
            yield held, None
        if error is not None:
            raise error

    def _follow(self, timed: Timed, following: Timed | None) -> ScanResult:
        """Everything that follows from a motion: find the pose, compensate the sweep, add to the map."""
        scan = timed.estimated.scan
        localised = self._localiser.localise(timed.estimated, following.estimated if following else None)
        found = time.perf_counter()
        thinned = self._thin(scan)
        points = localised.motion.compensate(thinned)
        compensated = time.perf_counter()
        self._add_waiting(localised.status)
        if localised.belongs_in_map:  # a pose that is not believed must not draw walls
            self._waiting = Compensated(self._followed, thinned, localised.motion, points, localised.T_world_lidar)
        self._followed += 1
        if self._graph is not None:
            self._graph.add(graph_scan(timed.estimated, localised, points))
        followed_ms = {"deskew": _ms(found, compensated), "map": _ms(compensated, time.perf_counter())}
        return _result(scan, localised, points, timed.stage_ms | localised.stage_ms | followed_ms)

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
            points = SweepMotion(scan.motion.before, None).compensate(scan.thinned)
        if self.global_map is None:
            self.global_map = GlobalMap(self._voxel_size_m)
        self.global_map.add(points, scan.T_world_lidar)
        self.slides.add(points, scan.number, scan.T_world_lidar)
        if self._config.leave_out_moved:
            self.views.add(points, scan.number)
        if self._graph is not None:
            self._graph.draw(points, scan.T_world_lidar, self._voxel_size_m)


def _result(scan: Scan, localised: Localised, points: FloatArray, stage_ms: dict[str, float]) -> ScanResult:
    return ScanResult(
        stamp=scan.stamp,
        T_world_lidar=localised.T_world_lidar,
        T_odom_lidar=localised.T_odom_lidar,
        status=localised.status,
        message=localised.message,
        points=points,
        points_read=len(scan),
        points_dropped=scan.dropped,
        points_used=localised.points_used,
        residual_m=localised.residual_m,
        inlier_ratio=localised.inlier_ratio,
        degenerate=localised.degenerate,
        covariance=localised.covariance,
        stage_ms=stage_ms,
    )


def _ms(start: float, end: float) -> float:
    return 1e3 * (end - start)
