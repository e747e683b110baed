"""The way of a scan: odometry, scan-to-map registration, global map, pose graph. No files, no printing, no window.

Three threads: odometry on the caller's, as one scan's motion is needed for the next; registration and map on a second,
one scan behind, because deskewing needs the motion after the stamp as well; the pose graph on a third.
"""

import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from typing import TYPE_CHECKING, Protocol

from threadpoolctl import threadpool_limits

from lidarslam.core.errors import LidarSlamError
from lidarslam.core.scan import Scan
from lidarslam.core.state import Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.odometry.interface import Odometry
from lidarslam.pipeline.background_worker import BackgroundWorker
from lidarslam.pipeline.estimates import Estimated, ScanResult, graph_scan
from lidarslam.pipeline.localisation import Localiser
from lidarslam.pipeline.map_building import MapBuilder

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph

# Scans that may wait for the map, which now and then takes as long as several scans, and calls that may wait for the
# graph, which takes as long for a loop closure as for all scans up to the next keyframe.
_SCANS_BEHIND, _GRAPH_CALLS_BEHIND = 8, 64


class Checkpointer(Protocol):
    """Saves the state of a run now and then."""

    def is_due(self) -> bool:
        """Whether to save now; asked after every scan."""

    def save(self, pipeline: "Pipeline") -> None:
        """Save the pipeline's state; no thread is at work, and all results up to here are out."""


class Pipeline(Stateful):
    """Turns a stream of scans into a stream of poses, a global map and a pose graph.

    Args:
        odometry, localiser: estimate the poses.
        config: of the global map.
        graph: built along the way; complete when the last result has come.
        checkpointer: saves the state now and then, without that of odometry and graph.
    """

    map: MapBuilder
    _localiser: Localiser
    held: Estimated | None  # the last scan that was read: its result waits for the next one
    _measured_stamp: float | None  # of the last scan, unless its motion was only predicted

    def __init__(
        self,
        odometry: Odometry,
        localiser: Localiser,
        config: GlobalMapConfig,
        graph: "SlamGraph | None" = None,
        checkpointer: Checkpointer | None = None,
    ) -> None:
        self._odometry = odometry
        self._localiser = localiser
        self._graph = graph
        self._graph_worker = BackgroundWorker("graph", _GRAPH_CALLS_BEHIND)
        self._checkpointer = checkpointer
        self.held = None
        self._measured_stamp = None
        self._error: LidarSlamError | None = None  # that ended the scans
        self.map = MapBuilder(config)

    def run(self, scans: Iterable[Scan]) -> Generator[ScanResult, None, None]:
        """Process the scans in order; each result comes while later scans' odometry is at work.

        An error of the reader is raised after the results of the scans before it.
        """
        jobs: deque[Future[ScanResult]] = deque()
        # Matrices are small: BLAS threads would mostly wait, and take the cores from the other threads.
        with closing(self._graph_worker), threadpool_limits(1, "blas"), ThreadPoolExecutor(1, "map") as map_worker:
            for estimated in self._estimate(scans):
                previous, self.held = self.held, estimated
                if previous is None:
                    continue
                jobs.append(map_worker.submit(self._process, previous, estimated))
                while jobs and (jobs[0].done() or len(jobs) > _SCANS_BEHIND):
                    yield jobs.popleft().result()
                if self._checkpointer is not None and self._checkpointer.is_due():
                    while jobs:
                        yield jobs.popleft().result()
                    self._graph_worker.wait()
                    self._checkpointer.save(self)
            if self.held is not None:
                jobs.append(map_worker.submit(self._process, self.held, None))
            while jobs:
                yield jobs.popleft().result()
            self._add_pending(next_is_lost=False)
            self.map.slides.finish()
        if self._error is not None:
            raise self._error

    def _estimate(self, scans: Iterable[Scan]) -> Iterator[Estimated]:
        """The odometry of one scan after the other; an error ends them and is kept."""
        started = time.perf_counter()
        try:
            for scan in scans:
                read = time.perf_counter()
                motion = self._odometry.estimate(scan)
                stage_ms = {"read": _ms(started, read), "odometry": _ms(read, time.perf_counter())}
                measured, previous = motion.failure is None, self._measured_stamp
                interval_s = scan.stamp - previous if measured and previous is not None else None
                self._measured_stamp = scan.stamp if measured else None
                yield Estimated(scan, motion, interval_s, stage_ms)
                started = time.perf_counter()
        except LidarSlamError as error:
            self._error = error

    def _process(self, estimated: Estimated, following: Estimated | None) -> ScanResult:
        """Find the pose of a scan, deskew it, add the scan before to the map, and both to the graph."""
        scan = estimated.scan
        localised = self._localiser.localise(estimated, following)
        found = time.perf_counter()
        thinned = self.map.thin(scan)
        points = localised.motion.compensate(thinned)
        deskewed = time.perf_counter()
        self._add_pending(next_is_lost=localised.status is Status.LOST)
        self.map.add(thinned, points, localised)
        if self._graph is not None:
            self._graph_worker.submit(self._graph.add, graph_scan(estimated, localised, points))
        stage_ms = {"deskew": _ms(found, deskewed), "map": _ms(deskewed, time.perf_counter())}
        return ScanResult(
            **vars(localised) | {"stage_ms": estimated.stage_ms | localised.stage_ms | stage_ms},
            stamp=scan.stamp,
            points=points,
            points_read=len(scan),
            points_dropped=scan.dropped,
        )

    def _add_pending(self, next_is_lost: bool) -> None:
        added = self.map.add_pending(next_is_lost)
        if added is not None and self._graph is not None:
            self._graph_worker.submit(self._graph.draw, *added, self.map.voxel_size_m)


def _ms(start: float, end: float) -> float:
    return 1e3 * (end - start)
