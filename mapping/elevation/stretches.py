"""The elevation bias of a recording, from stretches of its way."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.state.stateful import ANY_NUMBER, Shape, Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.elevation.bias import ElevationBias, PlacedPoints, combined, estimate_bias
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.surfels.voxel_hash import point_keys
from lidarslam.mapping.tracking.mapped_scan import MappedScan

# Scans of a stretch, and their distance in median ranges: while what is near comes from far away.
_SCANS, _SPACING = 10, 0.2
# A stretch that ends early needs so many.
_FEWEST_SCANS = 4
# Stretches in all: each takes some 50 ms, and more of them add little.
_MOST_STRETCHES = 8
# Edge of the cubes with a plane, in cells of the map. Of these, so many are left out that a scan has about this many
# points; the same ones for all scans, as what matters is seen by several.
_EDGE_CELLS = 2.0
_POINTS = 2000
# A large odd number spreads the keys of cubes.
_SPREADING = np.int64(0x9E3779B97F4A7C15 - (1 << 64))


class ElevationEstimator(Stateful):
    """Takes registered scans, and adjusts those of a stretch once it is complete."""

    _found: Annotated[FloatArray, Shape(None, 3), ANY_NUMBER]  # angle and standard deviations of each stretch
    _scans: list[PlacedPoints]  # of the present stretch
    _edge_m: float
    _one_in: int

    def __init__(self) -> None:
        self._found, self._scans, self._edge_m, self._one_in = np.zeros((0, 3)), [], 1.0, 1

    @property
    def stretches(self) -> int:
        """Number of stretches that show the bias."""
        return len(self._found)

    def add(self, scan: SampledScan, mapped: MappedScan) -> None:
        """Add the next scan; a stretch ends where one is not registered."""
        if len(self._found) == _MOST_STRETCHES:
            return
        if mapped.status is not Status.OK or not mapped.registered:
            self._end()
            return
        T_world_lidar = mapped.state.T_world_lidar
        if self._scans:
            way = T_world_lidar[:3, 3] - self._scans[-1].T_world_lidar[:3, 3]
            if float(np.linalg.norm(way)) < _SPACING * scan.range_m:
                return
        else:
            self._edge_m, self._one_in = _EDGE_CELLS * scan.cell_m, max(1, round(len(scan) / _POINTS))
        points = scan.sweep.compensated(mapped.state.velocity)
        keys = point_keys(transform_points(T_world_lidar, points), self._edge_m)
        chosen = (keys * _SPREADING >> 40) % self._one_in == 0
        self._scans.append(PlacedPoints(points[chosen], T_world_lidar))
        if len(self._scans) == _SCANS:
            self._end()

    def bias(self) -> ElevationBias | None:
        """The bias by all scans so far; None where they show none."""
        latest = _row(self._scans, self._edge_m)
        return combined(np.concatenate([self._found, latest]))

    def _end(self) -> None:
        self._found, self._scans = np.concatenate([self._found, _row(self._scans, self._edge_m)]), []


def _row(scans: Sequence[PlacedPoints], edge_m: float) -> FloatArray:
    """A stretch as a row (1, 3), or none (0, 3)."""
    bias = estimate_bias(scans, edge_m) if len(scans) >= _FEWEST_SCANS else None
    return np.zeros((0, 3)) if bias is None else np.array([[bias.angle, bias.scatter, bias.systematic]])
