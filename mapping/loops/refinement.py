"""Fine registration of a loop closure: dense submaps, symmetric point-to-plane ICP.

Planes fitted to the few thousand points of verification are biased by the scan pattern, by centimetres, and equally for
all closures along a street, which does not average out. An accepted closure is registered again on all points of
both submaps and their neighbours. Residuals are taken from planes of either side to points of the other: the bias of
sampling has opposite signs in the two directions.

Open3D's point-to-plane ICP with the same kernel and gates is as accurate (`docs/measurements/open3d.md`). It takes 1.5
to 1.9 times as long, and has no prior, which holds the pose where the surfaces leave a direction free.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, inverse, log, orthonormalize, transform_points
from lidarslam.core.thinning import central_per_cell
from lidarslam.mapping.loops.closure import CHI_SQUARED_99, LoopClosure
from lidarslam.mapping.loops.sparse_submap import principal_components
from lidarslam.mapping.loops.verification import CORRELATION
from lidarslam.mapping.registration.gauss_newton import (
    NormalEquations,
    gauss_newton,
    geman_mcclure,
    point_to_plane_jacobian,
)

# Planes are fitted to this many nearest points, wherever they lie: leaving out non-planar ones biases the result.
_NEIGHBOURS = 12
_MAX_PLANES = 3000
# Gate of correspondences, in cells, and most Gauss-Newton steps, level after level; scale of the robust kernel.
_LEVELS = ((2.0, 8), (1.0, 12))
_KERNEL = 0.3
_CONVERGED_M = 5e-4
_LEAST_RESIDUALS = 100
# Every surface has residuals in both directions.
_CORRELATION = 2.0 * CORRELATION


@dataclass(frozen=True, eq=False)
class DenseSubmap:
    """All points around a keyframe and planes through some of them, in its LiDAR frame."""

    points: FloatArray  # (N, 3)
    tree: cKDTree  # of the points
    # centroids, normals: (M, 3) of the planes
    centroids: FloatArray
    normals: FloatArray
    cell_m: float  # the size of detail that suits the scene

    @classmethod
    def join(cls, submaps: Sequence[tuple[FloatArray, FloatArray]], max_range_m: float, cell_m: float) -> "DenseSubmap":
        """Unite submaps, each with `T_keyframe_submap` (4, 4) and points (N, 3) in its own frame."""
        points = np.concatenate([transform_points(T, points) for T, points in submaps])
        points = points[np.einsum("ij,ij->i", points, points) <= max_range_m**2]
        points = points[central_per_cell(points, 0.5 * cell_m)]
        tree = cKDTree(points, balanced_tree=False)
        if len(points) < _NEIGHBOURS:
            return cls(points, tree, np.empty((0, 3)), np.empty((0, 3)), cell_m)
        chosen = np.linspace(0, len(points) - 1, min(len(points), _MAX_PLANES)).astype(np.intp)
        centroids, _, axes = principal_components(points, tree, points[chosen], _NEIGHBOURS)
        return cls(points, tree, centroids, axes[:, :, 0], cell_m)


def refine(target: DenseSubmap, source: DenseSubmap, closure: LoopClosure, drift: FloatArray) -> LoopClosure | None:
    """Register again, with the closure as prior; None where correspondences are too few, or contradict the prior.

    Drift (6, 6) within the two submaps is added to the covariance of the result: no number of points lowers it.
    """
    prior = closure.T_first_second
    information = np.asarray(np.linalg.inv(closure.covariance), dtype=np.float64)
    cell_m = max(target.cell_m, source.cell_m)
    T, hessian = prior, information
    for gate, most in _LEVELS:
        linearise = partial(_linearise, target, source, gate * cell_m, _KERNEL * cell_m)
        found = gauss_newton(linearise, T, prior, information, most, cell_m, _CONVERGED_M)
        if found is None:
            return None
        T, hessian = found
    away = log(inverse(prior) @ T)
    if not away @ information @ away < CHI_SQUARED_99:
        return None
    return replace(closure, T_first_second=orthonormalize(T), covariance=np.linalg.inv(hessian) + drift)


def _linearise(
    target: DenseSubmap, source: DenseSubmap, gate_m: float, scale_m: float, T_target_source: FloatArray
) -> NormalEquations | None:
    """Planes of the target to points of the source, and of the source to points of the target."""
    T_source_target = inverse(T_target_source)
    planes, found = _match(target, source, T_source_target, gate_m)
    points = source.points[found]
    normals = target.normals[planes] @ T_target_source[:3, :3]
    off = points - transform_points(T_source_target, target.centroids[planes])
    own, found = _match(source, target, T_target_source, gate_m)
    there, own_normals = transform_points(T_source_target, target.points[found]), source.normals[own]
    residuals = np.concatenate([
        np.einsum("ij,ij->i", off, normals), np.einsum("ij,ij->i", there - source.centroids[own], own_normals)
    ])  # fmt: skip
    if len(residuals) < _LEAST_RESIDUALS:
        return None
    forward = point_to_plane_jacobian(points, normals)
    backward = -point_to_plane_jacobian(there, own_normals)
    weights = geman_mcclure(residuals, scale_m**2)
    variance = float(weights @ residuals**2 / weights.sum())
    return NormalEquations.of(
        np.concatenate([forward, backward]), residuals, weights / (_CORRELATION * max(variance, 1e-8))
    )


def _match(
    planes_of: DenseSubmap, points_of: DenseSubmap, T_points_planes: FloatArray, gate_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Planes of one side, and for each the nearest point of the other within the gate."""
    moved = transform_points(T_points_planes, planes_of.centroids)
    distances, found = points_of.tree.query(moved, distance_upper_bound=gate_m, workers=1)
    near = np.flatnonzero(np.isfinite(distances))
    return near, np.asarray(found, dtype=np.intp)[near]
