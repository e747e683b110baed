"""The stages of a scan: odometry, scan-to-map registration, global map, pose graph. No files, no printing, no window.

Four threads: odometry and thinning on the caller's, as one scan's motion is needed for the next; registration on a
second, one scan behind, because deskewing needs the motion after the stamp as well; the global map on a third, the pose
graph on a fourth.
"""

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from typing import Protocol

from threadpoolctl import threadpool_limits

from lidarslam.core.errors import LidarSlamError
from lidarslam.core.scan import Scan
from lidarslam.core.state import Stateful
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.global_map.voxels import TileStore
from lidarslam.mapping.pose_graph.keyframe_graph import GraphScan, KeyframeGraph
from lidarslam.mapping.registration.sampled_scan import CellSizes
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.odometry.interface import Odometry
from lidarslam.pipeline import threads
from lidarslam.pipeline.estimates import ScanEstimate, ScanOdometry, graph_scan
from lidarslam.pipeline.localisation import Localiser
from lidarslam.pipeline.map_building import MapBuilder, MapCorrection
from lidarslam.pipeline.odometry_gate import OdometryGate
from lidarslam.pipeline.threads import BackgroundWorker

# Scans that may wait for the map, which at times takes as long as several scans; to bound the memory they hold.
_SCANS_BEHIND = 8
# Calls that may wait for the graph, which takes as long for a loop closure as for all scans up to the next keyframe.
_GRAPH_CALLS_BEHIND = 64

Take = Callable[[ScanEstimate, float], None]
"""Called with a scan that is deskewed, and the milliseconds from its arrival to its pose."""


class Checkpointer(Protocol):
    """Saves the state of a run at intervals."""

    def is_due(self) -> bool:
        """Whether to save now; asked after every scan."""

    def save(self, pipeline: "Pipeline") -> None:
        """Save the pipeline's state; no thread is running, and all results up to here are delivered."""


class Pipeline(Stateful):
    """Turns a stream of scans into a stream of poses, a global map and a pose graph.

    Recorded scans go through `run`; scans that arrive one by one through `register`, which returns the pose at
    once. The graph is complete when the last result has been delivered. The state excludes that of odometry and graph.
    """

    map: MapBuilder  # the global map, and the data kept with it
    held: ScanOdometry | None  # the last scan that `run` has read: its result waits for the next one
    _localiser: Localiser
    _correction: MapCorrection | None
    _measured_stamp: float | None  # of the last scan, unless its motion was only predicted

    def __init__(
        self,
        odometry: Odometry,
        localiser: Localiser,
        config: GlobalMapConfig,
        graph: KeyframeGraph | None = None,
        checkpointer: Checkpointer | None = None,
        store: TileStore | None = None,
    ) -> None:
        self._odometry, self._localiser, self._graph = odometry, localiser, graph
        self._checkpointer = checkpointer
        self._map_worker = BackgroundWorker("map", _SCANS_BEHIND)
        self._graph_worker = BackgroundWorker("graph", _GRAPH_CALLS_BEHIND)
        mapper = localiser.mapper
        self._correction = None if graph is None or mapper is None or not mapper.kept_scans else MapCorrection(mapper)
        self._measured_stamp = None
        self.map = MapBuilder(config, store, takes_submaps=graph is not None)
        self.held = None
        self._error: LidarSlamError | None = None  # that ended the scans

    def run(self, scans: Iterable[Scan]) -> Generator[ScanEstimate, None, None]:
        """Process the scans in order; each result is delivered while the odometry of later scans runs.

        An error of the reader is raised after the results of the scans before it.
        """
        jobs: deque[Future[ScanEstimate]] = deque()
        # Matrices are small: BLAS threads would mostly wait, and take the cores from the other threads.
        with (
            closing(self),
            threadpool_limits(1, "blas"),
            ThreadPoolExecutor(1, "map") as mapping,
            ThreadPoolExecutor(1, "registration") as registration,
        ):

            def submit(odometry: ScanOdometry, following: ScanOdometry | None) -> None:
                estimate = registration.submit(self._localise, odometry, following)
                self._follow(estimate.result)
                jobs.append(mapping.submit(lambda: self._build(odometry, estimate.result())))

            for number, odometry in enumerate(self._estimate_all(scans), start=1):
                if number % threads.EVERY_SCANS == 0:
                    threads.return_free_memory()
                previous, self.held = self.held, odometry
                if previous is None:
                    continue
                submit(previous, odometry)
                while jobs and (jobs[0].done() or len(jobs) > _SCANS_BEHIND):
                    yield jobs.popleft().result()
                if self._checkpointer is not None and self._checkpointer.is_due():
                    while jobs:
                        yield jobs.popleft().result()
                    self._graph_worker.wait()
                    self._checkpointer.save(self)
            if self.held is not None:
                submit(self.held, None)
            while jobs:
                yield jobs.popleft().result()
            self.finish()
        if self._error is not None:
            raise self._error

    def register(self, scan: Scan, started: float, take: Take) -> ScanEstimate:
        """The pose of the next scan at once, given the reading of `time.perf_counter` when it arrived.

        The map follows in the background, where `take` is called. LidarSlamError where that of earlier scans failed.
        """
        odometry = self._estimate(scan, _ms_since(started))
        estimate = self._localise(odometry, None)
        self._follow(lambda: estimate)
        total_ms = _ms_since(started)
        try:
            self._map_worker.submit(lambda: take(self._build(odometry, estimate), total_ms))
        except Exception as error:  # of an earlier scan
            raise map_error(error) from error
        return estimate

    def settle(self) -> None:
        """Wait until all registered scans are in the map and the graph, and raise an error of theirs."""
        self._map_worker.wait()
        self._add_pending()
        self._graph_worker.wait()

    def finish(self) -> None:
        """As `settle`, and check the last pair of scans; more may follow."""
        self.settle()
        self.map.slides.finish()

    def close(self) -> None:
        """Wait for map and graph, and end their threads."""
        with closing(self._graph_worker), closing(self._map_worker):
            pass

    def _estimate_all(self, scans: Iterable[Scan]) -> Iterator[ScanOdometry]:
        """The odometry of one scan after the other; an error ends them and is kept."""
        started = time.perf_counter()
        try:
            for scan in scans:
                yield self._estimate(scan, _ms_since(started))
                started = time.perf_counter()
        except LidarSlamError as error:
            self._error = error

    def _estimate(self, scan: Scan, read_ms: float) -> ScanOdometry:
        """The odometry of the next scan, read in `read_ms`; thinned here, as registration is busier."""
        started = time.perf_counter()
        sampled = self._localiser.sample(scan)
        stage_ms = {"read": read_ms, "refine": _ms_since(started)}
        if isinstance(self._odometry, OdometryGate):
            self._odometry.wait()
        started = time.perf_counter()
        motion = self._odometry.estimate(scan)
        stage_ms["odometry"] = _ms_since(started)
        measured, previous = motion.failure is None, self._measured_stamp
        interval_s = scan.stamp - previous if measured and previous is not None else None
        self._measured_stamp = scan.stamp if measured or not motion.is_asked else None
        return ScanOdometry(scan, motion, interval_s, stage_ms, sampled)

    def _follow(self, estimate: Callable[[], ScanEstimate]) -> None:
        """Let the odometry know the pose of the next scan, which may be computed on another thread."""
        if isinstance(self._odometry, OdometryGate):
            self._odometry.follow(estimate)

    def _localise(self, odometry: ScanOdometry, following: ScanOdometry | None) -> ScanEstimate:
        """The pose of a scan; the odometry of the following one gives the motion after the stamp, where it is known."""
        if self._correction is not None:
            self._correction.before_scan()
        estimate = self._localiser.localise(odometry, following)
        return replace(estimate, is_final=self._graph is None)

    def _build(self, odometry: ScanOdometry, estimate: ScanEstimate) -> ScanEstimate:
        """Deskew a scan, add the scan before to the map, and both to the graph."""
        started = time.perf_counter()
        thinned = self.map.thin(odometry.scan)
        estimate = replace(estimate, points=estimate.motion.compensate(thinned))
        deskew_ms, started = _ms_since(started), time.perf_counter()
        self._add_pending(estimate)
        self.map.add(thinned, estimate)
        if self._graph is not None:
            arrived = graph_scan(odometry, estimate)
            cells_m = estimate.cells_m if self._correction is not None and estimate.has_surfels else None
            drawing = self._graph_worker.submit(_give, self._graph, self.map, arrived, cells_m)
            if self._correction is not None:
                self._correction.add(drawing)
        return replace(estimate, stage_ms=estimate.stage_ms | {"deskew": deskew_ms, "map": _ms_since(started)})

    def _add_pending(self, following: ScanEstimate | None = None) -> None:
        added = self.map.add_pending(following)
        if added is not None and self._graph is not None:
            self._graph_worker.submit(self._graph.draw, *added)


def _give(graph: KeyframeGraph, built: MapBuilder, scan: GraphScan, cells_m: CellSizes | None) -> SurfelMap | None:
    """Give the graph a scan, and the map a submap that is complete; the local map where loop closures change it."""
    submap = graph.add(scan)
    if submap is not None and built.global_map is not None:  # of the keyframe before the new one
        built.global_map.add_means(submap, graph.scan_poses[graph.keyframes[-2].scan])
    return None if cells_m is None else graph.redrawn_local_map(cells_m)


def map_error(error: Exception) -> LidarSlamError:
    """The error for the user when the map cannot be built."""
    if isinstance(error, LidarSlamError):
        return error
    return LidarSlamError(f"building the map failed: {type(error).__name__}: {error}")


def _ms_since(started: float) -> float:
    return 1e3 * (time.perf_counter() - started)
