"""Localisation in a finished map: found without a guess, tracked, searched for again where tracking is lost.

While the place is unknown, the recording has a local map of its own, whose scans are searched for in the finished map.
A place counts once the scans of the next second confirm it.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.state import Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.localization.place_search import (
    FixedMap,
    Found,
    KeptScan,
    KeptScans,
    Place,
    PlaceSearch,
    Regions,
)
from lidarslam.mapping.motion.prediction import LOST_MOTION, MotionState, Prediction, Prior
from lidarslam.mapping.registration.sampled_scan import SampledScan, Sampler
from lidarslam.mapping.tracking.fit import Fit
from lidarslam.mapping.tracking.mapped_scan import NOT_CONFIRMED, MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.mapping.tracking.tracker import Tracker
from lidarslam.mapping.tracking.tracking_state import GIVE_UP_AFTER

logger = logging.getLogger(__name__)

# A scan with less of its points near surfaces of the map is outside of it, or the world has changed.
_LEAST_OVERLAP = 0.25
# Radius of the region that scans are registered to, in median ranges, and the share by which it is drawn larger.
_RANGES = 5.0
_SPARE = 0.5
# The distance, in median ranges, over which the recording's own map places the scans before the first place.
_BACK_RANGES = 10.0
# Scans until the first search of the whole map, growth of the intervals, and the longest; and between nearby searches.
_FIRST_SEARCH, _GROWTH, _LONGEST = 5, 1.5, 40
_NEARBY_EVERY = 5


class LocalMapping:
    """Maps scans, numbered from `first`, in a frame of its own, and keeps some to search with.

    `T_map_local` (4, 4) is where that frame is supposed in the finished map; None: anywhere.
    """

    def __init__(self, config: MappingConfig, T_map_local: FloatArray | None, first: int = 0) -> None:
        self.T_map_local = T_map_local
        self.kept = KeptScans()
        self.poses: dict[int, FloatArray] = {}  # (4, 4) in the local frame, by the number of the scan
        self._followed: list[int] = []  # numbers of the scans that the latest one follows without a break
        self._mapper = Mapper(config)
        self._first = first
        self.count = self._lost = 0  # scans in all, and those lost in a row
        self._next_search, self._wait = _FIRST_SEARCH, float(_FIRST_SEARCH)

    def add(self, scan: SampledScan, prior: Prior) -> MappedScan:
        """Map the next scan."""
        mapped, number = self._mapper.process(scan, prior), self._first + self.count
        self.poses[number] = mapped.state.T_world_lidar
        if mapped.status is not Status.LOST:
            self._lost = 0
            self._followed.append(number)
            T_local_lidar, velocity = mapped.state.T_world_lidar, mapped.state.velocity
            points, keypoints = scan.sweep.compensated(velocity), scan.keypoints.compensated(velocity)
            self.kept.add(KeptScan(T_local_lidar, points, keypoints, scan.cell_m, scan.range_m))
        elif mapped.fit is not None:
            self._lost += 1
            if self._lost >= GIVE_UP_AFTER:  # the local map restarts at a pose that is only predicted
                self.kept, self._followed, self._lost = KeptScans(), [], 0
        self.count += 1
        return mapped

    def followed_within(self, ranges: float, before: int) -> list[int]:
        """Numbers of the scans before one, tracked without a break from there, up to a distance in median ranges."""
        numbers = [number for number in self._followed if number < before]
        if not numbers:
            return []
        positions = np.array([self.poses[number][:3, 3] for number in [*numbers, before]])
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        ways = np.cumsum(steps[::-1])[::-1]
        return [number for number, way in zip(numbers, ways, strict=True) if way < ranges * self.kept.latest.range_m]

    @property
    def up(self) -> FloatArray:
        """(3,) the vertical, in the local frame."""
        local_map = self._mapper.local_map
        return np.array([0.0, 0.0, 1.0]) if local_map is None else local_map.vertical()

    def searches_anywhere(self) -> bool:
        """Whether the whole map is to be searched now; the next search is postponed."""
        if self.count < self._next_search:
            return False
        self._wait = min(_GROWTH * self._wait, float(_LONGEST))
        self._next_search = self.count + round(self._wait)
        return True


@dataclass(frozen=True, eq=False)
class Localisation:
    """A place that was found and confirmed; scans are numbered from 0."""

    scan: int  # that was found
    confirmed: int  # that confirmed it
    fits: tuple[Fit, ...]  # of the scans that it was found with


class MapLocaliser(Stateful):
    """Registers scans to a finished map, near a rough x, y and heading or anywhere. It cannot be saved."""

    def __init__(
        self, config: MappingConfig, fixed_map: FixedMap, guess: tuple[float, float, float] | None = None
    ) -> None:
        self._config = config
        self._sampler = Sampler(config)
        self._search = PlaceSearch(fixed_map, config.max_range_m)
        self._local: LocalMapping | None = LocalMapping(config, None)
        self._guess = guess
        self._tracker: Tracker | None = None
        self._regions = Regions(fixed_map, _SPARE)
        self._last: MotionState | None = None
        self._pending: tuple[Localisation, FloatArray] | None = None  # unconfirmed, and its `T_map_local` (4, 4)
        self._count = 0
        self.found: list[Localisation] = []  # one for each time that it was found
        # Of every search without a place: the number of the scan, from 0, and the reason.
        self.refusals: list[tuple[int, str]] = []
        # Better poses than those returned, known by now, by the numbers of the scans; and which of these scans came
        # before the first place, and which lie at a place that was not confirmed.
        self.corrections: dict[int, FloatArray] = {}
        self.placed_afterwards: list[int] = []
        self.revoked: list[int] = []

    def sample(self, scan: Scan) -> SampledScan:
        """Thin the next scan; on any thread, while `process` works on an earlier one."""
        return self._sampler.sample(scan)

    def process(self, sampled: SampledScan, prior: Prior) -> MappedScan:
        """Register the next scan."""
        # An IMU predicts a pose in the map.
        local = self._local
        own = None if local is None else local.add(sampled, replace(prior, inertial=None))
        if self._tracker is not None and self._last is not None:
            mapped = self._track(sampled, prior, self._tracker, self._last)
            if mapped.status is Status.LOST and local is not None and own is not None:  # the place was not confirmed
                self._revoke(local)
                mapped = _dead_reckoned(local, own, f"the place that was found is not confirmed: {mapped.message}")
        else:
            assert local is not None
            assert own is not None
            mapped = self._look(sampled, local, own)
        self._last = mapped.state
        self._count += 1
        return mapped

    def unconfirmed(self) -> list[int]:
        """Numbers of the scans at places that were not confirmed, by now."""
        pending = [] if self._pending is None else range(self._pending[0].scan, self._count)
        return [*self.revoked, *pending]

    def _track(self, scan: SampledScan, prior: Prior, tracker: Tracker, last: MotionState) -> MappedScan:
        """Predict, register, judge."""
        prediction = tracker.tracking.predict(scan, prior, last, self._config)
        if scan.is_sparse:
            return self._lose(tracker, prediction, None, f"only {len(scan)} points within range")
        self._regions.resize(scan.cell_m, min(_RANGES * scan.range_m, self._config.radius_m))
        surfel_map = self._regions.around(prediction.T_world_lidar[:3, 3])
        attempt = tracker.register(scan, prior, prediction, last, surfel_map)
        if attempt.registration is None or attempt.status is Status.LOST:
            reason = attempt.fit.explain(self._config.tracking) or "several places nearby fit alike"
            return self._lose(tracker, attempt.prediction, attempt.fit, reason)
        if attempt.fit.overlap < _LEAST_OVERLAP:
            reason = f"only {100.0 * attempt.fit.overlap:.0f} % of the scan is near surfaces of the map"
            return self._lose(tracker, attempt.prediction, attempt.fit, reason)
        mapped = tracker.accept(attempt, scan, prior, prediction, last)
        if self._pending is not None and not tracker.tracking.is_unconfirmed:
            self._confirm(*self._pending)
        return replace(mapped, added=False)

    def _confirm(self, pending: Localisation, T_map_local: FloatArray) -> None:
        """Accept a place; the scans before the first one are placed too, as far as drift is small."""
        local = self._local
        if local is not None and not self.found:
            self.corrections = {number: T_map_local @ T for number, T in local.poses.items() if number < pending.scan}
            reached = set(local.followed_within(_BACK_RANGES, pending.scan))
            self.placed_afterwards = sorted(reached)
            self.revoked = [number for number in self.revoked if number not in reached]
        self.found.append(replace(pending, confirmed=self._count))
        self._pending = self._local = None
        self._guess = None
        logger.info("found at scan %d, confirmed at scan %d", pending.scan, self._count)

    def _revoke(self, local: LocalMapping) -> None:
        """Give up a place that later scans contradict."""
        assert self._pending is not None
        T_map_local = np.eye(4) if local.T_map_local is None else local.T_map_local
        for number in range(self._pending[0].scan, self._count):
            self.corrections[number] = T_map_local @ local.poses[number]
            self.revoked.append(number)
        self._tracker = self._pending = None

    def _lose(self, tracker: Tracker, prediction: Prediction, fit: Fit | None, reason: str) -> MappedScan:
        """A scan that is not registered stays at its prediction; after many a local map of its own begins."""
        lost = tracker.lose(prediction, reason, fit)
        if fit is not None and tracker.gives_up:
            self._tracker = None
            self._local = LocalMapping(self._config, prediction.T_world_lidar, self._count + 1)
        return lost

    def _look(self, scan: SampledScan, local: LocalMapping, own: MappedScan) -> MappedScan:
        """Search for the place of the latest scans, if a search is due."""
        found = None if own.status is Status.LOST else self._searched(local, own)
        if found is None:
            return _dead_reckoned(local, own, "the place is searched for")
        if isinstance(found, str):
            self.refusals.append((self._count, found))
            logger.info("scan %d: not found: %s", self._count, found)
            return _dead_reckoned(local, own, f"not found: {found}")
        return self._begin(scan, own, found)

    def _searched(self, local: LocalMapping, own: MappedScan) -> Found | None:
        nearby = None
        if local.count % _NEARBY_EVERY == 0:
            if self._guess is not None:
                local.T_map_local = self._search.guessed(local.kept, local.up, *self._guess)
            if local.T_map_local is not None:
                nearby = self._search.around(local.kept, local.T_map_local @ own.state.T_world_lidar)
                if isinstance(nearby, Place):
                    return nearby
        if self._guess is None and local.searches_anywhere():
            return self._search.anywhere(local.kept, local.up)
        return nearby

    def _begin(self, scan: SampledScan, own: MappedScan, place: Place) -> MappedScan:
        """Track from a place on."""
        T_map_local = place.T_map_lidar @ inverse(own.state.T_world_lidar)
        self._pending = Localisation(self._count, -1, place.fits), T_map_local
        self._tracker = Tracker(self._config)
        self._tracker.begin_at(scan.stamp, place.quality)
        covariance = own.state.covariance.copy()
        covariance[:6, :6] = place.registration.covariance[:6, :6]
        state = replace(own.state, T_world_lidar=place.T_map_lidar, covariance=covariance)
        message = f"found in the map; {NOT_CONFIRMED}"
        return MappedScan(
            state, place.T_map_lidar, True, Status.DEGRADED, message, place.fits[0],
            place.registration.degeneracy.names, place.registration.iterations, is_connected=False,
        )  # fmt: skip


def _dead_reckoned(local: LocalMapping, own: MappedScan, reason: str) -> MappedScan:
    """A scan at its pose in the local map, placed where that is supposed."""
    T_map_lidar = own.state.T_world_lidar if local.T_map_local is None else local.T_map_local @ own.state.T_world_lidar
    state = replace(own.state, T_world_lidar=T_map_lidar, covariance=LOST_MOTION)
    return MappedScan(state, T_map_lidar, False, Status.LOST, reason, None, is_connected=False)
