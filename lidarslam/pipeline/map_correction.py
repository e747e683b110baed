"""Correction of the running local map: rebuilt after a loop closure, and replaced a fixed number of scans later.

The pose graph rebuilds it on its own thread; which scans are registered to which map does not depend on the threads.
"""

from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass

from lidarslam.core.state import State, Stateful
from lidarslam.mapping.pose_graph.submap_placement import SCANS_LATER
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.mapper import Mapper


@dataclass(frozen=True, eq=False)
class DrawnMap:
    """A local map rebuilt by the pose graph."""

    scan: int  # number of the scan before which it was rebuilt
    surfel_map: SurfelMap


class MapCorrection(Stateful):
    """Hands the maps that the pose graph rebuilds to the mapper, each a fixed number of scans later.

    Args:
        mapper: whose map is corrected.
    """

    _registered: int  # scans
    _followed: int  # scans that the graph was given
    _waiting: list[DrawnMap]

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
        while self._waiting and self._waiting[0].scan <= due:
            self._mapper.redraw(self._waiting.pop(0).surfel_map, SCANS_LATER)
        self._registered += 1

    def _collect(self, until: int) -> None:
        """Wait for the maps that were rebuilt before the scans up to this one."""
        while self._drawing and self._drawing[0][0] <= until:
            scan, drawing = self._drawing.popleft()
            drawn = drawing.result()
            if drawn is not None:
                self._waiting.append(DrawnMap(scan, drawn))
