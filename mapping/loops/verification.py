"""Registration of loop closures: verification of candidates on sparse submaps, refinement of loops on dense ones.

A candidate is registered point to plane and point to line, coarse to fine, then judged by the inliers among the points
that either side sees. In a row of similar rooms, and along any corridor, most surfaces fit though the pose is wrong. So
the inliers must carry most of the information on every direction of translation, the weakest too.

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
from lidarslam.core.thinning import central_per_cell, one_per_cell
from lidarslam.mapping.loops.closure import CHI_SQUARED_99, LoopClosure
from lidarslam.mapping.loops.sparse_submap import LINE, SparseSubmap, principal_components
from lidarslam.mapping.registration.gauss_newton import (
    NormalEquations,
    find_degeneracy,
    gauss_newton,
    geman_mcclure,
    point_to_plane_jacobian,
)

# Level after level: reach of correspondences and scale of the kernel, in cells; stride of the points; most steps.
_LEVELS = ((12.0, 4.0, 4, 8), (6.0, 2.0, 2, 6), (4.0, 1.0, 1, 4), (3.0, 0.5, 1, 8))
_SETTLED = 0.02  # of a cell
# Cosine between normals of one surface.
_LEAST_AGREEMENT = 0.6
_LINE_NOISE_M = 0.08
_RANGE_NOISE_M = 0.02
# Residuals of neighbouring points are correlated: this many count as one. From true errors on simulated rounds.
CORRELATION = 25.0
_MIN_POINTS = 12
# Standard deviations of a candidate's guess, radians and metres.
GUESS_SIGMAS = np.array([0.2] * 3 + [2.0] * 3)
# Largest residual of an inlier, in cells and at least in metres, and largest distance of its correspondence.
_GATE = 0.3
_GATE_MIN_M = 0.06
_REACH = 4.0
_REACH_PER_RANGE = 0.06
# No closure is more precise than this: radians and metres.
_LEAST_SIGMAS = np.array([np.deg2rad(0.15)] * 3 + [0.015] * 3)
# Points constrain a direction that their normals face by more than noise would; at least this many must.
_FACING = 0.3
_LEAST_FACING = 10
# Where less than this share of a direction's information is in view, too little is known of it.
_MUCH_IN_VIEW = 0.3
# Limits of a closure, chosen on the simulated rounds of `benchmarks/loop_closures.py`, where none accepted was false.
_MIN_INFORMATION = 0.55
_MIN_INLIER_RATIO = 0.2
MIN_INLIERS = 150
_MAX_SIGMA_M = 0.25
_MAX_SIGMA_DEG = 2.0


@dataclass(frozen=True, eq=False)
class SubmapCloud:
    """A sparse submap united with its neighbours, in its keyframe's LiDAR frame; only points on planes and lines."""

    submap: SparseSubmap  # the keyframe's own
    # points, axes: (N, 3)
    points: FloatArray
    axes: FloatArray
    tilt: FloatArray  # (N,)
    is_line: NDArray[np.bool_]  # (N,)
    ahead_m: FloatArray  # (N,) path from the keyframe to that of a point, where the drifting estimates place it
    drift_rates: tuple[float, float]  # standard deviations of that drift per metre, radians and metres
    middle_m: float  # path over which a submap is drawn after its keyframe, on average
    tree: cKDTree  # of the points

    @classmethod
    def join(
        cls, submap: SparseSubmap, neighbours: Sequence[tuple[FloatArray, SparseSubmap]] = (),
        ways_m: Sequence[float] = (), drift_rates: tuple[float, float] = (0.0, 0.0),
    ) -> "SubmapCloud":  # fmt: skip
        """Unite with neighbours, each with `T_keyframe_neighbour` (4, 4) and the path to it; back is negative."""
        parts = []
        for (T, part), way_m in zip([(np.eye(4), submap), *neighbours], [0.0, *ways_m], strict=True):
            used = part.kinds > 0
            points = transform_points(T, part.points[used].astype(float))
            axes, tilt = part.axes[used].astype(float) @ T[:3, :3].T, part.tilt[used].astype(float)
            parts.append((points, axes, tilt, part.kinds[used] == LINE, np.full(len(points), way_m)))
        points, axes, *others = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        kept = one_per_cell(points, 1.5 * submap.cell_m)
        points, axes = points[kept], axes[kept]
        axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-12)
        middle_m = 0.5 * min((abs(way_m) for way_m in ways_m), default=0.0)
        tilt, is_line, ahead_m = (values[kept] for values in others)
        tree = cKDTree(points, balanced_tree=False)
        return cls(submap, points, axes, tilt, is_line, ahead_m, drift_rates, middle_m, tree)


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Residuals of points to planes, one each, and to lines, two each."""

    points: FloatArray  # (M, 3) of the source, in its frame
    normals: FloatArray  # (M, 3) directions of the residuals, in the source's frame
    residuals: FloatArray  # (M,)
    tilt: FloatArray  # (M,) of the target's axes
    noise_m: FloatArray  # (M,)
    ahead_m: FloatArray  # (M, 2) of the target's and the source's points
    drift_rates: tuple[float, float]  # as in `SubmapCloud`

    @property
    def weights(self) -> FloatArray:
        """(M,) relative to a correspondence of both keyframes' own submaps: drift displaces neighbours."""
        turned, shifted = self.drift_rates
        squared = shifted**2 + turned**2 * np.einsum("ij,ij->i", self.points, self.points)
        squared *= np.einsum("ij,ij->i", self.ahead_m, self.ahead_m)
        return np.asarray(self.noise_m**2 / (self.noise_m**2 + squared))

    @property
    def jacobian(self) -> FloatArray:
        """(M, 6) for a motion of the source from the right, rotation first."""
        return point_to_plane_jacobian(self.points, self.normals)


def register(target: SubmapCloud, source: SubmapCloud, guess: FloatArray) -> FloatArray | None:
    """`T_target_source` (4, 4) from a guess, coarse to fine; None when too few points have correspondences."""
    cell_m = max(target.submap.cell_m, source.submap.cell_m)
    T, prior_information = guess, np.diag(GUESS_SIGMAS**-2)
    for reach, kernel, step, most in _LEVELS:
        scale_m = kernel * cell_m
        linearise = partial(_linearise, target, source, np.arange(0, len(source.points), step), reach * cell_m, scale_m)
        settled_m = _SETTLED * scale_m
        found = gauss_newton(linearise, T, guess, prior_information, most, source.submap.range_m, settled_m)
        if found is None:
            return None
        T, _ = found
    return orthonormalize(T)


def _linearise(
    target: SubmapCloud, source: SubmapCloud, chosen: NDArray[np.intp], reach_m: float, scale_m: float,
    T_target_source: FloatArray,
) -> NormalEquations | None:  # fmt: skip
    found = correspondences(target, source, T_target_source, chosen, reach_m)
    if len(found.points) < _MIN_POINTS:
        return None
    information = found.weights * geman_mcclure(found.residuals, scale_m**2)
    information /= CORRELATION * (found.noise_m**2 + (0.5 * scale_m) ** 2)
    return NormalEquations.of(found.jacobian, found.residuals, information)


def match(
    target: SubmapCloud, source: SubmapCloud, T: FloatArray, chosen: NDArray[np.intp], reach_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of source and target points within reach whose axes may be of the same surface."""
    distances, found = target.tree.query(
        transform_points(T, source.points[chosen]), distance_upper_bound=reach_m, workers=1
    )
    near = np.isfinite(distances)
    s, t = chosen[near], np.asarray(found)[near]
    both_planes = ~source.is_line[s] & ~target.is_line[t]
    agreement = np.einsum("ij,ij->i", source.axes[s] @ T[:3, :3].T, target.axes[t])
    both_lines = source.is_line[s] & target.is_line[t]
    alike = np.where(both_planes, agreement, np.where(both_lines, np.abs(agreement), 1.0)) > _LEAST_AGREEMENT
    return s[alike], t[alike]


def correspondences(
    target: SubmapCloud, source: SubmapCloud, T: FloatArray, chosen: NDArray[np.intp], reach_m: float
) -> Correspondences:
    """Of the chosen source points within reach, at `T_target_source` (4, 4)."""
    s, t = match(target, source, T, chosen, reach_m)
    is_line = target.is_line[t]
    line = target.axes[t[is_line]]
    least = np.eye(3)[np.abs(line).argmin(axis=1)]
    across = np.cross(line, least)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normals = np.concatenate([target.axes[t[~is_line]], across, np.cross(line, across)])
    s = np.concatenate([s[~is_line], s[is_line], s[is_line]])
    t = np.concatenate([t[~is_line], t[is_line], t[is_line]])
    residuals = np.einsum("ij,ij->i", transform_points(T, source.points[s]) - target.points[t], normals)
    noise_m = np.where(target.is_line[t], _LINE_NOISE_M, _RANGE_NOISE_M)
    ahead_m = np.stack([target.ahead_m[t], source.ahead_m[s]], axis=1)
    return Correspondences(
        source.points[s], normals @ T[:3, :3], residuals, target.tilt[t], noise_m, ahead_m, source.drift_rates
    )


@dataclass(frozen=True, eq=False)
class Verification:
    """A registered candidate."""

    T_target_source: FloatArray  # (4, 4)
    # (6, 6) of xi in `T_true = T_target_source @ exp(xi)`; that of the guess along degenerate directions
    covariance: FloatArray
    overlap: float  # inliers among the points that either side sees of the other; the worse side
    information: float  # the same, weighed by information, for the direction of translation with the least share
    residual_m: float  # root mean square residual of the inliers
    inlier_ratio: float  # inliers among the source's points
    inliers: int  # their number
    degenerate: tuple[str, ...]  # names of the degenerate directions of motion

    def objection(self, min_overlap: float) -> str:
        """Why it is rejected; empty when it is not."""
        sigma_m, sigma_rad = (
            np.sqrt(np.linalg.eigvalsh(self.covariance[part, part])[-1]) for part in (slice(3, 6), slice(0, 3))
        )
        if self.inliers < MIN_INLIERS:
            return f"only {self.inliers} inliers"
        if self.inlier_ratio < _MIN_INLIER_RATIO:
            return f"only {100.0 * self.inlier_ratio:.0f} % of the points are inliers"
        if self.overlap < min_overlap:
            return f"only {100.0 * self.overlap:.0f} % of the points in view are inliers"
        if self.information < _MIN_INFORMATION:
            return f"inliers have only {100.0 * self.information:.0f} % of the information on the weakest direction"
        if sigma_m > _MAX_SIGMA_M or sigma_rad > np.deg2rad(_MAX_SIGMA_DEG):
            names = ", ".join(self.degenerate) or "the pose"
            return f"degenerate in {names}: standard deviation {sigma_m:.2f} m, {np.rad2deg(sigma_rad):.1f} degrees"
        return ""


def verify(target: SubmapCloud, source: SubmapCloud, guess: FloatArray) -> Verification | None:
    """Register the source on the target from a guess (4, 4), and evaluate; None where correspondences are too few."""
    if min(len(target.points), len(source.points)) < _MIN_POINTS:
        return None
    T = register(target, source, guess)
    return None if T is None else evaluate(target, source, T)


def evaluate(target: SubmapCloud, source: SubmapCloud, T_target_source: FloatArray) -> Verification:
    """Inliers and covariance at a pose (4, 4)."""
    T = T_target_source
    inliers, overlap, information = _fit(target, source, T)
    _, overlap_back, information_back = _fit(source, target, inverse(T))
    cell_m = max(target.submap.cell_m, source.submap.cell_m)
    found = correspondences(target, source, T, np.flatnonzero(inliers), _REACH * cell_m)
    residual_m = float(np.sqrt(np.mean(found.residuals**2))) if len(found.residuals) else np.inf
    covariance, names = _covariance(found, residual_m, np.array([target.middle_m, source.middle_m]))
    return Verification(
        T, covariance, min(overlap, overlap_back), min(information, information_back), residual_m,
        float(inliers.mean()), int(inliers.sum()), names,
    )  # fmt: skip


def _covariance(found: Correspondences, residual_m: float, middles_m: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
    """(6, 6) without the degenerate directions, and the names of these, given the middles (2,) of target and source."""
    weights = found.weights / np.maximum(found.noise_m, residual_m) ** 2
    lever_m = float(np.sqrt(np.mean(np.sum(found.points**2, axis=1)))) if len(found.points) else 1.0
    degeneracy = find_degeneracy(found.jacobian, weights, found.tilt, lever_m)
    J = found.jacobian @ (np.eye(6) - degeneracy.part_along())
    information = NormalEquations.of(J, found.residuals, weights / CORRELATION).hessian + np.diag(GUESS_SIGMAS**-2)
    variances = _LEAST_SIGMAS**2
    if len(weights):
        # Drift between a keyframe and its neighbours is common to all their points, and does not average out. It is
        # the length of an error; each axis has a third of its square.
        ways_m = np.average(found.ahead_m, axis=0, weights=weights) + middles_m
        turned, shifted = found.drift_rates
        variances = variances + np.repeat([turned**2, shifted**2], 3) * float(ways_m @ ways_m) / 3.0
    return np.asarray(np.linalg.inv(information) + np.diag(variances), dtype=np.float64), degeneracy.names


def _fit(target: SubmapCloud, source: SubmapCloud, T: FloatArray) -> tuple[NDArray[np.bool_], float, float]:
    """Inliers (N,) of the source, and their share of what the target sees of it, plainly and by information."""
    cell_m = max(target.submap.cell_m, source.submap.cell_m)
    gate_m = max(_GATE * cell_m, _GATE_MIN_M)
    there = transform_points(T, source.points)
    ranges = np.linalg.norm(there, axis=1)
    reach_m = np.maximum(_REACH * cell_m, _REACH_PER_RANGE * ranges)
    s, t = match(target, source, T, np.arange(len(there)), float(reach_m.max(initial=0.0)))
    apart = there[s] - target.points[t]
    along = np.einsum("ij,ij->i", apart, target.axes[t])
    squared = np.einsum("ij,ij->i", apart, apart)
    off = np.where(target.is_line[t], np.sqrt(np.maximum(squared - along**2, 0.0)) - _LINE_NOISE_M, np.abs(along))
    inliers = np.zeros(len(there), dtype=bool)
    inliers[s[(off < gate_m) & (squared < reach_m[s] ** 2)]] = True
    # The other side should have seen a point that is nearer than the nearest range that it saw in its direction.
    seen = target.submap.nearest_ranges(there)
    in_view = inliers | ((seen > 0.0) & (ranges < seen + gate_m))
    overlap = float(inliers.sum() / max(in_view.sum(), 1))
    return inliers, overlap, _information_share(source, inliers, in_view)


def _information_share(source: SubmapCloud, inliers: NDArray[np.bool_], in_view: NDArray[np.bool_]) -> float:
    """The least ratio, over directions, of the inliers' information on translation to that of all points in view.

    Directions are the eigenvectors of the information of the points in view, and of the outliers among them.
    """
    normals, lines = source.axes[~source.is_line], source.axes[source.is_line]
    order = np.concatenate([np.flatnonzero(~source.is_line), np.flatnonzero(source.is_line)])
    ratios = [1.0]
    for chosen in (in_view, in_view & ~inliers):
        p, d = source.axes[chosen & ~source.is_line], source.axes[chosen & source.is_line]
        _, directions = np.linalg.eigh(p.T @ p + len(d) * np.eye(3) - d.T @ d)
        squares = np.concatenate([(normals @ directions) ** 2, 1.0 - (lines @ directions) ** 2])
        squares[squares < _FACING**2] = 0.0
        everything, seen, matched = squares.sum(axis=0), in_view[order] @ squares, inliers[order] @ squares
        much = np.minimum(1.0, seen / (_MUCH_IN_VIEW * np.maximum(everything, 1e-9)))
        ratios += list((much * matched / np.maximum(seen, 1e-9))[everything > _LEAST_FACING])
    return float(min(ratios))


# Planes are fitted to this many nearest points, wherever they lie: leaving out non-planar ones biases the result.
_NEIGHBOURS = 12
_MAX_PLANES = 3000
# Gate of correspondences, in cells, and most Gauss-Newton steps, level after level; scale of the robust kernel.
_FINE_LEVELS = ((2.0, 8), (1.0, 12))
_FINE_KERNEL = 0.3
_CONVERGED_M = 5e-4
_LEAST_RESIDUALS = 100
# Every surface has residuals in both directions.
_FINE_CORRELATION = 2.0 * CORRELATION


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
    for gate, most in _FINE_LEVELS:
        linearise = partial(_linearise_both, target, source, gate * cell_m, _FINE_KERNEL * cell_m)
        found = gauss_newton(linearise, T, prior, information, most, cell_m, _CONVERGED_M)
        if found is None:
            return None
        T, hessian = found
    away = log(inverse(prior) @ T)
    if not away @ information @ away < CHI_SQUARED_99:
        return None
    return replace(closure, T_first_second=orthonormalize(T), covariance=np.linalg.inv(hessian) + drift)


def _linearise_both(
    target: DenseSubmap, source: DenseSubmap, gate_m: float, scale_m: float, T_target_source: FloatArray
) -> NormalEquations | None:
    """Planes of the target to points of the source, and of the source to points of the target."""
    T_source_target = inverse(T_target_source)
    planes, found = _nearest_points(target, source, T_source_target, gate_m)
    points = source.points[found]
    normals = target.normals[planes] @ T_target_source[:3, :3]
    off = points - transform_points(T_source_target, target.centroids[planes])
    own, found = _nearest_points(source, target, T_target_source, gate_m)
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
        np.concatenate([forward, backward]), residuals, weights / (_FINE_CORRELATION * max(variance, 1e-8))
    )


def _nearest_points(
    planes_of: DenseSubmap, points_of: DenseSubmap, T_points_planes: FloatArray, gate_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Planes of one side, and for each the nearest point of the other within the gate."""
    moved = transform_points(T_points_planes, planes_of.centroids)
    distances, found = points_of.tree.query(moved, distance_upper_bound=gate_m, workers=1)
    near = np.flatnonzero(np.isfinite(distances))
    return near, np.asarray(found, dtype=np.intp)[near]
