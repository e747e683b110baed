"""How well a scan fits a local map: its inliers, and the support of every direction of translation."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import TrackingConfig
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.iteration import RANGE_NOISE_M
from lidarslam.mapping.registration.local_map import LocalMap, Matcher, Surfaces

# Largest distance of an inlier from its surface: the largest of a length, a share of the cell, a share of the range,
# and standard deviations of the surface.
_GATE_MIN_M, _GATE_CELLS, _GATE_RATIO, _GATE_SIGMAS = 0.05, 0.5, 0.02, 2.0
# Axes of the world with fewer correspondences are not counted apart.
_FEWEST_FACING = 30
# Least share of points with a correspondence.
_LEAST_OVERLAP = 0.1
# Least directional support. On simulated streets it is 0.7 and more at true poses, 0.1 to 0.3 at poses 0.6 m off.
_DEGRADED_SUPPORT, _LOST_SUPPORT = 0.5, 0.35
# Distance at which a point has half the inlier weight in the support, in cells; ridge of the generalised eigenproblem,
# as a share of the trace, so that a direction without constraints is not decided by noise.
_HALF_CELLS = 0.5
_RIDGE = 0.001
# Least information of inliers on the translation along a direction, relative to that feigned by the noise of their
# normals. In a corridor with little in it, that is 3 to 14 at true poses; at wrong ones in fields, 3 to 8; elsewhere
# over 20.
_LEAST_EVIDENCE = 7.0


@dataclass(frozen=True)
class Fit:
    """Fit of a scan to the map."""

    matched: int  # points with a correspondence
    overlap: float  # their share of all points
    residual_m: float | None  # median distance of the matched points from their surfaces; None when there are none
    # share of inliers among the matched points, the least of the world's axes by which the surfaces are grouped: nearly
    # everything fits the ground. None when there are none.
    inlier_ratio: float | None
    # the inlier ratio of the points that constrain the least supported direction of translation: most points fit
    # wherever a scan slides along a street, the constraining ones do not. None when there are none.
    support: float | None = None
    # information of the inliers along the least constrained direction of translation, relative to that feigned by the
    # noise of their normals; None when there are none.
    evidence: float | None = None
    weakest: tuple[float, float, float] | None = None  # that direction, unit, in the world
    unsupported: tuple[float, float, float] | None = None  # direction of the least support if that is too low

    @property
    def is_constrained(self) -> bool:
        """Whether inliers constrain the translation along every direction."""
        return self.evidence is None or self.constraint > 1.0

    @property
    def constraint(self) -> float:
        """Evidence along the weakest direction, in units of the least that suffices; one where it is unknown."""
        return 1.0 if self.evidence is None else self.evidence / _LEAST_EVIDENCE

    @property
    def inlier_share(self) -> float:
        """Share of inliers among all points, by the worst axis."""
        return self.overlap * (self.inlier_ratio or 0.0)

    @property
    def quality(self) -> float:
        """Score among fits: share of inliers times directional support."""
        return self.inlier_share * (self.support or 0.0)

    def status(self, config: TrackingConfig, is_young: bool = False, is_held: bool = False) -> Status:
        """Tracking status of the scan.

        In a young map, low support alone does not make it lost; where a prediction holds the pose, support is ignored,
        and in a young map, which is thin, a scan is degraded at worst.
        """
        support = 1.0 if self.support is None or is_held else self.support
        if self.inlier_ratio is None or self.overlap < _LEAST_OVERLAP:
            return Status.LOST
        is_lost = self.inlier_ratio < config.lost_below or (support < _LOST_SUPPORT and not is_young)
        if is_lost and not (is_held and is_young):
            return Status.LOST
        poor = self.inlier_ratio < config.degraded_below or support < _DEGRADED_SUPPORT
        return Status.DEGRADED if poor else Status.OK

    def explain(self, config: TrackingConfig) -> str:
        """The reason of the status; empty when it is ok."""
        if self.status(config) is Status.OK:
            return ""
        if self.inlier_ratio is None or self.overlap < _LEAST_OVERLAP:
            return f"only {100.0 * self.overlap:.0f} % of the scan overlaps the map"
        if self.inlier_ratio < config.degraded_below:
            return f"only {100.0 * self.inlier_ratio:.0f} % of the scan fits the map"
        return (
            f"only {100.0 * (self.support or 0.0):.0f} % of the points that constrain one direction fit: it may slide"
        )


NO_FIT = Fit(0, 0.0, None, None)


def measure_fit(
    points: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap, matcher: Matcher | None = None
) -> Fit:
    """Fit of compensated points (N, 3) of the LiDAR frame at a pose (4, 4), with the matcher of a pose nearby."""
    matcher, world = matcher or local_map.matcher(Sweep(points)), transform_points(T_world_lidar, points)
    matcher.match(world, T_world_lidar)
    sums = _sum_up(world, np.ascontiguousarray(T_world_lidar[:3, 3]), matcher.surfaces, local_map.cell_m)
    matched = len(sums.distances_m)
    if not matched:
        return NO_FIT
    ratios = (sums.inliers / np.maximum(sums.facing, 1.0))[sums.facing >= _FEWEST_FACING]
    values, axes = np.linalg.eigh(sums.supported)
    support, least = directional_support(sums.information, sums.supported, sums.share)
    return Fit(
        matched=matched,
        overlap=matched / len(points),
        residual_m=float(np.median(sums.distances_m)),
        inlier_ratio=float(ratios.min() if len(ratios) else sums.inliers.sum() / matched),
        support=support,
        evidence=float(values[0]) / max(sums.noise, 1e-12),
        weakest=tuple(axes[:, 0].tolist()),
        unsupported=tuple(least.tolist()) if support < _DEGRADED_SUPPORT else None,
    )


class _Sums(NamedTuple):
    """Sums over the matched points of a scan, each with its first residual."""

    distances_m: FloatArray  # (M,) from the surfaces
    facing: FloatArray  # (3,) numbers of points whose surface faces each axis of the world
    inliers: FloatArray  # (3,) and of those that are inliers
    # information, supported, share: as of `translation_information`, thick surfaces counting less
    information: FloatArray
    supported: FloatArray
    share: float
    noise: float  # information that the noise of the inliers' normals feigns


@compiled
def _sum_up(world: FloatArray, sensor: FloatArray, surfaces: Surfaces, cell_m: float) -> _Sums:
    """The sums for points (N, 3) of the world, seen from (3,)."""
    matched, m, noise = int(np.count_nonzero(surfaces.counts)), 0, 0.0
    distances_m, normals = np.empty(matched), np.empty((matched, 3))
    distances, weights = np.empty(matched), np.empty(matched)
    facing, inliers = np.zeros(3), np.zeros(3)
    least_m = max(_GATE_MIN_M, _GATE_CELLS * cell_m)
    for n in range(len(world)):
        if surfaces.counts[n] == 0:
            continue
        distance_m = squared = 0.0
        axis, normal, thickness_m = 0, surfaces.normals[n, 0], surfaces.thickness_m[n, 0]
        for i in range(3):
            distance_m += (world[n, i] - surfaces.points[n, i]) * normal[i]
            squared += (world[n, i] - sensor[i]) ** 2
            normals[m, i] = normal[i]
            axis = i if abs(normal[i]) > abs(normal[axis]) else axis
        distances_m[m] = abs(distance_m)
        facing[axis] += 1.0
        inliers[axis] += distances_m[m] < max(least_m, _GATE_RATIO * math.sqrt(squared), _GATE_SIGMAS * thickness_m)
        distances[m] = distances_m[m] / (_HALF_CELLS * cell_m)
        # Thick surfaces, as planes across an edge, count less.
        weights[m] = 1.0 / (1.0 + (thickness_m / RANGE_NOISE_M) ** 2)
        noise += weights[m] / (1.0 + distances[m] ** 2) * surfaces.tilt[n, 0] ** 2
        m += 1
    return _Sums(distances_m, facing, inliers, *translation_information(normals, distances, weights), noise)


def directional_support(information: FloatArray, supported: FloatArray, share: float) -> tuple[float, FloatArray]:
    """The least inlier ratio over all directions (3,) of translation, points weighted by their constraint on it.

    The smallest generalised eigenvalue of the sums (3, 3) of `translation_information`, whose mean weight is the share.
    """
    ridge = _RIDGE * float(np.trace(information)) * np.eye(3)
    # The ridge is supported as well as the whole.
    root = np.linalg.cholesky(information + ridge)
    half = np.linalg.solve(root, supported + share * ridge)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, half.T))
    direction = np.linalg.solve(root.T, vectors[:, 0])
    return float(values[0]), np.asarray(direction / np.linalg.norm(direction))


@compiled
def translation_information(
    normals: FloatArray, distances: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Sums (3, 3) of `n n^T` without and with inlier weights `1 / (1 + d^2)`, and the mean inlier weight.

    Of unit normals (N, 3), distances (N,) in units at which a point has half the weight, and further weights (N,).
    """
    information, supported, total, inliers = np.zeros((3, 3)), np.zeros((3, 3)), 0.0, 0.0
    for m in range(len(distances)):
        weight, inlier = weights[m], weights[m] / (1.0 + distances[m] * distances[m])
        total += weight
        inliers += inlier
        for i in range(3):
            for j in range(3):
                product = normals[m, i] * normals[m, j]
                information[i, j] += weight * product
                supported[i, j] += inlier * product
    return information, supported, inliers / total if total > 0.0 else 0.0
