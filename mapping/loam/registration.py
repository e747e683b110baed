"""Registration of edge and planar features to their maps (Zhang and Singh, "LOAM", RSS 2014, section VI)."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.directions.degeneracy import Degeneracy
from lidarslam.core.geometry import FloatArray, displacement_m, inverse, log, orthonormalize, transform_points
from lidarslam.mapping.least_squares.degeneracy import DEGENERATE_INFORMATION, find_degeneracy
from lidarslam.mapping.least_squares.gauss_newton import (
    NormalEquations,
    gauss_newton,
    geman_mcclure,
    point_to_plane_jacobian,
)
from lidarslam.mapping.loam.feature_map import FeatureMap, match_lines, match_planes
from lidarslam.mapping.loam.features import Features
from lidarslam.mapping.motion.measured_pose import MeasuredPose
from lidarslam.mapping.motion.prediction import MotionState
from lidarslam.mapping.tracking.fit import Fit

# Iterations, and the displacement of a point at the mean range that ends them.
_ITERATIONS, _CONVERGED_M = 10, 0.005
# Correspondences are kept over a displacement of this share of the spacing of the map.
_SAME = 0.1
# Tilt of a line or plane at which it counts a quarter: across the corner of a floor and a wall, or with noise as large
# as their spacing, five points make planes of any direction, and these move with the rings.
_TILT = 0.2
_FEWEST_CORRESPONDENCES = 50
# The weight of a residual falls by this for each metre, and vanishes below the least.
_WEIGHT_SLOPE, _LEAST_WEIGHT = 0.9, 0.1
# Standard deviation of a residual, and how many residuals count as one, as their errors are correlated.
_NOISE_M, _CORRELATION = 0.05, 25.0


@dataclass(frozen=True, eq=False)
class FeatureMaps:
    """Local map."""

    edges: FeatureMap
    planes: FeatureMap


@dataclass(frozen=True, eq=False)
class LoamRegistration:
    """A registered sweep."""

    T_world_lidar: FloatArray  # (4, 4) at the stamp
    covariance: FloatArray  # (6, 6) of the pose's error `xi` in `T_true = T_world_lidar @ exp(xi)`, rotation first
    measured: MeasuredPose  # by the correspondences alone
    degeneracy: Degeneracy  # directions along which the prediction was kept
    fit: Fit
    iterations: int  # of Gauss-Newton


def register(
    features: Features, predicted: MotionState, maps: FeatureMaps, most_planes: int
) -> LoamRegistration | None:
    """Register features to the maps by Gauss-Newton; None where there are too few correspondences.

    Along directions that the correspondences at the prediction do not constrain, the prediction is kept: solution
    remapping of Zhang, Kaess and Singh, "On Degeneracy of Optimization-based State Estimation Problems" (ICRA 2016).

    Args:
        features: of the sweep, as measured.
        predicted: start, and velocity that the sweep is compensated with; its covariance becomes that of the result
            along degenerate directions.
        maps: local map.
        most_planes: planar features that are registered, at most, evenly chosen.
    """
    T_predicted = predicted.T_world_lidar
    count = len(features.planes)
    chosen = np.linspace(0, count - 1, min(count, most_planes)).astype(np.intp)
    edges, planes = (sweep.compensated(predicted.velocity) for sweep in (features.edges, features.planes.take(chosen)))
    problem = _Problem(edges, planes, maps, features.spacing_m, T_predicted)
    if not problem.is_constrained:
        return None
    degeneracy = problem.degeneracy()
    held = DEGENERATE_INFORMATION * degeneracy.projector()
    try:
        solution = gauss_newton(
            problem.linearise, T_predicted, T_predicted, held, _ITERATIONS, problem.lever_m, _CONVERGED_M
        )
        if solution is None:
            return None
        along = degeneracy.part_along()
        observed, known = np.eye(6) - along, np.linalg.inv(predicted.covariance[:6, :6])
        measured = observed.T @ (solution[1] - held) @ observed
        covariance = np.asarray(np.linalg.inv(measured + along.T @ known @ along), dtype=np.float64)
    except np.linalg.LinAlgError:  # the correspondences constrain less than they did at the prediction
        return None
    T_world_lidar = orthonormalize(solution[0])
    alone = MeasuredPose.minimum(T_world_lidar, measured, np.zeros(6))
    fit = problem.fit(T_world_lidar)
    return LoamRegistration(T_world_lidar, covariance, alone, degeneracy, fit, problem.iterations)


class _Problem:
    """Residuals of a sweep's features with the lines and planes of the map, at the latest pose."""

    def __init__(
        self, edges: FloatArray, planes: FloatArray, maps: FeatureMaps, spacing_m: float, T_world_lidar: FloatArray
    ) -> None:
        self._edges, self._planes, self._maps, self._spacing_m = edges, planes, maps, spacing_m
        self.iterations = 0
        self._match(T_world_lidar)
        self._evaluate(T_world_lidar)

    @property
    def is_constrained(self) -> bool:
        """Whether there are enough correspondences for a pose."""
        return int(np.count_nonzero(self._weights[self._first])) >= _FEWEST_CORRESPONDENCES

    def degeneracy(self) -> Degeneracy:
        """Directions of motion that the correspondences do not constrain."""
        return find_degeneracy(self._jacobian, self._weights, self._tilt, self.lever_m)

    def fit(self, T_world_lidar: FloatArray) -> Fit:
        """Fit of the features at a pose; that of an edge is by its distance from the line."""
        self._evaluate(T_world_lidar)
        first, features = self._first, len(self._edges) + len(self._planes)
        return Fit.of(self._distances[first], self._normals[first], self._ranges[first], features, self._spacing_m)

    def linearise(self, T_world_lidar: FloatArray) -> NormalEquations | None:
        """Normal equations at a pose; None where there are too few correspondences.

        These are found anew where the features have moved by a share of the map's spacing since they were found.
        """
        self.iterations += 1
        if displacement_m(log(inverse(self._T_matched) @ T_world_lidar), self.lever_m) > _SAME * self._spacing_m:
            self._match(T_world_lidar)
        self._evaluate(T_world_lidar)
        if not self.is_constrained:
            return None
        return NormalEquations.of(self._jacobian, self._residuals, self._weights / (_CORRELATION * _NOISE_M**2))

    def _match(self, T_world_lidar: FloatArray) -> None:
        """Find the correspondences: lines first, two residuals each, then planes."""
        lines = match_lines(transform_points(T_world_lidar, self._edges), self._maps.edges)
        planes = match_planes(transform_points(T_world_lidar, self._planes), self._maps.planes)
        self._across_lines = len(lines.index)
        self._features = np.concatenate([self._edges[lines.index], self._planes[planes.index]])
        self._points = np.concatenate([lines.points, planes.points])
        self._normals = np.concatenate([lines.normals, planes.normals])
        self._tilt = np.concatenate([lines.tilt, planes.tilt])
        self._quality = geman_mcclure(self._tilt, _TILT**2)
        # The first residual of each feature.
        self._first = np.concatenate([np.arange(0, len(lines.index), 2), np.arange(len(lines.index), len(self._tilt))])
        self._ranges = np.sqrt(np.einsum("ij,ij->i", self._features, self._features))
        self.lever_m = float(np.sqrt(np.mean(self._ranges**2))) if len(self._ranges) else 0.0
        self._T_matched = T_world_lidar

    def _evaluate(self, T_world_lidar: FloatArray) -> None:
        """Residuals, their Jacobian, distances from lines and planes, and weights at a pose."""
        world, lines = transform_points(T_world_lidar, self._features), slice(0, self._across_lines)
        self._residuals = np.einsum("ij,ij->i", world - self._points, self._normals)
        self._jacobian = point_to_plane_jacobian(self._features, self._normals @ T_world_lidar[:3, :3])
        self._distances = np.abs(self._residuals)
        self._distances[lines] = np.hypot(self._residuals[lines][0::2], self._residuals[lines][1::2]).repeat(2)
        # Planes count by the distance per root of the range: near ones less.
        sizes = self._distances / np.sqrt(self._ranges)
        sizes[lines] = self._distances[lines]
        weights = 1.0 - _WEIGHT_SLOPE * sizes
        self._weights = self._quality * np.where(weights > _LEAST_WEIGHT, weights, 0.0) ** 2
