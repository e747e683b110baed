"""The way of a scan: odometry, scan-to-map registration, global map, pose graph. No files, no printing, no window.

Four threads: odometry and thinning on the caller's, as one scan's motion is needed for the next; registration on a
second, one scan behind, because deskewing needs the motion after the stamp as well; the global map on a third, the pose
graph on a fourth.
"""

import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from typing import Protocol

from threadpoolctl import threadpool_limits

from lidarslam.core.errors import LidarSlamError
from lidarslam.core.scan import Scan
from lidarslam.core.state import Stateful
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.global_map.tile_store import TileStore
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.odometry.interface import Odometry
from lidarslam.pipeline import threads
from lidarslam.pipeline.estimates import Estimated, Localised, ScanResult
from lidarslam.pipeline.localisation import Localiser
from lidarslam.pipeline.map_building import MapBuilder
from lidarslam.pipeline.stages import Stages

# Scans that may wait for the map, which now and then takes as long as several scans.
_SCANS_BEHIND = 8


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
        store: of the global map, see `MapBuilder`.
    """

    _stages: Stages
    held: Estimated | None  # the last scan that was read: its result waits for the next one

    def __init__(
        self,
        odometry: Odometry,
        localiser: Localiser,
        config: GlobalMapConfig,
        graph: KeyframeGraph | None = None,
        checkpointer: Checkpointer | None = None,
        store: TileStore | None = None,
    ) -> None:
        self._stages = Stages(odometry, localiser, config, graph, store)
        self._checkpointer = checkpointer
        self.held = None
        self._error: LidarSlamError | None = None  # that ended the scans

    @property
    def map(self) -> MapBuilder:
        """The global map, and what is kept beside it."""
        return self._stages.map

    def run(self, scans: Iterable[Scan]) -> Generator[ScanResult, None, None]:
        """Process the scans in order; each result comes while later scans' odometry is at work.

        An error of the reader is raised after the results of the scans before it.
        """
        jobs: deque[Future[ScanResult]] = deque()
        # Matrices are small: BLAS threads would mostly wait, and take the cores from the other threads.
        with (
            closing(self._stages),
            threadpool_limits(1, "blas"),
            ThreadPoolExecutor(1, "map") as mapping,
            ThreadPoolExecutor(1, "registration") as registration,
        ):

            def submit(estimated: Estimated, following: Estimated | None) -> None:
                localised = registration.submit(self._stages.localise, estimated, following)
                self._stages.follow(estimated, localised.result)
                jobs.append(mapping.submit(self._build, estimated, localised))

            for number, estimated in enumerate(self._estimate(scans), start=1):
                if number % threads.EVERY_SCANS == 0:
                    threads.return_free_memory()
                previous, self.held = self.held, estimated
                if previous is None:
                    continue
                submit(previous, estimated)
                while jobs and (jobs[0].done() or len(jobs) > _SCANS_BEHIND):
                    yield jobs.popleft().result()
                if self._checkpointer is not None and self._checkpointer.is_due():
                    while jobs:
                        yield jobs.popleft().result()
                    self._stages.wait_for_graph()
                    self._checkpointer.save(self)
            if self.held is not None:
                submit(self.held, None)
            while jobs:
                yield jobs.popleft().result()
            self._stages.finish()
        if self._error is not None:
            raise self._error

    def _estimate(self, scans: Iterable[Scan]) -> Iterator[Estimated]:
        """The odometry of one scan after the other; an error ends them and is kept."""
        started = time.perf_counter()
        try:
            for scan in scans:
                yield self._stages.estimate(scan, 1e3 * (time.perf_counter() - started))
                started = time.perf_counter()
        except LidarSlamError as error:
            self._error = error

    def _build(self, estimated: Estimated, localised: Future[Localised]) -> ScanResult:
        return self._stages.build(estimated, localised.result())
