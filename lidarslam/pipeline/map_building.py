"""Building the global map, one scan late, once the motion of the scan is confirmed; correcting the local map."""

import logging
from collections import deque
from concurrent.futures import Future
from dataclasses import replace

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import PointAttributes, Scan, squared_ranges
from lidarslam.core.state import State, Stateful
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.consistency import ConsistencyCheck
from lidarslam.mapping.global_map.global_map import GlobalMap, voxel_size_for
from lidarslam.mapping.global_map.moved_points import Views
from lidarslam.mapping.global_map.voxels import TileStore
from lidarslam.mapping.pose_graph.submap_placement import SCANS_LATER
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.pipeline.estimates import ScanEstimate, SweepMotion

logger = logging.getLogger(__name__)


class MapBuilder(Stateful):
    """Adds scans to the global map, and keeps data for the detection of moving objects and slips of registration.

    With a pose graph, the submaps of its keyframes are added instead. The store has the tiles of the map that do not
    fit into memory; without one, a temporary file has them.
    """

    # of the map; derived from the first scan with points unless it is configured, None until then
    voxel_size_m: float | None
    global_map: GlobalMap | None  # None until a scan was added
    views: Views  # range images of some scans, for the removal of moving objects
    slides: ConsistencyCheck  # pairs of scans, for the detection of slips
    # pending: its points within the map's range, one a voxel, as read; and its pose
    _pending: tuple[Scan, ScanEstimate] | None
    _scans: int

    def __init__(self, config: GlobalMapConfig, store: TileStore | None = None, takes_submaps: bool = False) -> None:
        self._config = config
        self._store, self._takes_submaps = store, takes_submaps
        self._pending = None
        self._scans = 0
        self.voxel_size_m = config.voxel_size_m
        self.global_map = None
        self.views = Views()
        self.slides = ConsistencyCheck()

    def restore(self, saved: State) -> None:
        """Resume from a state; InputError where it is damaged, or the file of the tiles is."""
        self.global_map = self._new_map(1.0) if saved["global_map"] is not None else None
        super().restore(saved)

    def _new_map(self, voxel_size_m: float) -> GlobalMap:
        return GlobalMap(voxel_size_m, self._config.most_points, self._store)

    def thin(self, scan: Scan) -> Scan:
        """The points within the map's range, one a voxel of the map: more would not change it."""
        if not len(scan):
            return scan
        if self.voxel_size_m is None:
            self.voxel_size_m = voxel_size_for(scan.points)
            logger.info(
                "voxels of the map: %.3g m, 1/50 of the first scan's median range, from 5 to 25 cm", self.voxel_size_m
            )
        kept = one_per_cell(scan.points, self.voxel_size_m)
        squared = squared_ranges(scan.points.take(kept, axis=0))
        is_within = (squared >= self._config.min_range_m**2) & (squared <= self._config.max_range_m**2)
        return scan.select(kept[is_within])

    def add(self, thinned: Scan, estimate: ScanEstimate) -> None:
        """Take the next scan; it enters the map with `add_pending`, if its pose is good enough."""
        self._pending = (thinned, estimate) if estimate.belongs_in_map else None
        self._scans += 1

    def add_pending(
        self, following: ScanEstimate | None
    ) -> tuple[FloatArray, FloatArray, float, PointAttributes] | None:
        """Add the scan before; its points (N, 3), pose, voxel size and attributes as added, None where there is none.

        It is deskewed again where the following scan shows another motion: where tracking was lost there, the motion
        after its stamp is unknown, and only that before it counts; the first scan's is known by the second.
        """
        pending, self._pending = self._pending, None
        if pending is None or self.voxel_size_m is None:  # no scan had a point so far
            return None
        thinned, estimate = pending
        points = estimate.points
        if following is not None and following.status is Status.LOST:
            points = replace(estimate.motion, after=None).compensate(thinned)
        elif following is not None and following.first_velocity is not None:
            points = SweepMotion(following.first_velocity, None).compensate(thinned)
        if self.global_map is None:
            self.global_map = self._new_map(self.voxel_size_m)
        number, attributes = self._scans - 1, thinned.attributes(self._config.fields)
        if not self._takes_submaps:
            self.global_map.add(points, estimate.T_world_lidar, attributes)
        self.slides.add(points, number, estimate.T_world_lidar)
        if self._config.leave_out_moved:
            self.views.add(points, number)
        return points, estimate.T_world_lidar, self.voxel_size_m, attributes


class MapCorrection(Stateful):
    """Hands local maps that the pose graph rebuilds after loop closures to the mapper, a fixed number of scans later.

    The pose graph rebuilds them on its own thread; which scans are registered to which map does not depend on threads.
    """

    _registered: int  # scans
    _followed: int  # scans that the graph was given
    _waiting: list[tuple[int, SurfelMap]]  # rebuilt maps, each with the number of the scan before which it was rebuilt

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._registered = self._followed = 0
        self._waiting = []
        self._drawing: deque[tuple[int, Future[SurfelMap | None]]] = deque()

    def state(self) -> State:
        """With the pending maps; the graph must be idle."""
        self._collect(self._followed)
        return super().state()

    def add(self, drawing: Future[SurfelMap | None]) -> None:
        """Take the graph's result for the next scan: a map without it, or None."""
        self._drawing.append((self._followed, drawing))
        self._followed += 1

    def before_scan(self) -> None:
        """Replace the local map before the next scan, where that is due; an error of the graph is raised."""
        due = self._registered - SCANS_LATER
        assert due < self._followed, "more scans wait for the graph than it is given"
        self._collect(due)
        while self._waiting and self._waiting[0][0] <= due:
            self._mapper.redraw(self._waiting.pop(0)[1], SCANS_LATER)
        self._registered += 1

    def _collect(self, until: int) -> None:
        """Wait for the maps that were rebuilt before the scans up to this one."""
        while self._drawing and self._drawing[0][0] <= until:
            scan, drawing = self._drawing.popleft()
            drawn = drawing.result()
            if drawn is not None:
                self._waiting.append((scan, drawn))
