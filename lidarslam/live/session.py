"""SLAM on scans as they come: the pose at once, the map behind it."""

import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from lidarslam.config.settings import Config
from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import look_at
from lidarslam.mapping.config import MapFormat
from lidarslam.mapping.global_map.tile_store import TileStore
from lidarslam.odometry.interface import Odometry
from lidarslam.pipeline.compile_ahead import made_up_scans
from lidarslam.pipeline.estimates import Estimated, Localised
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.stages import Stages
from lidarslam.pipeline.threads import BackgroundWorker
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.tracking import Tracked
from lidarslam.viewer.viewer import RerunMode, Viewer

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph
    from lidarslam.pipeline.imu_stream import ImuStream

# Scans whose points may wait for the map, to bound the memory they hold.
_SCANS_BEHIND = 8


class LiveSession:
    """Carries scans through the stages of the pipeline; a context manager that ends its threads.

    Args:
        config: of the computation.
        odometry, graph: new; closed by the caller.
        log, faults: of the scans.
        viewer: shown every scan, on the thread of the map.
        store: of the global map, see `lidarslam.pipeline.map_building.MapBuilder`.
        imu: the samples that come beside the scans.
    """

    def __init__(
        self,
        config: Config,
        odometry: Odometry,
        graph: "SlamGraph | None",
        log: ScanLog,
        faults: Faults,
        viewer: Viewer,
        store: TileStore | None = None,
        imu: "ImuStream | None" = None,
    ) -> None:
        self._imu = imu
        self._stages = Stages(odometry, make_localiser(config, imu), config.global_map, graph, store)
        self._builder = BackgroundWorker("map", _SCANS_BEHIND)
        self._log, self._faults, self._viewer = log, faults, viewer

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._builder.close()
        self._stages.close()

    def register(self, scan: Scan, started: float) -> Localised:
        """The pose of the next scan, whose message was taken up at this reading of `time.perf_counter`."""
        scan = look_at(scan, self._faults)
        if self._imu is not None:
            scan = self._imu.take_up(scan)
        estimated = self._stages.estimate(scan, 1e3 * (time.perf_counter() - started))
        localised = self._stages.localise(estimated)
        self._stages.follow(estimated, lambda: localised)
        self._builder.submit(self._build, estimated, localised, 1e3 * (time.perf_counter() - started))
        return localised

    def finish(self) -> Tracked:
        """All of it, once map and graph have every scan."""
        self._builder.wait()
        self._stages.finish()
        self._stages.wait_for_graph()
        built = self._stages.map
        count = len(self._log) + self._faults.left_out
        return Tracked(
            None, None, self._log, count, self._faults, built.global_map, built.views, built.slides.tests, None
        )

    def _build(self, estimated: Estimated, localised: Localised, total_ms: float) -> None:
        """Map, log and viewer."""
        result = self._stages.build(estimated, localised)
        self._log.add(result, total_ms)
        index, global_map = len(self._log) - 1, self._stages.map.global_map
        self._viewer.show_scan(index, result)
        if global_map is not None and self._viewer.wants_map(index):
            self._viewer.show_map(global_map.points())


def warm_up(config: Config, odometry: Odometry) -> None:
    """Carry made-up scans through the stages: the first calls load compiled loops, for seconds on a busy machine.

    Args:
        config: of the computation.
        odometry: not used again.
    """
    stages = Stages(odometry, make_localiser(config), config.global_map)
    with closing(stages):
        for scan in made_up_scans():
            estimated = stages.estimate(scan)
            stages.build(estimated, stages.localise(estimated))


@dataclass(frozen=True)
class LiveRequest:
    """Topic, configuration and destination of a live run."""

    out: Path  # the run directory
    config: Config  # of the computation
    topic: str | None = None  # of the clouds; None: the only one there is
    domain: int = 0  # of DDS
    # duration_s, scans: when it ends by itself, counted from the first scan; while none comes, from the beginning
    duration_s: float | None = None
    scans: int | None = None
    queue: int = 20  # scans that may wait for registration
    odom_frame: str = "odom"  # the fixed frame of the published poses
    base_frame: str | None = None  # the frame that moves, connected to the LiDAR's by /tf_static; None: the LiDAR's own
    publish_tf: bool = True  # whether the pose is published on /tf as well
    rerun: RerunMode = "off"
    map_formats: tuple[MapFormat, ...] = ()  # what the map is written as beside .ply
    overwrite: bool = False  # whether an earlier run in `out` is replaced
    report: bool = False  # whether a page and pictures are drawn, once all else is written
