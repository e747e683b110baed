"""A recording's own local map, while its place in the finished map is unknown."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.fixed_map.kept_scans import KeptScan, KeptScans
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.mapping.tracking.tracking_state import GIVE_UP_AFTER

# Scans until the first search of the whole map, growth of the intervals, and the longest; and between nearby searches.
_FIRST_SEARCH, _GROWTH, _LONGEST = 5, 1.5, 40
_NEARBY_EVERY = 5


class LocalMapping:
    """Maps scans in a frame of its own, and keeps some to search with.

    Args:
        config: of the mapping.
        T_map_local: (4, 4) where that frame is supposed in the finished map; None: anywhere.
        first: number of the first scan in the recording.
    """

    def __init__(self, config: MappingConfig, T_map_local: FloatArray | None, first: int = 0) -> None:
        self.T_map_local = T_map_local
        self.kept = KeptScans()
        self.poses: dict[int, FloatArray] = {}  # (4, 4) in the local frame, by the number of the scan
        self._followed: list[int] = []  # numbers of the scans that the latest one follows without a break
        self._mapper = Mapper(config)
        self._first = first
        self._count = self._lost = 0
        self._next_search, self._wait = _FIRST_SEARCH, float(_FIRST_SEARCH)

    def add(self, scan: SampledScan, prior: Prior) -> MappedScan:
        """Map the next scan."""
        mapped, number = self._mapper.process_sampled(scan, prior), self._first + self._count
        self.poses[number] = mapped.state.T_world_lidar
        if mapped.status is not Status.LOST:
            self._lost = 0
            self._followed.append(number)
            self.kept.add(KeptScan.of(scan, mapped.state.T_world_lidar, mapped.state.velocity))
        elif mapped.fit is not None:
            self._lost += 1
            if self._lost >= GIVE_UP_AFTER:  # the local map begins anew at a pose that is only predicted
                self.kept, self._followed, self._lost = KeptScans(), [], 0
        self._count += 1
        return mapped

    def followed_within(self, ranges: float, before: int) -> list[int]:
        """Numbers of the scans before one, from which it is tracked without a break over a way in median ranges."""
        latest = self.kept.latest
        numbers = [number for number in self._followed if number < before]
        if latest is None or not numbers:
            return []
        positions = np.array([self.poses[number][:3, 3] for number in [*numbers, before]])
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        ways = np.cumsum(steps[::-1])[::-1]
        return [number for number, way in zip(numbers, ways, strict=True) if way < ranges * latest.range_m]

    @property
    def up(self) -> FloatArray:
        """(3,) the vertical, in the local frame."""
        local_map = self._mapper.local_map
        return np.array([0.0, 0.0, 1.0]) if local_map is None else local_map.vertical()

    @property
    def searches_nearby(self) -> bool:
        """Whether a place that is supposed is to be tried now."""
        return self._count % _NEARBY_EVERY == 0

    def searches_anywhere(self) -> bool:
        """Whether the whole map is to be searched now; the next search is put off."""
        if self._count < self._next_search:
            return False
        self._wait = min(_GROWTH * self._wait, float(_LONGEST))
        self._next_search = self._count + round(self._wait)
        return True
