"""Which laser each point of a scan came from."""

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved, State
from mapping.loam.ring_elevations import BINS, ElevationTable, elevation_histogram, elevation_table
from mapping.loam.ring_storage import StorageOrder, storage_order

Rings = NDArray[np.integer]

# Fewer points decide nothing about a sensor.
_FEWEST_POINTS = 200
# Rings are cones about the axis of rotation: standard deviation of their elevation, radians. Lasers that sit beside
# the axis spread by half a degree, the lines of a sensor that does not repeat itself by five and more.
_MOST_SPREAD = np.deg2rad(1.5)
# Where the axis is not z, the directions of the rings must spread widely about it: variance of a share of a turn.
_LEAST_SWEEP = 0.1
_SAMPLES = 20_000
_MOST_RINGS = 512
# Share of points between the known lasers from which on the table is made anew.
_MOST_UNKNOWN = 0.005


class RingSource(Enum):
    """Where rings come from."""

    FIELD = "the recording's ring field"
    ELEVATION = "the elevations of the lasers"
    STORAGE = "the order of the points, ring after ring"
    NONE = "nowhere: the sensor has no rings"


class RingFinder:
    """Finds the rings of one recording's scans; how, it decides at the first scan and keeps to.

    Everything happens in the LiDAR's own frame, so the mounting does not matter; nor does motion, as long as the
    points are as measured, each in the frame of its own instant.
    """

    def __init__(self) -> None:
        self._source: RingSource | None = None
        self._histogram: NDArray[np.int64] | None = None
        self._table: ElevationTable | None = None
        self._order: StorageOrder | None = None

    @property
    def source(self) -> RingSource | None:
        """Where the rings come from; None before there was a scan to tell."""
        return self._source

    def state(self) -> State:
        """How rings are found, and what is known of the lasers."""
        return {
            "source": None if self._source is None else self._source.name,
            "histogram": self._histogram,
            "table": None if self._table is None else dict(vars(self._table)),
            "order": None if self._order is None else dict(vars(self._order)),
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        source = saved.optional_text("source")
        if source is not None and source not in RingSource.__members__:
            raise saved.refuse(f"rings come from {source}")
        self._source = None if source is None else RingSource[source]
        self._histogram = saved.optional_array("histogram", (BINS,), np.int64)
        self._table = saved.optional("table", ElevationTable.restored)
        self._order = saved.optional("order", StorageOrder.restored)

    def rings(self, points: FloatArray, rings: Rings | None) -> Rings | None:
        """The ring (N,) of each of the points (N, 3), -1 for strays; None for sensors without rings.

        Args:
            points: as measured, in the LiDAR frame.
            rings: the recording's ring field; used unless it tells something else than rings.
        """
        if len(points) < _FEWEST_POINTS and self._source is None:
            return rings
        if self._source is None:
            self._decide(points, rings)
        if self._source is RingSource.FIELD and rings is not None:
            return rings
        if self._table is not None:
            return self._by_elevation(points)
        return None if self._order is None or not len(points) else self._order.rings(points)

    def _decide(self, points: FloatArray, rings: Rings | None) -> None:
        if rings is not None and _are_rings(points, rings):
            self._source = RingSource.FIELD
            return
        self._histogram = elevation_histogram(points)
        self._table = elevation_table(self._histogram)
        if self._table is not None:
            self._source = RingSource.ELEVATION
            return
        order = storage_order(points)
        if order is not None and _are_rings(points, order.rings(points)):
            self._order, self._source = order, RingSource.STORAGE
            return
        self._source = RingSource.NONE

    def _by_elevation(self, points: FloatArray) -> Rings:
        assert self._table is not None
        assert self._histogram is not None
        rings = self._table.rings(points)
        # Lasers that met nothing in the first scan, such as those that look into the sky, show up later.
        if np.count_nonzero(rings < 0) > _MOST_UNKNOWN * len(rings):
            self._histogram += elevation_histogram(points)
            self._table = elevation_table(self._histogram) or self._table
            rings = self._table.rings(points)
        return rings


def _are_rings(points: FloatArray, rings: Rings) -> bool:
    """Whether points of a ring lie on a cone about one common axis, z or another."""
    step = max(1, len(points) // _SAMPLES)
    _, label = np.unique(rings[::step], return_inverse=True)
    directions = points[::step] / np.linalg.norm(points[::step], axis=1, keepdims=True)
    counts = np.bincount(label)
    if len(counts) > _MOST_RINGS:
        return False
    for axis in range(3):
        directions[:, axis] -= (np.bincount(label, directions[:, axis]) / counts)[label]
    covariance = directions.T @ directions / len(directions)
    if covariance[2, 2] < _MOST_SPREAD**2:
        return True
    spread = np.linalg.eigvalsh(covariance)
    return bool(spread[0] < _MOST_SPREAD**2 and spread[1] > _LEAST_SWEEP)
