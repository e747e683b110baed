"""The scans of a recording that its place in a finished map is searched with."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle, transform_points
from lidarslam.mapping.registration.sampled_scan import SampledScan

# A scan is kept after so much way, in median ranges, or such a turn. The latest are kept.
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

    @classmethod
    def of(cls, scan: SampledScan, T_local_lidar: FloatArray, velocity: FloatArray) -> "KeptScan":
        """Compensate a scan with its velocity (6,)."""
        points, keypoints = scan.sweep.compensated(velocity), scan.keypoints.compensated(velocity)
        return cls(T_local_lidar, points, keypoints, scan.cell_m, scan.range_m)

    def is_apart_from(self, other: "KeptScan") -> bool:
        """Whether the sensor has moved or turned since another scan."""
        motion = inverse(other.T_local_lidar) @ self.T_local_lidar
        far = np.linalg.norm(motion[:3, 3]) > _APART_RANGES * self.range_m
        return bool(far or rotation_angle(motion) > _APART_RAD)


class KeptScans:
    """A bounded number of scans, apart from one another, and the latest."""

    def __init__(self) -> None:
        self._apart: list[KeptScan] = []
        self.latest: KeptScan | None = None

    def add(self, scan: KeptScan) -> None:
        """Take the next scan that was registered in the local frame."""
        self.latest = scan
        if not self._apart or scan.is_apart_from(self._apart[-1]):
            self._apart = [*self._apart, scan][-_MOST:]

    def chosen(self, count: int) -> Sequence[KeptScan]:
        """The latest scan, and before it at most so many others, backwards in time, evenly spread."""
        if self.latest is None:
            return []
        others = [scan for scan in reversed(self._apart) if scan is not self.latest]
        if not others:
            return [self.latest]
        spread = np.unique(np.linspace(0, len(others) - 1, min(count, len(others))).astype(np.intp))
        return [self.latest, *(others[index] for index in spread)]

    def points_around(self, reach_m: float) -> FloatArray:
        """The points (N, 3) of all scans within reach of the latest, in its LiDAR frame."""
        if self.latest is None:
            return np.empty((0, 3))
        T_lidar_local, parts = inverse(self.latest.T_local_lidar), [self.latest.points]
        for scan in self._apart:
            T = T_lidar_local @ scan.T_local_lidar
            if scan is not self.latest and np.linalg.norm(T[:3, 3]) < reach_m:
                parts.append(transform_points(T, scan.points))
        points = np.concatenate(parts)
        inside = np.einsum("ij,ij->i", points, points) < reach_m**2
        return np.asarray(points[inside], dtype=np.float64)
