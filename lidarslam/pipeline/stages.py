"""The stages of a scan: odometry, pose, map, pose graph.

Scans pass through `estimate`, `localise` and `build` in this order, one after the other. Each of the three may be
called on a thread of its own; the pose graph is built on another.
"""

import time
from collections.abc import Callable

from lidarslam.core.scan import Scan
from lidarslam.core.state import Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.global_map.tile_store import TileStore
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.mapping.pose_graph.keyframes import GraphScan
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.odometry.interface import Odometry
from lidarslam.pipeline.estimates import Estimated, Localised, ScanResult, graph_scan
from lidarslam.pipeline.localisation import Localiser
from lidarslam.pipeline.map_building import MapBuilder
from lidarslam.pipeline.map_correction import MapCorrection
from lidarslam.pipeline.odometry_gate import OdometryGate
from lidarslam.pipeline.threads import BackgroundWorker

# Calls that may wait for the graph, which takes as long for a loop closure as for all scans up to the next keyframe.
_GRAPH_CALLS_BEHIND = 64


class Stages(Stateful):
    """Carries what each stage keeps from scan to scan; the state is without that of odometry and graph.

    Args:
        odometry, localiser: estimate the poses.
        config: of the global map.
        graph: built along the way; complete after `finish`.
        store: of the global map, see `MapBuilder`.
    """

    map: MapBuilder
    _localiser: Localiser
    _correction: MapCorrection | None
    _measured_stamp: float | None  # of the last scan, unless its motion was only predicted

    def __init__(
        self,
        odometry: Odometry,
        localiser: Localiser,
        config: GlobalMapConfig,
        graph: KeyframeGraph | None = None,
        store: TileStore | None = None,
    ) -> None:
        self._odometry = odometry
        self._localiser = localiser
        self._graph = graph
        self._graph_worker = BackgroundWorker("graph", _GRAPH_CALLS_BEHIND)
        mapper = localiser.mapper
        self._correction = None if graph is None or mapper is None or not mapper.kept_scans else MapCorrection(mapper)
        self._measured_stamp = None
        self.map = MapBuilder(config, store)

    def estimate(self, scan: Scan, read_ms: float = 0.0) -> Estimated:
        """The odometry of the next scan, which took so long to read; thinned for registration, which is busier."""
        started = time.perf_counter()
        sampled = self._localiser.sample(scan)
        thinned = time.perf_counter()
        stage_ms = {"read": read_ms, "refine": _ms(started, thinned)}
        if isinstance(self._odometry, OdometryGate):
            self._odometry.wait()
        started = time.perf_counter()
        motion = self._odometry.estimate(scan)
        stage_ms["odometry"] = _ms(started, time.perf_counter())
        measured, previous = motion.failure is None, self._measured_stamp
        interval_s = scan.stamp - previous if measured and previous is not None else None
        self._measured_stamp = scan.stamp if measured or not motion.is_asked else None
        return Estimated(scan, motion, interval_s, stage_ms, sampled)

    def follow(self, estimated: Estimated, localised: Callable[[], Localised]) -> None:
        """Let the odometry know the pose of the next scan, which is computed on another thread."""
        if isinstance(self._odometry, OdometryGate):
            self._odometry.follow(estimated.scan.stamp, localised)

    def localise(self, estimated: Estimated, following: Estimated | None = None) -> Localised:
        """The pose of a scan; the odometry of the following one gives the motion after the stamp, where it is known."""
        if self._correction is not None:
            self._correction.before_scan()
        return self._localiser.localise(estimated, following)

    def build(self, estimated: Estimated, localised: Localised) -> ScanResult:
        """Deskew a scan, add the scan before to the map, and both to the graph."""
        scan, started = estimated.scan, time.perf_counter()
        thinned = self.map.thin(scan)
        points = localised.motion.compensate(thinned)
        deskewed = time.perf_counter()
        self.add_pending(next_is_lost=localised.status is Status.LOST)
        self.map.add(thinned, points, localised)
        if self._graph is not None:
            arrived = graph_scan(estimated, localised, points)
            cell_m = None if self._correction is None else localised.cell_m
            drawing = self._graph_worker.submit(_follow, self._graph, arrived, cell_m)
            if self._correction is not None:
                self._correction.add(drawing)
        stage_ms = {"deskew": _ms(started, deskewed), "map": _ms(deskewed, time.perf_counter())}
        return ScanResult(
            **vars(localised) | {"stage_ms": estimated.stage_ms | localised.stage_ms | stage_ms},
            stamp=scan.stamp,
            points=points,
            points_read=len(scan),
            points_dropped=scan.dropped,
            is_odometry_asked=estimated.motion.is_asked,
        )

    def add_pending(self, next_is_lost: bool = False) -> None:
        """Add the last scan to the map, unless it is in there."""
        added = self.map.add_pending(next_is_lost)
        if added is not None and self._graph is not None:
            self._graph_worker.submit(self._graph.draw, *added)

    def finish(self) -> None:
        """Add the last scan to the map, and look at the last pair of scans; more may follow."""
        self.add_pending()
        self.map.slides.finish()

    def wait_for_graph(self) -> None:
        """Wait until the graph has taken all scans, and raise its error."""
        self._graph_worker.wait()

    def close(self) -> None:
        """Wait for the graph, and end its thread."""
        self._graph_worker.close()


def _follow(graph: KeyframeGraph, scan: GraphScan, cell_m: float | None) -> SurfelMap | None:
    """Give the graph a scan; the local map of surfels, where there is one and loop closures change it."""
    graph.add(scan)
    return None if cell_m is None else graph.redrawn_local_map(cell_m)


def _ms(start: float, end: float) -> float:
    return 1e3 * (end - start)
