"""A thinned scan: points that are inserted into the map, and keypoints that are registered to it."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan, squared_ranges
from lidarslam.core.state import Shape, Stateful
from lidarslam.core.thinning import central_per_cell, evenly, one_per_cell
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep

CellSizes = tuple[float, ...]  # edges of a map's cells in each of its resolutions, the finest first

# Least number of points for the scale of a scene, and of keypoints and their correspondences for a pose.
MIN_POINTS = 60
# Cells per median range, and bounds of their size. Where walls are closer than a few metres, the cells are the
# smallest: steps and door frames are as large in a wider stairwell.
_CELLS_PER_RANGE = 30.0
# Fewer of them where rings are farther apart than 2.7 degrees, down to this number: of the cells of a narrow view, most
# would have points of a single ring, whose planes move with the sensor.
_FEWEST_CELLS, _CELLS_PER_SPACING = 19.0, 1.4
_LEAST_CELL_M, _MOST_CELL_M = 0.05, 1.0
# Resolutions of a map, in its finest cells.
_LEVELS = (1, 2, 4)
# Where rings are farther apart than this, there are larger cells, too: with walls close by, only floor and ceiling
# constrain the height, and they are seen from 4 m on, where smaller cells have points of a single ring of a sweep.
_SPARSE_RINGS_RAD, _LARGE_CELL_M = np.deg2rad(1.6), 0.4
MOST_LEVELS = len(_LEVELS) + 1
# Largest cells for planes through neighbours: in sparser maps, these are too far apart.
MOST_SPACING_M = 0.4
_CLOSE_M = 3.0
# The cell size changes when the smoothed median range has changed by this factor.
_RANGE_CHANGE = 2.0
_RANGE_SMOOTHING = 0.05
# Spacing of the points that go into the map, and of the keypoints, in cells.
MAP_SPACING, _KEYPOINT_SPACING = 0.5, 2.5
# Instants that a sweep is divided into, of this many points at least; and the share of the view's height that those of
# one instant span if they form a column. It is 0.6 to 0.9 of spinning sensors, 0.07 of a Mid-360.
_INSTANTS, _LEAST_OF_INSTANT = 1000, 16
_COLUMN_SHARE = 0.3
# Rows of elevations in which rings show, and the fewest points of a ring.
_ROW_RAD, _LEAST_OF_RING = np.deg2rad(0.25), 5


@dataclass(frozen=True, eq=False)
class SampledScan:
    """A thinned scan, as measured."""

    stamp: float  # of the scan, seconds
    cells_m: CellSizes  # of the map for the scene
    range_m: float  # smoothed median range of the scene
    sweep: Sweep  # N points for the map
    # (N,) their angles above the sensor's equator, radians; all zero where points do not lie in rings
    elevations: Annotated[FloatArray, Shape(None)]
    keypoints: Sweep  # the subset that is registered

    def __len__(self) -> int:
        return len(self.sweep)

    @property
    def cell_m(self) -> float:
        """Size of the finest cells."""
        return self.cells_m[0]

    @property
    def is_sparse(self) -> bool:
        """Whether there are too few keypoints for a registration: a covered sensor, or open country."""
        return len(self.keypoints) < MIN_POINTS

    @cached_property
    def has_rings(self) -> bool:
        """Whether points lie in rings, as those of a spinning sensor."""
        return bool(self.elevations.any())

    @cached_property
    def seen_until_s(self) -> float:
        """Time from the stamp to the last point; 0 when the scan is compensated already."""
        times = self.sweep.times
        return 0.0 if times is None or not len(times) else max(0.0, float(times.max()))

    @cached_property
    def seen_from_s(self) -> float:
        """Time from the first point to the stamp; 0 when the scan is compensated already."""
        times = self.sweep.times
        return 0.0 if times is None or not len(times) else max(0.0, -float(times.min()))

    def evened(self, turn_acceleration: FloatArray) -> "SampledScan":
        """The scan as if the sensor had turned at its mean rate during the whole sweep; see `even`."""
        middle_s = 0.5 * (self.seen_until_s - self.seen_from_s)
        sweep, keypoints = (part.evened(turn_acceleration, middle_s) for part in (self.sweep, self.keypoints))
        return replace(self, sweep=sweep, keypoints=keypoints)

    def is_followed_by(self, following: "SampledScan") -> bool:
        """Whether another sweep begins within a sweep's duration after this one's end."""
        gap_s = following.stamp - following.seen_from_s - self.stamp - self.seen_until_s
        return gap_s < self.seen_from_s + self.seen_until_s


class Sampler(Stateful):
    """Thins scans by the scale of the scene; for surfels, to a point in each half of a cell."""

    _range_m: float  # smoothed median range; 0 before the first scan with points
    _cell_range_m: float  # median range of the present cell size
    _has_rings: bool | None  # of the first scan of enough points; None before
    _spacing_rad: float  # mean angle between the rings of that scan

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self._range_m, self._cell_range_m, self._has_rings, self._spacing_rad = 0.0, 0.0, None, 0.0

    def sample(self, scan: Scan) -> SampledScan:
        """Choose the points of a scan."""
        squared = squared_ranges(scan.points)
        if self._has_rings is None and len(scan) >= _INSTANTS:
            self._has_rings = has_rings(scan)
            self._spacing_rad = ring_spacing(scan) if self._has_rings else 0.0
        cell_m = self._cell_m(squared)
        near, far = self._config.min_range_m**2, self._config.max_range_m**2
        kept, kinds = self._choose(scan, cell_m)
        inside = squared.take(kept)
        is_within = (inside > near) & (inside < far)
        kept, kinds = kept[is_within], None if kinds is None else kinds[is_within]
        points = scan.points.take(kept, axis=0)
        sweep = Sweep(points, None if scan.time_offsets is None else scan.time_offsets.take(kept), kinds)
        # A stroke of points that do not lie in rings spans a plane of its rays as a ring does, with any spread of
        # elevations; without one, no plane seen at a grazing angle counts.
        rings = 0.0 if self._has_rings is False else 1.0
        elevations = rings * np.arcsin(points[:, 2] / np.sqrt(squared.take(kept)))
        keypoints = sweep.take(self._keypoints(sweep, cell_m))
        cells_m = sizes_of_cells(cell_m, are_rings_sparse=self._spacing_rad > _SPARSE_RINGS_RAD)
        return SampledScan(scan.stamp, cells_m, self._range_m, sweep, elevations, keypoints)

    def _cell_m(self, squared: FloatArray) -> float:
        """The size of cells for the latest squared ranges (N,), with hysteresis."""
        # Fewer points are a covered sensor, not another scene.
        if np.count_nonzero(squared > self._config.min_range_m**2) >= MIN_POINTS:
            median_m = float(np.sqrt(np.median(squared[:: max(1, len(squared) // 5000)])))
            new = self._range_m == 0.0
            self._range_m = median_m if new else self._range_m + _RANGE_SMOOTHING * (median_m - self._range_m)
        if self._config.cell_m is not None:
            return self._config.cell_m
        low_m, high_m = self._cell_range_m / _RANGE_CHANGE, self._cell_range_m * _RANGE_CHANGE
        if self._range_m > 0.0 and not low_m <= self._range_m <= high_m:
            self._cell_range_m = self._range_m
        if self._cell_range_m < _CLOSE_M:
            return _LEAST_CELL_M
        per_range = np.clip(_CELLS_PER_SPACING / max(self._spacing_rad, 1e-9), _FEWEST_CELLS, _CELLS_PER_RANGE)
        return float(np.clip(self._cell_range_m / per_range, _LEAST_CELL_M, self._most_cell_m))

    @property
    def _most_cell_m(self) -> float:
        return MOST_SPACING_M if self._has_rings is False else _MOST_CELL_M

    def _choose(self, scan: Scan, cell_m: float) -> tuple[NDArray[np.intp], NDArray[np.int8] | None]:
        """Indices (N,) of the points for the map, and their kinds (N,), if there are several."""
        return one_per_cell(scan.points, MAP_SPACING * cell_m), None

    def _keypoints(self, sweep: Sweep, cell_m: float) -> NDArray[np.intp]:
        """Indices (K,) of the points that are registered."""
        # The last points of the sweep would lie on the same side of every tree, and a sensor at rest would rotate.
        return evenly(central_per_cell(sweep.points, _KEYPOINT_SPACING * cell_m), self._config.keypoints)


def sizes_of_cells(finest_m: float, are_rings_sparse: bool = False) -> CellSizes:
    """The sizes of the cells of a map by the finest: three, or four for sparse rings where walls are close."""
    sizes_m = tuple(finest_m * level for level in _LEVELS)
    return (*sizes_m, _LARGE_CELL_M) if are_rings_sparse and sizes_m[-1] < _LARGE_CELL_M else sizes_m


def has_rings(scan: Scan) -> bool:
    """Whether lasers keep their elevations, as those of a spinning sensor; true if unknown.

    The lasers of a rosette or a raster draw strokes, numbered or not. Where they are not numbered, the points of one
    instant form a column of a spinning sensor's view, and are near one another in a stroke.
    """
    elevations = _elevations(scan)
    least = _COLUMN_SHARE * float(np.subtract(*np.quantile(elevations, (0.95, 0.05))))
    if scan.rings is not None:
        order = np.argsort(scan.rings, kind="stable")
        lasers = np.split(elevations.take(order), np.flatnonzero(np.diff(scan.rings.take(order))) + 1)
        return bool(np.median([np.subtract(*np.quantile(laser, (0.9, 0.1))) for laser in lasers]) < least)
    if scan.time_offsets is None:
        return True
    elevations = elevations.take(np.argsort(scan.time_offsets, kind="stable"))
    size = max(_LEAST_OF_INSTANT, len(elevations) // _INSTANTS)
    instants = elevations[: len(elevations) // size * size].reshape(-1, size)
    return bool(np.median(np.subtract(*np.quantile(instants, (0.9, 0.1), axis=1))) > least)


def ring_spacing(scan: Scan) -> float:
    """Mean angle between the rings of a spinning sensor, radians; 0 of a single ring, and where most have no gaps."""
    rows = np.flatnonzero(
        np.bincount(((_elevations(scan) + 0.5 * np.pi) / _ROW_RAD).astype(np.int64)) >= _LEAST_OF_RING
    )
    rings = 1 + np.count_nonzero(np.diff(rows) > 1)
    if rings == 1 or 2 * len(rows) > rows[-1] - rows[0]:
        return 0.0
    return float(_ROW_RAD * (rows[-1] - rows[0]) / (rings - 1))


def _elevations(scan: Scan) -> FloatArray:
    """Angles (N,) of the points above the sensor's equator, radians."""
    return np.arcsin(scan.points[:, 2] / np.maximum(np.sqrt(squared_ranges(scan.points)), 1e-9))
