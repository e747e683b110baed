"""Scan-to-map mapping by continuous-time registration to surfels or LOAM's features, with any odometry or none.

Each scan is predicted from the last motion and the odometry, registered to the local map, judged by its fit, and
inserted into the map. `mapping.tracking` has the cases in which the registration fails.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, displacement_m, inverse, log
from lidarslam.core.scan import Scan
from lidarslam.core.state import TRANSFORM, Shape, Stateful
from lidarslam.core.tracking import AXES, Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.loam.feature_map import FeatureMap
from lidarslam.mapping.loam.features import FeatureSampler
from lidarslam.mapping.motion.prediction import (
    LEAST_SIGMA,
    LOST_MOTION,
    UNKNOWN_VELOCITY,
    MotionState,
    Prediction,
    Prior,
    velocity_error,
)
from lidarslam.mapping.registration.local_map import LocalMap
from lidarslam.mapping.registration.sampled_scan import SampledScan, Sampler
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.surfels.voxel_hash import beyond_reach
from lidarslam.mapping.tracking.budget import Budget
from lidarslam.mapping.tracking.fit import Fit
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.tracker import Tracker

logger = logging.getLogger(__name__)

# Times that the first sweep is inserted again, with the motion that the second one showed, and the least share of the
# quality that this keeps: the velocity within a sparse sweep may be far off.
_REDRAWS, _LEAST_KEPT = 2, 0.5
# Where the median residual exceeds the noise of ranges, the ground is rough, and rings of a sensor at rest hit the
# same spots again, so that planes would seem certain: of scans within so many cells, the first few are inserted.
_ROUGH_M, _STANDING_CELLS, _MOST_REPEATED = 0.02, 0.5, 3
# A map of planes through neighbouring voxels may begin with several sweeps at their predictions, for so many seconds:
# too few points of a single one are on a common plane. Covariance (12, 12) of their states: the map is where they are,
# and the sensor moves evenly.
_GROWING_S = 2.0
_EVEN_MOTION = np.diag(np.concatenate([LEAST_SIGMA, [np.deg2rad(20.0)] * 3, [0.5] * 3]) ** 2)
_GROWING = "inserted at its prediction: the map has too few sweeps for a registration"
_AMBIGUOUS = "ambiguous: it may fit elsewhere in the map as well"
_SEARCHING = "the search for its place goes on with the next scan"
_IN_VAIN = "the search for its place found none"


@dataclass(frozen=True, eq=False)
class Insertion:
    """A scan as it was inserted into the local map."""

    number: int  # of the scan
    points: Annotated[FloatArray, Shape(None, 3)]  # in the world
    elevations: Annotated[FloatArray, Shape(None)]  # their angles above the sensor's equator, radians
    sensor: Annotated[FloatArray, Shape(3)]  # position in the world


class Mapper(Stateful):
    """Holds the local map and the state of the last scan; the latest `kept_scans` are kept for `redraw`.

    The clock, in seconds, is for the budget of a scan.
    """

    _sampler: Sampler
    _tracker: Tracker
    _map: LocalMap | None
    _last: MotionState | None
    _first: SampledScan | None
    _scans: int
    _map_since: int  # number of scans before the present map began, or came back from the archive
    _place: Annotated[FloatArray, TRANSFORM] | None  # of the latest scan inserted from another pose than the one before
    _repeated: int  # scans registered there since
    _growing_since: float | None  # stamp of the map's first scan, if that may be too thin for a registration
    _recent: list[Insertion]

    def __init__(
        self, config: MappingConfig, clock: Callable[[], float] = time.perf_counter, kept_scans: int = 0
    ) -> None:
        self._config = config
        self.kept_scans = kept_scans
        self._scans, self._map_since, self._recent = 0, 0, []
        self._budget = Budget(config.budget_ms, clock)
        self._sampler = FeatureSampler(config) if config.method == "loam" else Sampler(config)
        self._tracker = Tracker(config, self._budget)
        self._map = None
        self._last = None
        self._first = None  # while it alone is the map, drawn with a guessed motion
        self._growing_since = None
        self._place, self._repeated = None, 0

    @property
    def local_map(self) -> LocalMap | None:
        """The map that scans are registered to; None before the first."""
        return self._map

    def sample(self, scan: Scan) -> SampledScan:
        """Thin the next scan; on any thread, while `process` works on an earlier one."""
        return self._sampler.sample(scan)

    def process(self, scan: SampledScan, prior: Prior) -> MappedScan:
        """Register the next scan to the map, and insert it."""
        self._budget.begin(np.inf if self._last is None else scan.stamp - self._last.stamp)
        self._scans += 1
        velocity = np.zeros(6) if prior.velocity is None else prior.velocity
        last = self._last or MotionState(scan.stamp, np.eye(4), velocity, UNKNOWN_VELOCITY)
        first, self._first = self._first, None
        if self._map is None:
            mapped = self._begin(scan, prior, last)
        elif first is not None and (prior.velocity is None or first.is_followed_by(scan)):
            mapped = self._track_second(scan, prior, last, first, self._map)
        else:
            mapped = self._track(scan, prior, last, self._map)
        self._last = mapped.state
        cells_m = None if self._map is None else self._map.cells_m
        return replace(mapped, cells_m=cells_m, has_surfels=isinstance(self._map, SurfelMap))

    def _track(self, scan: SampledScan, prior: Prior, last: MotionState, local_map: LocalMap) -> MappedScan:
        """Predict, register, judge, insert."""
        self._map = local_map = local_map.resized(scan.cells_m)
        # Predict the pose and the velocity from the last motion and the odometry.
        prediction = self._tracker.tracking.predict(scan, prior, last, self._config)
        if scan.is_sparse:
            return self._lose(scan, prediction, local_map, None, _sparse_message(scan))
        # A velocity extrapolated over a gap in the stamps may lead anywhere.
        T_world_near = (last if prior.T_prev_curr is None else prediction).T_world_lidar
        beyond = beyond_reach(T_world_near[:3, 3], self._config.max_range_m, local_map.cell_m)
        if beyond is not None:
            return self._lose(scan, prediction, local_map, None, beyond)
        # Register the keypoints to the surfels; where that fails, relocalise, or let a thin map grow.
        is_growing = self._growing_since is not None and scan.stamp - self._growing_since < _GROWING_S
        has_grown = is_growing and local_map.scans > 1
        register = self._tracker.register_near if has_grown else self._tracker.register
        attempt = register(scan, prior, prediction, last, local_map)
        if is_growing and not attempt.confirms_map(has_grown, scan.has_rings):
            return self._grow(scan, prediction, local_map, attempt.fit)
        if attempt.status is Status.LOST or attempt.registration is None:
            reason = attempt.fit.explain(self._config.tracking) or _AMBIGUOUS
            reason = _SEARCHING if self._tracker.is_searching else _IN_VAIN if self._tracker.in_vain else reason
            return self._lose(scan, attempt.prediction, local_map, attempt.fit, reason)
        # Judge the pose by its fit, and adapt the noise of process and odometry.
        mapped = self._tracker.accept(attempt, scan, prior, prediction, last)
        # Insert the scan into the map that it was registered to, which may be an archived one.
        if attempt.local_map is not local_map:
            self._map_since = self._scans
        self._map = attempt.local_map
        if mapped.added:
            if not has_grown:
                self._growing_since = None
            if self._adds_views(scan, mapped):
                self._insert(scan, mapped.state, self._map)
        return mapped

    def _adds_views(self, scan: SampledScan, mapped: MappedScan) -> bool:
        """Whether a scan sees other spots of rough ground than the latest ones, or is one of the first few."""
        T_world_lidar, fit = mapped.state.T_world_lidar, mapped.fit
        is_rough = scan.has_rings and fit is not None and (fit.residual_m or 0.0) > _ROUGH_M
        if self._place is not None and is_rough:
            moved_m = displacement_m(log(inverse(self._place) @ T_world_lidar), scan.range_m)
            if moved_m < _STANDING_CELLS * scan.cell_m:
                self._repeated += 1
                return self._repeated < _MOST_REPEATED
        self._place, self._repeated = T_world_lidar, 0
        return True

    def redraw(self, drawn: SurfelMap, scans: int) -> bool:
        """Replace the local map of surfels by a rebuilt one without the latest `scans` scans, which are then inserted.

        False where another map has begun since, or a search of the map is in progress: the map stays.
        """
        if self._map is None or self._tracker.is_searching or self._map_since > self._scans - scans:
            return False
        missing = [insertion for insertion in self._recent if insertion.number > self._scans - scans]
        drawn.scans = self._map.scans - len(missing)
        for insertion in missing:
            drawn.insert(insertion.points, insertion.elevations, insertion.sensor)
        self._map = drawn
        return True

    def _begin(self, scan: SampledScan, prior: Prior, last: MotionState) -> MappedScan:
        """The first scan makes the map."""
        prediction = self._tracker.tracking.predict(scan, prior, last, self._config)
        if scan.is_sparse:
            return MappedScan.lost(prediction, _sparse_message(scan))
        T_world_lidar, velocity = prediction.T_world_lidar, prediction.velocity
        state = MotionState(scan.stamp, T_world_lidar, velocity, last.covariance, scan.seen_until_s)
        self._map = self._new_map(scan, state)
        self._first = scan if scan.sweep.times is not None and self._config.continuous_time else None
        return MappedScan(state, T_world_lidar, False, Status.OK, added=True)

    def _track_second(
        self, scan: SampledScan, prior: Prior, last: MotionState, first: SampledScan, local_map: LocalMap
    ) -> MappedScan:
        """Register the second scan; where the first was moving, insert that again, and repeat.

        Two sweeps that are bent equally fit one another and hide a common motion; that between their poses shows it.
        """
        before = self._tracker.tracking
        mapped = self._track(scan, prior, last, local_map)
        for _ in range(_REDRAWS if scan.stamp > last.stamp else 0):
            motion = inverse(last.T_world_lidar) @ mapped.state.T_world_lidar
            if not mapped.registered or displacement_m(log(motion), scan.range_m) < local_map.cell_m:
                break
            share = min(1.0, last.seen_until_s / (scan.stamp - last.stamp))
            moving = replace(last, velocity=last.velocity + velocity_error(last, mapped.state, share))
            self._tracker.rewind(before)
            again = self._track(scan, prior, moving, self._new_map(first, moving))
            if not again.registered or again.quality < _LEAST_KEPT * mapped.quality:
                self._tracker.rewind(before)
                mapped = self._track(scan, prior, last, self._new_map(first, last))
                break
            last, mapped = moving, again
        return replace(mapped, first_velocity=last.velocity)

    def _lose(
        self, scan: SampledScan, prediction: Prediction, local_map: LocalMap, fit: Fit | None, reason: str
    ) -> MappedScan:
        """A scan without a registration stays at its prediction, out of the map; after many a new map begins."""
        lost = self._tracker.lose(prediction, reason, fit)
        if fit is not None and self._tracker.gives_up:
            self._tracker.archive(local_map)
            moving = MotionState(scan.stamp, prediction.T_world_lidar, prediction.velocity, LOST_MOTION)
            self._map = self._new_map(scan, moving)
            lost = replace(lost, message=f"{reason}; a new map begins here")
        return lost

    def _grow(self, scan: SampledScan, prediction: Prediction, local_map: LocalMap, fit: Fit) -> MappedScan:
        """A scan that the map is too thin for is inserted at its prediction."""
        T_world_lidar, velocity = prediction.T_world_lidar, prediction.velocity
        state = MotionState(scan.stamp, T_world_lidar, velocity, _EVEN_MOTION, scan.seen_until_s)
        self._insert(scan, state, local_map)
        return MappedScan(state, T_world_lidar, False, Status.DEGRADED, _GROWING, fit, AXES, added=True)

    def _new_map(self, scan: SampledScan, state: MotionState) -> LocalMap:
        """A map of one scan."""
        # Of sparse strokes, few cells have more than one; a plane through neighbouring voxels spans several.
        is_surfels = self._config.method == "surfels" and scan.has_rings
        local_map = (SurfelMap if is_surfels else FeatureMap)(scan.cells_m, self._config.radius_m)
        logger.info("new local map at %.3f s, cells of %.2f m", scan.stamp, scan.cell_m)
        self._map_since, self._place = self._scans, None
        self._growing_since = None if is_surfels else scan.stamp
        self._insert(scan, state, local_map)
        return local_map

    def _insert(self, scan: SampledScan, state: MotionState, local_map: LocalMap) -> None:
        """Insert a scan, compensated, at its pose."""
        _, points = scan.sweep.placed(state.velocity, state.T_world_lidar)
        local_map.add(scan, points, state.T_world_lidar[:3, 3])
        recent = [one for one in self._recent if one.number > self._scans - self.kept_scans]
        if self.kept_scans:
            recent.append(Insertion(self._scans, points, scan.elevations, state.T_world_lidar[:3, 3]))
        self._recent = recent


def _sparse_message(scan: SampledScan) -> str:
    return f"only {len(scan)} points within range" if len(scan) else "no points within range"
