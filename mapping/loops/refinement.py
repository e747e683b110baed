"""Fine registration of a loop closure: dense submaps, point-to-plane in both directions.

Verification registers a few thousand points of each keyframe, enough to tell whether two places are the same. Planes
fitted to points that sparse are biased by the scan pattern, by centimetres, and alike for all closures along a street,
so that they do not average out. An accepted closure is therefore registered again on all points of both submaps and
their neighbours. Residuals are taken from planes of either side to points of the other: what sampling does to one
direction it does to the other with the opposite sign.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, exp, inverse, log, orthonormalize, transform_points
from lidarslam.core.thinning import central_per_cell

# Planes are fitted to so many nearest points, wherever they lie: to leave out what is not flat biases the result.
_NEIGHBOURS = 12
_MAX_PLANES = 3000
# Gate of correspondences and most Gauss-Newton iterations, level after level; scale of the robust kernel; in cells.
_LEVELS = ((2.0, 8), (1.0, 12))
_KERNEL = 0.3
_CONVERGED_M = 5e-4
_LEAST_PLANES = 100
# Residuals of neighbouring points are correlated: so many count as one.
_CORRELATION = 50.0
# A refinement farther from the verified pose is of something else: 99 % of six degrees of freedom are less.
_MOST_SQUARED = 16.8


@dataclass(frozen=True, eq=False)
class DenseSubmap:
    """All points around a keyframe and planes through some of them, in its LiDAR frame.

    Attributes:
        points: (N, 3).
        tree: of the points.
        centroids, normals: (M, 3) of the planes.
        cell_m: the size of detail that suits the scene.
    """

    points: FloatArray
    tree: cKDTree
    centroids: FloatArray
    normals: FloatArray
    cell_m: float

    @classmethod
    def join(cls, submaps: Sequence[tuple[FloatArray, FloatArray]], max_range_m: float, cell_m: float) -> "DenseSubmap":
        """Unite submaps, each with `T_keyframe_submap` (4, 4) and points (N, 3) in its own frame."""
        points = np.concatenate([transform_points(T, points) for T, points in submaps])
        points = points[np.einsum("ij,ij->i", points, points) <= max_range_m**2]
        points = points[central_per_cell(points, 0.5 * cell_m)]
        tree = cKDTree(points, balanced_tree=False)
        centroids, normals = _planes(points, tree)
        return cls(points, tree, centroids, normals, cell_m)


def _planes(points: FloatArray, tree: cKDTree) -> tuple[FloatArray, FloatArray]:
    """Centroids and normals (M, 3) of planes through the neighbourhoods of points (N, 3), evenly chosen."""
    if len(points) < _NEIGHBOURS:
        return np.empty((0, 3)), np.empty((0, 3))
    chosen = np.linspace(0, len(points) - 1, min(len(points), _MAX_PLANES)).astype(np.intp)
    _, found = tree.query(points[chosen], k=_NEIGHBOURS, workers=1)
    around = points[found]
    centroids = around.mean(axis=1)
    around -= centroids[:, None]
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    return centroids, axes[:, :, 0]


@dataclass(frozen=True, eq=False)
class _System:
    """Residuals (M,) and their Jacobian (M, 6) for a motion of the source from the right, rotation first."""

    residuals: FloatArray
    jacobian: FloatArray

    @classmethod
    def at(cls, target: DenseSubmap, source: DenseSubmap, T_target_source: FloatArray, gate_m: float) -> "_System":
        """Planes of the target to points of the source, and of the source to points of the target."""
        T_source_target = inverse(T_target_source)
        planes, found = _correspondences(target, source, T_source_target, gate_m)
        points = source.points[found]
        along = target.normals[planes] @ T_target_source[:3, :3]
        off = points - transform_points(T_source_target, target.centroids[planes])
        ours, found = _correspondences(source, target, T_target_source, gate_m)
        there, normals = transform_points(T_source_target, target.points[found]), source.normals[ours]
        residuals = [np.einsum("ij,ij->i", off, along), np.einsum("ij,ij->i", there - source.centroids[ours], normals)]
        forward = np.concatenate([np.cross(points, along), along], axis=1)
        backward = -np.concatenate([np.cross(there, normals), normals], axis=1)
        return cls(np.concatenate(residuals), np.concatenate([forward, backward]))


def _correspondences(
    planes_of: DenseSubmap, points_of: DenseSubmap, T_points_planes: FloatArray, gate_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Planes of one side, and of each the nearest point of the other within the gate."""
    moved = transform_points(T_points_planes, planes_of.centroids)
    distances, found = points_of.tree.query(moved, distance_upper_bound=gate_m, workers=1)
    near = np.flatnonzero(np.isfinite(distances))
    return near, np.asarray(found, dtype=np.intp)[near]


@dataclass(frozen=True, eq=False)
class Refined:
    """A registration: `T_target_source` (4, 4), and the covariance (6, 6) of xi in `T_true = T @ exp(xi)`."""

    T_target_source: FloatArray
    covariance: FloatArray


def refine(
    target: DenseSubmap, source: DenseSubmap, T_target_source: FloatArray, covariance: FloatArray, drift: FloatArray
) -> Refined | None:
    """Register again from a verified pose (4, 4), which is the prior with its covariance (6, 6).

    Drift (6, 6) within the two submaps is added to the covariance of the result: no number of points lowers it. None
    where too few planes meet a point, or where the result contradicts the verified pose.
    """
    information, cell_m = np.linalg.inv(covariance), max(target.cell_m, source.cell_m)
    guess = T = T_target_source
    normal_matrix = information
    for gate, most in _LEVELS:
        for _ in range(most):
            system = _System.at(target, source, T, gate * cell_m)
            if len(system.residuals) < _LEAST_PLANES:
                return None
            away = log(inverse(guess) @ T)
            normal_matrix, gradient = _normal_equations(system, _KERNEL * cell_m)
            xi = np.linalg.solve(normal_matrix + information, -gradient - information @ away)
            T = T @ exp(xi)
            if np.linalg.norm(xi[3:]) + cell_m * np.linalg.norm(xi[:3]) < _CONVERGED_M:
                break
    away = log(inverse(guess) @ T)
    if not away @ information @ away < _MOST_SQUARED:
        return None
    return Refined(orthonormalize(T), np.linalg.inv(normal_matrix + information) + drift)


def _normal_equations(system: _System, scale_m: float) -> tuple[FloatArray, FloatArray]:
    """Information (6, 6) and gradient (6,) under the kernel of Geman and McClure; residuals weigh by their spread."""
    r, J = system.residuals, system.jacobian
    weights = (1.0 + (r / scale_m) ** 2) ** -2
    variance = float(weights @ r**2 / weights.sum())
    JW = J * (weights / (_CORRELATION * max(variance, 1e-8)))[:, None]
    return JW.T @ J, JW.T @ r
