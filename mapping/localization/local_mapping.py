"""A recording's own local map, while its place in the finished map is unknown, and its scans to search with."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle, transform_points
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.mapping.tracking.tracking_state import GIVE_UP_AFTER

# Scans until the first search of the whole map, growth of the intervals, and the longest; and between nearby searches.
_FIRST_SEARCH, _GROWTH, _LONGEST = 5, 1.5, 40
_NEARBY_EVERY = 5
# A scan is kept after this distance, in median ranges, or this turn. The latest are kept.
_APART_RANGES, _APART_RAD = 0.25, np.deg2rad(30.0)
_MOST = 24


@dataclass(frozen=True, eq=False)
class KeptScan:
    """A scan at its pose in a local frame of the recording."""

    T_local_lidar: FloatArray  # (4, 4)
    points: FloatArray  # (N, 3) in the LiDAR frame at the stamp, compensated, as they go into a map
    keypoints: FloatArray  # (K, 3) those that are registered
    cell_m: float  # size of cells that suits the scene
    range_m: float  # median range of the scene

    def is_apart_from(self, other: "KeptScan") -> bool:
        """Whether the sensor has moved or turned since another scan."""
        motion = inverse(other.T_local_lidar) @ self.T_local_lidar
        far = np.linalg.norm(motion[:3, 3]) > _APART_RANGES * self.range_m
        return bool(far or rotation_angle(motion) > _APART_RAD)


class KeptScans:
    """A bounded number of scans, apart from one another, and the latest; searched once there is one."""

    latest: KeptScan

    def __init__(self) -> None:
        self._apart: list[KeptScan] = []

    def add(self, scan: KeptScan) -> None:
        """Add the next scan that was registered in the local frame."""
        self.latest = scan
        if not self._apart or scan.is_apart_from(self._apart[-1]):
            self._apart = [*self._apart, scan][-_MOST:]

    def chosen(self, count: int) -> Sequence[KeptScan]:
        """The latest scan, and at most `count` others before it, backwards in time, evenly spread."""
        others = [scan for scan in reversed(self._apart) if scan is not self.latest]
        if not others:
            return [self.latest]
        spread = np.unique(np.linspace(0, len(others) - 1, min(count, len(others))).astype(np.intp))
        return [self.latest, *(others[index] for index in spread)]

    def points_around(self, reach_m: float) -> FloatArray:
        """The points (N, 3) of all scans within reach of the latest, in its LiDAR frame."""
        T_lidar_local, parts = inverse(self.latest.T_local_lidar), [self.latest.points]
        for scan in self._apart:
            T = T_lidar_local @ scan.T_local_lidar
            if scan is not self.latest and np.linalg.norm(T[:3, 3]) < reach_m:
                parts.append(transform_points(T, scan.points))
        points = np.concatenate(parts)
        inside = np.einsum("ij,ij->i", points, points) < reach_m**2
        return np.asarray(points[inside], dtype=np.float64)


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
        self._count = self._lost = 0
        self._next_search, self._wait = _FIRST_SEARCH, float(_FIRST_SEARCH)

    def add(self, scan: SampledScan, prior: Prior) -> MappedScan:
        """Map the next scan."""
        mapped, number = self._mapper.process_sampled(scan, prior), self._first + self._count
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
        self._count += 1
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

    @property
    def searches_nearby(self) -> bool:
        """Whether a place that is supposed is to be tried now."""
        return self._count % _NEARBY_EVERY == 0

    def searches_anywhere(self) -> bool:
        """Whether the whole map is to be searched now; the next search is postponed."""
        if self._count < self._next_search:
            return False
        self._wait = min(_GROWTH * self._wait, float(_LONGEST))
        self._next_search = self._count + round(self._wait)
        return True
