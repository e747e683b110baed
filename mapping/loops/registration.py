"""Point-to-plane and point-to-line registration of sparse submaps, coarse to fine."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, orthonormalize, transform_points
from lidarslam.core.thinning import one_per_cell
from lidarslam.mapping.loops.sparse_submap import LINE, SparseSubmap
from lidarslam.mapping.registration.gauss_newton import (
    NormalEquations,
    gauss_newton,
    geman_mcclure,
    point_to_plane_jacobian,
)

# Level after level: reach of correspondences and scale of the kernel, in cells; one point in so many; most steps.
_LEVELS = ((12.0, 4.0, 4, 8), (6.0, 2.0, 2, 6), (4.0, 1.0, 1, 4), (3.0, 0.5, 1, 8))
_SETTLED = 0.02  # of a cell
# Cosine between normals of one surface.
_LEAST_AGREEMENT = 0.6
LINE_NOISE_M = 0.08
_RANGE_NOISE_M = 0.02
# Residuals of neighbouring points are correlated: so many count as one. Compared with true errors of simulated rounds.
CORRELATION = 25.0
MIN_POINTS = 12
# Standard deviations of a candidate's guess, radians and metres.
GUESS_SIGMAS = np.array([0.2] * 3 + [2.0] * 3)


@dataclass(frozen=True, eq=False)
class SubmapCloud:
    """A sparse submap united with its neighbours, in its keyframe's LiDAR frame; only points on planes and lines."""

    submap: SparseSubmap  # the keyframe's own
    # points, axes: (N, 3)
    points: FloatArray
    axes: FloatArray
    tilt: FloatArray  # (N,)
    is_line: NDArray[np.bool_]  # (N,)
    ahead_m: FloatArray  # (N,) way from the keyframe to that which a point is of, where the drifting estimates place it
    drift_rates: tuple[float, float]  # standard deviations of that drift for each metre, radians and metres
    middle_m: float  # way on which a submap is drawn after its keyframe, on average
    tree: cKDTree  # of the points

    @classmethod
    def join(
        cls,
        submap: SparseSubmap,
        neighbours: Sequence[tuple[FloatArray, SparseSubmap]] = (),
        ways_m: Sequence[float] = (),
        drift_rates: tuple[float, float] = (0.0, 0.0),
    ) -> "SubmapCloud":
        """Unite with neighbours, each with `T_keyframe_neighbour` (4, 4) and the way there; back is negative."""
        points, axes, tilt, is_line, ahead_m = [], [], [], [], []
        for (T, part), way_m in zip([(np.eye(4), submap), *neighbours], [0.0, *ways_m], strict=True):
            used = part.kinds > 0
            points.append(transform_points(T, part.points[used].astype(float)))
            axes.append(part.axes[used].astype(float) @ T[:3, :3].T)
            tilt.append(part.tilt[used].astype(float))
            is_line.append(part.kinds[used] == LINE)
            ahead_m.append(np.full(len(points[-1]), way_m))
        together, unit = np.concatenate(points), np.concatenate(axes)
        kept = one_per_cell(together, 1.5 * submap.cell_m)
        together, unit = together[kept], unit[kept]
        unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
        middle_m = 0.5 * min((abs(way_m) for way_m in ways_m), default=0.0)
        return cls(
            submap, together, unit, np.concatenate(tilt)[kept], np.concatenate(is_line)[kept],
            np.concatenate(ahead_m)[kept], drift_rates, middle_m, cKDTree(together, balanced_tree=False),
        )  # fmt: skip


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
    target: SubmapCloud,
    source: SubmapCloud,
    chosen: NDArray[np.intp],
    reach_m: float,
    scale_m: float,
    T_target_source: FloatArray,
) -> NormalEquations | None:
    found = correspondences(target, source, T_target_source, chosen, reach_m)
    if len(found.points) < MIN_POINTS:
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
    noise_m = np.where(target.is_line[t], LINE_NOISE_M, _RANGE_NOISE_M)
    ahead_m = np.stack([target.ahead_m[t], source.ahead_m[s]], axis=1)
    return Correspondences(
        source.points[s], normals @ T[:3, :3], residuals, target.tilt[t], noise_m, ahead_m, source.drift_rates
    )
