"""Localisation in a finished map: found without a guess, tracked, searched for again where tracking is lost.

While the place is unknown, the recording has a local map of its own, whose scans are searched for in the finished map.
A place counts once the scans of the next second confirm it.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.state.stateful import Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.fixed_map.fixed_map import FixedMap
from lidarslam.mapping.fixed_map.local_mapping import LocalMapping
from lidarslam.mapping.fixed_map.place_search import Place, PlaceSearch, Regions, Search
from lidarslam.mapping.motion.prediction import FADING, LOST_MOTION, MotionState, Prediction, Prior
from lidarslam.mapping.surfels.sampling import SampledScan, Sampler
from lidarslam.mapping.tracking.attempts import Attempt
from lidarslam.mapping.tracking.fit import Fit
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.tracker import Tracker

logger = logging.getLogger(__name__)

# A scan with less of its points near surfaces of the map is outside of it, or the world has changed.
_LEAST_OVERLAP = 0.25
# Radius of the region that scans are registered to, in median ranges, and what it is drawn larger by, as a share.
_RANGES = 5.0
_SPARE = 0.5


@dataclass(frozen=True, eq=False)
class Found:
    """A place that was found and confirmed."""

    scan: int  # number of the scan, from 0, that was found
    confirmed: int  # number of the scan that confirmed it
    fits: tuple[Fit, ...]  # of the scans that it was found with
    T_map_local: FloatArray  # (4, 4) from the frame of the poses up to that scan
    followed: tuple[int, ...]  # numbers of the scans before that are tracked without a break up to it
    was_known: bool  # whether the recording had been found before


class MapLocaliser(Stateful):
    """Registers scans to a finished map. It cannot be saved and restored.

    Args:
        config: of the mapping.
        fixed_map: the finished map.
        guess: (4, 4) rough pose of the first scan, x, y and heading; None: anywhere.
    """

    def __init__(self, config: MappingConfig, fixed_map: FixedMap, guess: FloatArray | None = None) -> None:
        self._config = config
        self._map = fixed_map
        self._sampler = Sampler(config)
        self._search = PlaceSearch(fixed_map, config.max_range_m)
        self._local: LocalMapping | None = LocalMapping(config, guess)
        self._is_guess = guess is not None
        self._local_from = 0
        self._tracker: Tracker | None = None
        self._regions: Regions | None = None
        self._last: MotionState | None = None
        self._pending: Found | None = None
        self._count = 0
        self.found: list[Found] = []  # one a time that it was found
        self.refusals: list[tuple[int, str]] = []  # number of the scan, and reason, of every search without a place

    def process(self, scan: Scan, prior: Prior) -> MappedScan:
        """Register the next scan."""
        sampled = self._sampler.sample(scan)
        own = None if self._local is None else self._local.add(sampled, prior)
        if self._tracker is not None and self._last is not None:
            mapped = self._track(sampled, prior, self._tracker, self._last)
            if mapped.status is Status.LOST and own is not None:  # the place was not confirmed
                self._tracker = self._pending = None
                mapped = self._dead_reckoned(own, f"the place that was found is not confirmed: {mapped.message}")
        else:
            assert own is not None
            mapped = self._look(sampled, own)
        self._last = mapped.state
        self._count += 1
        return mapped

    def _track(self, scan: SampledScan, prior: Prior, tracker: Tracker, last: MotionState) -> MappedScan:
        """Predict, register, judge."""
        prediction = tracker.predict(scan, prior, last)
        if scan.is_sparse:
            return self._lose(tracker, prediction, None, f"only {len(scan)} points within range")
        surfel_map = self._regions_for(scan).around(prediction.T_world_lidar[:3, 3])
        attempt = tracker.register(scan, prior, prediction, last, surfel_map)
        if attempt.registration is None or attempt.status is Status.LOST:
            reason = attempt.fit.explain(self._config.tracking) or "several places nearby fit alike"
            return self._lose(tracker, attempt.prediction, attempt.fit, reason)
        if attempt.fit.overlap < _LEAST_OVERLAP:
            reason = f"only {100.0 * attempt.fit.overlap:.0f} % of the scan is near surfaces of the map"
            return self._lose(tracker, attempt.prediction, attempt.fit, reason)
        mapped = tracker.accept(attempt, scan, prior, prediction, last)
        if self._pending is not None and not tracker.is_unconfirmed:
            self._confirm(self._pending)
        return replace(mapped, added=False)

    def _confirm(self, pending: Found) -> None:
        self.found.append(replace(pending, confirmed=self._count))
        self._pending = self._local = None
        self._is_guess = False
        logger.info("found at scan %d, confirmed at scan %d", pending.scan, self._count)

    def _lose(self, tracker: Tracker, prediction: Prediction, fit: Fit | None, reason: str) -> MappedScan:
        """A scan that is not registered stays at its prediction; after many a local map of its own begins."""
        T_map_lidar, velocity = prediction.T_world_lidar, prediction.velocity
        if tracker.loses(has_points=fit is not None):
            self._tracker = None
            self._local, self._local_from = LocalMapping(self._config, T_map_lidar), self._count + 1
        lost = MotionState(prediction.stamp, T_map_lidar, FADING * velocity, LOST_MOTION)
        return MappedScan(lost, T_map_lidar, False, Status.LOST, reason, fit, is_connected=False)

    def _look(self, scan: SampledScan, own: MappedScan) -> MappedScan:
        """Search for the place of the latest scans, if a search is due."""
        found = self._searched(own)
        if found is None:
            return self._dead_reckoned(own, "the place is searched for")
        if found.place is None:
            self.refusals.append((self._count, found.reason))
            logger.info("scan %d: not found: %s", self._count, found.reason)
            return self._dead_reckoned(own, f"not found: {found.reason}")
        return self._begin(scan, own, found.place)

    def _searched(self, own: MappedScan) -> Search | None:
        local = self._local
        assert local is not None
        if own.status is Status.LOST:
            return None
        nearby = None
        if local.T_map_local is not None and local.searches_nearby:
            T_map_lidar = local.T_map_local @ own.state.T_world_lidar
            nearby = self._search.around(local.kept, T_map_lidar, keeps_height=not self._is_guess)
            if nearby.place is not None:
                return nearby
        if not self._is_guess and local.searches_anywhere():
            return self._search.anywhere(local.kept, local.up)
        return nearby

    def _begin(self, scan: SampledScan, own: MappedScan, place: Place) -> MappedScan:
        """Track from a place on."""
        local = self._local
        assert local is not None
        T_map_local = place.T_map_lidar @ inverse(own.state.T_world_lidar)
        followed = tuple(self._local_from + number for number in local.followed[:-1])
        self._pending = Found(self._count, -1, place.fits, T_map_local, followed, bool(self.found))
        self._tracker = Tracker(self._config)
        self._tracker.begin_at(scan.stamp, place.quality)
        covariance = own.state.covariance.copy()
        covariance[:6, :6] = place.registration.covariance[:6, :6]
        state = replace(own.state, T_world_lidar=place.T_map_lidar, covariance=covariance)
        message = "found in the map; not confirmed yet"
        return MappedScan(
            state, place.T_map_lidar, True, Status.DEGRADED, message, place.fits[0],
            place.registration.degeneracy.names, place.registration.iterations, is_connected=False,
        )  # fmt: skip

    def _dead_reckoned(self, own: MappedScan, reason: str) -> MappedScan:
        """A scan at its pose in the local map, placed where that is supposed."""
        assert self._local is not None
        T_map_local = self._local.T_map_local
        state = own.state
        if T_map_local is not None:
            state = replace(state, T_world_lidar=T_map_local @ state.T_world_lidar)
        state = replace(state, covariance=LOST_MOTION)
        return MappedScan(state, state.T_world_lidar, False, Status.LOST, reason, None, is_connected=False)

    def _regions_for(self, scan: SampledScan) -> Regions:
        """The drawn region of the map; a new one where the scale of the scene has changed."""
        cell_m = self._map.cell_m(scan.cell_m)
        if self._regions is None or self._regions.cell_m != cell_m:
            reach_m = min(_RANGES * scan.range_m, self._config.radius_m)
            self._regions = Regions(self._map, cell_m, reach_m, _SPARE * reach_m)
        return self._regions
