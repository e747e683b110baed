"""The elevation bias of a LiDAR, from surfaces that were seen from near and from far.

With an error of elevation, a point at range r is off by r times that angle, across its ray: the same ground seen from
near and from far disagrees, and bends under the sensor. No motion explains the bend, so that the angle is observable
while the sensor moves. Some scans of a stretch are adjusted together (bundle adjustment): their poses, the planes that
they see, and one angle.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, exp, transform_points
from lidarslam.core.state import TRANSFORM, Shape, Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.surfels.voxel_hash import point_keys
from lidarslam.mapping.tracking.mapped_scan import MappedScan

IntArray = NDArray[np.intp]

# Scans of a stretch, and their spacing in median ranges: along a stretch, far surfaces come near.
_SCANS, _SPACING = 10, 0.2
# Least number of scans of a stretch that ends early.
_FEWEST_OF_STRETCH = 4
# Stretches in all: each takes some 50 ms, and more of them add little.
_MOST_STRETCHES = 8
# Edge of the cubes with a plane, in cells of the map. Cubes are left out until a scan has about this many points; the
# same ones for all scans, as only surfaces seen by several matter.
_EDGE_CELLS = 2.0
_POINTS = 2000
# A large odd number spreads the keys of cubes.
_SPREADING = np.int64(0x9E3779B97F4A7C15 - (1 << 64))
_ITERATIONS = 6
# A plane has at least this many points, of this many scans, is not long and narrow, and is thin compared with its width
# and with range noise: of grass, near and far scans see other parts.
_FEWEST_POINTS, _FEWEST_SCANS = 10, 3
_MOST_THICKNESS, _LEAST_WIDTH, _MOST_THICKNESS_M = 0.4, 0.15, 0.03
# Standard deviations of a mean of points across its surface, and along its ray; the second is large because all points
# of a laser share its offset of range, so that grazing rays, which it moves along the surface, count most.
_NOISE_M, _RANGE_M = 0.02, 0.1
# Accuracy of a range as manufacturers state it: an offset that all points may share.
_OFFSET_M = 0.03
# Scale of Geman and McClure's weights.
_SCALE_M = 0.1
# Errors are taken as independent between sectors of azimuth and scans, and between bands of elevation, not within. The
# last are those of lasers, and the same everywhere.
_BAND_RAD, _SECTOR_RAD = np.deg2rad(1.0), np.deg2rad(30.0)
# A larger angle is no error of calibration, but a stretch that does not show one.
_LARGEST_RAD = np.deg2rad(5.0)
# Beyond this sine of the elevation the azimuth is not defined well.
_STEEPEST = 0.95


@dataclass(frozen=True, eq=False)
class PlacedPoints:
    """Points of a scan, compensated, with its pose."""

    points: Annotated[FloatArray, Shape(None, 3)]  # in the LiDAR frame
    T_world_lidar: Annotated[FloatArray, TRANSFORM]


@dataclass(frozen=True)
class ElevationBias:
    """The angle by which all points of a sensor lie too low, radians; raised by it, they are right."""

    angle: float
    # standard deviations: of the scatter between stretches, and of the contribution of the sensor's other errors
    scatter: float
    systematic: float

    @property
    def sigma(self) -> float:
        """Standard deviation of the angle."""
        return float(np.hypot(self.scatter, self.systematic))


def combined(biases: Sequence[ElevationBias]) -> ElevationBias | None:
    """The weighted mean; None of fewer than two, as one stretch alone may be bent by what moves in it.

    The scatter is raised where the stretches differ by more than their own (the ratio of Birge).
    """
    if len(biases) < 2:
        return None
    angles, scatters, systematic = np.array([(one.angle, one.scatter, one.systematic) for one in biases]).T
    weights = 1.0 / (scatters**2 + systematic**2)
    weights /= weights.sum()
    angle = float(weights @ angles)
    spread = np.linalg.norm((angles - angle) / scatters) / np.sqrt(len(biases) - 1.0)
    scatter = max(1.0, float(spread)) * float(np.linalg.norm(weights * scatters))
    return ElevationBias(angle, scatter, float(weights @ systematic))


def estimate_bias(scans: Sequence[PlacedPoints], edge_m: float) -> ElevationBias | None:
    """The bias of a stretch, of elevations above the x-y plane; None where too few surfaces were seen by several scans.

    The poses of the scans are nearly right; points within a cube of this edge are taken as one plane.
    """
    points = np.concatenate([scan.points for scan in scans])
    number = np.repeat(np.arange(len(scans)), [len(scan.points) for scan in scans])
    poses, bias = np.stack([scan.T_world_lidar for scan in scans]), ElevationBias(0.0, np.inf, np.inf)
    sines = points[:, 2] / np.linalg.norm(points, axis=1)
    usable = np.abs(sines) < _STEEPEST
    points, number, elevations = points[usable], number[usable], np.arcsin(sines[usable])
    # The motion of a point per radian of elevation.
    rho = np.hypot(points[:, 0], points[:, 1])
    lift = np.column_stack([-points[:, :2] * (points[:, 2] / rho)[:, None], rho])
    for _ in range(_ITERATIONS):
        system = _System.of(points + bias.angle * lift, lift, elevations, number, poses, edge_m)
        if system is None:
            return None
        step, scatter, systematic = system.solve()
        poses = poses @ exp(step[:-1].reshape(-1, 6))
        bias = ElevationBias(bias.angle + float(step[-1]), scatter, systematic)
        if not abs(bias.angle) < _LARGEST_RAD:
            return None
    return bias


@dataclass(frozen=True, eq=False)
class _System:
    """Linearised distances from planes: a row for the mean of a scan's points in a plane's cube."""

    scans: int  # K
    # plane, scan: (M,) their numbers; jacobian: (M, 7) with pose and angle; residual, weight: (M,)
    plane: IntArray
    scan: IntArray
    jacobian: FloatArray
    residual: FloatArray
    weight: FloatArray
    cosine: FloatArray  # (M,) of the angle between ray and normal: the derivative with the range
    band: IntArray  # (M,) of elevation
    sector: IntArray  # (M,) of azimuth

    @classmethod
    def of(
        cls, points: FloatArray, lift: FloatArray, elevations: FloatArray, number: IntArray, poses: FloatArray,
        edge_m: float,
    ) -> "_System | None":  # fmt: skip
        """Of points (N, 3) with their scans' numbers (N,), at poses (K, 4, 4)."""
        world = np.einsum("nij,nj->ni", poses[number, :3, :3], points) + poses[number, :3, 3]
        _, cube = np.unique(point_keys(world, edge_m), return_inverse=True)
        away = world - _means(world, cube)[cube]
        products = np.einsum("ni,nj->nij", away, away).reshape(-1, 9)
        values, axes = np.linalg.eigh(_means(products, cube).reshape(-1, 3, 3))
        spread = np.sqrt(np.maximum(values, 0.0)).T
        key, row = np.unique(cube * len(poses) + number, return_inverse=True)
        plane, scan = np.divmod(key, len(poses))
        is_plane = (np.bincount(cube) >= _FEWEST_POINTS) & (np.bincount(plane) >= _FEWEST_SCANS)
        is_plane &= (spread[0] < _MOST_THICKNESS * spread[1]) & (spread[1] > _LEAST_WIDTH * spread[2])
        kept = np.flatnonzero((is_plane & (spread[0] < _MOST_THICKNESS_M))[plane])
        if len(kept) < 7 * len(poses):
            return None
        normal = axes[plane, :, 0]
        means = _means(np.column_stack([points, lift, away, elevations]), row)
        inward = np.einsum("nji,nj->ni", poses[scan, :3, :3], normal)
        p, residual = means[:, :3], np.einsum("ni,ni->n", means[:, 6:9], normal)
        jacobian = np.column_stack([np.cross(p, inward), inward, np.einsum("ni,ni->n", means[:, 3:6], inward)])
        cosine = np.einsum("ni,ni->n", p, inward) / np.linalg.norm(p, axis=1)
        weight = 1.0 / ((_NOISE_M**2 + (_RANGE_M * cosine) ** 2) * (1.0 + (residual / _SCALE_M) ** 2) ** 2)
        band = np.floor(means[:, 9] / _BAND_RAD).astype(np.intp)
        sector = np.floor(np.arctan2(p[:, 1], p[:, 0]) / _SECTOR_RAD).astype(np.intp)
        _, plane = np.unique(plane[kept], return_inverse=True)
        rows = (jacobian, residual, weight, cosine, band - band.min(), sector - sector.min())
        return cls(len(poses), plane, scan[kept], *(values[kept] for values in rows))

    def solve(self) -> tuple[FloatArray, float, float]:
        """The step (6 K + 1,) of poses and angle, offsets of the planes eliminated; the angle's standard deviations.

        They are those of a regression whose errors are correlated within a group, or come from an offset of all ranges.
        """
        planes = np.bincount(self.plane, self.weight)
        columns = np.column_stack([6 * self.scan[:, None] + np.arange(6), np.full(len(self.scan), 6 * self.scans)])
        whole = np.zeros((len(self.scan), 6 * self.scans + 1))
        np.put_along_axis(whole, columns, self.jacobian, axis=1)
        order = np.argsort(self.plane, kind="stable")
        begins = np.searchsorted(self.plane[order], np.arange(len(planes)))
        whole -= (np.add.reduceat((self.weight[:, None] * whole)[order], begins) / planes[:, None])[self.plane]
        weighted = self.weight[:, None] * whole
        A, b = weighted.T @ whole, weighted.T @ self.residual
        # The first pose is kept; the others may have directions that no plane constrains.
        A[np.diag_indices(6 * self.scans)] += np.repeat([1e9, 1.0], [6, 6 * self.scans - 6])
        both = np.linalg.solve(A[:-1, :-1], np.column_stack([A[:-1, -1], b[:-1]]))
        # The part of the angle's effect that no motion explains, and the remaining residuals.
        unexplained = whole[:, -1] - whole[:, :-1] @ both[:, 0]
        information = float(self.weight @ unexplained**2)
        angle = -float(self.weight @ (unexplained * self.residual)) / information
        step = np.append(-both[:, 1] - angle * both[:, 0], angle)
        scores = self.weight * unexplained * (self.residual + whole @ step)
        sector, scan, band = (np.linalg.norm(np.bincount(n, scores)) for n in (self.sector, self.scan, self.band))
        offset = _OFFSET_M * float(self.weight @ (unexplained * self.cosine))
        return step, float(np.hypot(sector, scan)) / information, float(np.hypot(band, offset)) / information


def _means(values: FloatArray, group: IntArray) -> FloatArray:
    """Means (G, C) of the rows of values (N, C) with the same number (N,)."""
    sums = np.stack([np.bincount(group, column) for column in values.T], axis=1)
    return np.asarray(sums / np.bincount(group)[:, None], dtype=np.float64)


class ElevationEstimator(Stateful):
    """Takes registered scans, and adjusts those of a stretch once it is complete."""

    _biases: list[ElevationBias]  # of each stretch that shows one
    _scans: list[PlacedPoints]  # of the present stretch
    _edge_m: float
    _one_in: int

    def __init__(self) -> None:
        self._biases, self._scans, self._edge_m, self._one_in = [], [], 1.0, 1

    @property
    def stretches(self) -> int:
        """Number of stretches that show the bias."""
        return len(self._biases)

    def add(self, scan: SampledScan, mapped: MappedScan) -> None:
        """Add the next scan; a stretch ends where one is not registered."""
        if len(self._biases) == _MOST_STRETCHES:
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
        """The bias by all scans so far; None where fewer than two stretches show one."""
        return combined(self._with_latest())

    def _end(self) -> None:
        self._biases, self._scans = self._with_latest(), []

    def _with_latest(self) -> list[ElevationBias]:
        enough = len(self._scans) >= _FEWEST_OF_STRETCH
        latest = estimate_bias(self._scans, self._edge_m) if enough else None
        return self._biases if latest is None else [*self._biases, latest]
