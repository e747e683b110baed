"""Registration of edge and planar features to their maps (Zhang and Singh, "LOAM", RSS 2014, section VI)."""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.degeneracy import Degeneracy
from lidarslam.core.geometry import FloatArray, orthonormalize, transform_points
from mapping.degeneracy import find_degeneracy
from mapping.gauss_newton import NormalEquations, gauss_newton, point_to_plane_jacobian
from mapping.loam.feature_map import Correspondences, FeatureMap, match_lines, match_planes
from mapping.tracking.fit import Fit

# Iterations, each with new correspondences, and the displacement of a point at the mean range that ends them.
_ITERATIONS, _CONVERGED_M = 10, 0.005
_FEWEST_CORRESPONDENCES = 50
# The weight of a residual falls by this for each metre, and vanishes below the least.
_WEIGHT_SLOPE, _LEAST_WEIGHT = 0.9, 0.1
# Standard deviation of a residual, and how many residuals count as one, as their errors are correlated.
_NOISE_M, _CORRELATION = 0.05, 25.0
# Information of the prediction along degenerate directions: that of a tenth of a millimetre.
_DEGENERATE_INFORMATION = 1e8


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
    degeneracy: Degeneracy  # directions along which the prediction was kept
    fit: Fit


def register(
    edges: FloatArray, planes: FloatArray, T_predicted: FloatArray, covariance: FloatArray, maps: FeatureMaps,
    spacing_m: float,
) -> LoamRegistration | None:  # fmt: skip
    """Register features to the maps by Gauss-Newton; None where there are too few correspondences.

    Along directions that the correspondences at the prediction do not constrain, the prediction is kept: solution
    remapping of Zhang, Kaess and Singh, "On Degeneracy of Optimization-based State Estimation Problems" (ICRA 2016).

    Args:
        edges, planes: (N, 3) and (M, 3), compensated, in the LiDAR frame.
        T_predicted: (4, 4) predicted pose.
        covariance: (6, 6) of the prediction, which becomes that of the pose along degenerate directions.
        maps: local map.
        spacing_m: of its points.
    """
    problem = _Problem(edges, planes, maps, T_predicted)
    if not problem.is_constrained:
        return None
    degeneracy = problem.degeneracy()
    held = _DEGENERATE_INFORMATION * degeneracy.projector()
    try:
        solution = gauss_newton(
            problem.linearise, T_predicted, T_predicted, held, _ITERATIONS, problem.lever_m, _CONVERGED_M
        )
    except np.linalg.LinAlgError:  # all correspondences on one line
        return None
    if solution is None:
        return None
    points = len(edges) + len(planes)
    fit = Fit.of(np.abs(problem.residuals), problem.normals, problem.ranges, points, spacing_m)
    fit = replace(fit, matched=problem.matched, overlap=problem.matched / points)  # an edge has two residuals
    along = degeneracy.part_along()
    observed = np.eye(6) - along
    information = observed.T @ (solution[1] - held) @ observed + along.T @ np.linalg.inv(covariance) @ along
    pose_covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return LoamRegistration(orthonormalize(solution[0]), pose_covariance, degeneracy, fit)


class _Problem:
    """Residuals of a sweep's features with the lines and planes of the map, at the latest pose."""

    def __init__(self, edges: FloatArray, planes: FloatArray, maps: FeatureMaps, T_world_lidar: FloatArray) -> None:
        self._edges, self._planes, self._maps = edges, planes, maps
        self._match(T_world_lidar)

    @property
    def is_constrained(self) -> bool:
        """Whether there are enough correspondences for a pose."""
        return int(np.count_nonzero(self.weights)) >= _FEWEST_CORRESPONDENCES

    @property
    def lever_m(self) -> float:
        """Root mean square range of the matched features."""
        return float(np.sqrt(np.mean(self.ranges**2)))

    def degeneracy(self) -> Degeneracy:
        """Directions of motion that the correspondences do not constrain."""
        return find_degeneracy(self.jacobian, self.weights, self.tilt, self.lever_m)

    def linearise(self, T_world_lidar: FloatArray) -> NormalEquations | None:
        """Normal equations at a pose, with new correspondences; None where these are too few."""
        if T_world_lidar is not self._T_world_lidar:
            self._match(T_world_lidar)
        if not self.is_constrained:
            return None
        return NormalEquations.of(self.jacobian, self.residuals, self.weights / (_CORRELATION * _NOISE_M**2))

    def _match(self, T_world_lidar: FloatArray) -> None:
        self._T_world_lidar = T_world_lidar
        world = transform_points(T_world_lidar, self._edges), transform_points(T_world_lidar, self._planes)
        lines, planes = match_lines(world[0], self._maps.edges), match_planes(world[1], self._maps.planes)
        points = np.concatenate([self._edges[lines.index], self._planes[planes.index]])
        across, apart = _residuals(world[0], lines), _residuals(world[1], planes)
        self.matched = len(across) // 2 + len(apart)  # features
        self.residuals = np.concatenate([across, apart])
        self.normals = np.concatenate([lines.normals, planes.normals])
        self.tilt = np.concatenate([lines.tilt, planes.tilt])
        self.ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
        self.jacobian = point_to_plane_jacobian(points, self.normals @ T_world_lidar[:3, :3])
        # A residual with a plane counts less when the feature is near: its weight is by the distance per root range.
        sizes = np.abs(self.residuals) / np.sqrt(self.ranges)
        sizes[: len(across)] = np.hypot(across[0::2], across[1::2]).repeat(2)
        weights = 1.0 - _WEIGHT_SLOPE * sizes
        self.weights = np.where(weights > _LEAST_WEIGHT, weights, 0.0) ** 2


def _residuals(world: FloatArray, matches: Correspondences) -> FloatArray:
    """Signed distances (M,) of matched features, of (N, 3) in the world, along the normals."""
    return np.asarray(np.einsum("ij,ij->i", world[matches.index] - matches.points, matches.normals), dtype=np.float64)
