"""Lays one place on another, and says whether they are the same.

Registration is point-to-plane, and to lines what is thin, from coarse to fine. It is judged from both sides by what
each could see of the other: in a row of like rooms, and along any corridor, most surfaces fit though the pose is wrong;
what would tell does not. So of what all points say about each direction of translation, that which fits must be most at
the worst direction too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, exp, inverse, log, orthonormalize, transform_points
from lidarslam.core.thinning import one_per_cell
from mapping.degeneracy import find_degeneracy
from mapping.loop_config import LoopConfig
from mapping.place_recognition import LINE, Patch, sight_cells

# Reach of a pull and scale of its kernel, in cells, the share of the points, and the most steps, level after level.
_LEVELS = ((12.0, 4.0, 4, 8), (6.0, 2.0, 2, 6), (4.0, 1.0, 1, 4), (3.0, 0.5, 1, 8))
_SETTLED = 0.02  # of a cell
# A point fits that lies so near its surface, in cells and at least in metres, and so near to what was seen of it.
_FITS = 0.3
_FITS_MIN_M = 0.06
_REACH = 4.0
_REACH_PER_RANGE = 0.06
_LEAST_AGREEMENT = 0.6  # cosine between normals of one surface
_LINE_NOISE_M = 0.08
_RANGE_NOISE_M = 0.02
# Neighbouring points err together, and count for as much less.
_CORRELATION = 25.0
# Where to start from is known this well at least; radians and metres.
_GUESS_SIGMAS = np.array([0.2] * 3 + [2.0] * 3)
_FLOOR_SIGMAS = np.array([np.deg2rad(0.15)] * 3 + [0.015] * 3)
# Points tell about a direction that face it by more than noise would make them; so many must, for it to count.
_FACING = 0.3
_LEAST_FACING = 10
# Where less than this share of what tells about a direction is in view, too little is known of it.
_MUCH_IN_VIEW = 0.3


@dataclass(frozen=True, eq=False)
class Place:
    """A keyframe with its neighbours' points, in its LiDAR frame; what lies on no surface is left out.

    Attributes:
        patch: the keyframe's own.
        points, axes: (N, 3).
        tilt: (N,).
        is_line: (N,).
        tree: of the points.
    """

    patch: Patch
    points: FloatArray
    axes: FloatArray
    tilt: FloatArray
    is_line: NDArray[np.bool_]
    tree: cKDTree

    @classmethod
    def join(cls, patch: Patch, neighbours: Sequence[tuple[FloatArray, Patch]] = ()) -> "Place":
        """Unite a keyframe with others, each with its `T_keyframe_neighbour` (4, 4)."""
        parts = [(np.eye(4), patch), *neighbours]
        used = [part.kinds > 0 for _, part in parts]
        points = [transform_points(T, part.points[u].astype(float)) for u, (T, part) in zip(used, parts, strict=True)]
        axes = [part.axes[u].astype(float) @ T[:3, :3].T for u, (T, part) in zip(used, parts, strict=True)]
        together = np.concatenate(points)
        kept = one_per_cell(together, 1.5 * patch.cell_m)
        tilt = np.concatenate([part.tilt[u] for u, (_, part) in zip(used, parts, strict=True)]).astype(float)
        is_line = np.concatenate([part.kinds[u] == LINE for u, (_, part) in zip(used, parts, strict=True)])
        together = together[kept]
        unit = np.concatenate(axes)[kept]
        unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
        return cls(patch, together, unit, tilt[kept], is_line[kept], cKDTree(together))


@dataclass(frozen=True, eq=False)
class Verification:
    """How one place lies on another.

    Attributes:
        T_target_source: (4, 4).
        covariance: (6, 6) of xi in `T_true = T_target_source @ exp(xi)`; large along what nothing tells.
        overlap: of what each side sees of the other, the share that fits; the worse side.
        explained: the same of what tells about the direction of translation that fares worst.
        residual_m: root mean square distance of what fits.
        inlier_ratio: share of the source's points that fit.
        inliers: how many they are.
        undetermined: names of the directions of motion that nothing tells.
    """

    T_target_source: FloatArray
    covariance: FloatArray
    overlap: float
    explained: float
    residual_m: float
    inlier_ratio: float
    inliers: int
    undetermined: tuple[str, ...]

    def objection(self, config: LoopConfig) -> str:
        """Why the two are not believed to be one place; empty when they are."""
        sigmas = (
            np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]),
            np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]),
        )
        if self.inliers < config.min_inliers:
            return f"only {self.inliers} points fit"
        if self.inlier_ratio < config.min_inlier_ratio:
            return f"only {100.0 * self.inlier_ratio:.0f} % of the points fit"
        if self.overlap < config.min_overlap:
            return f"only {100.0 * self.overlap:.0f} % of what each sees of the other fits"
        if self.explained < config.min_explained:
            return f"only {100.0 * self.explained:.0f} % of what would tell fits"
        if sigmas[0] > config.max_sigma_m or sigmas[1] > np.deg2rad(config.max_sigma_deg):
            names = ", ".join(self.undetermined) or "the pose"
            return f"too little tells {names}: {sigmas[0]:.2f} m and {np.rad2deg(sigmas[1]):.1f} degrees unsure"
        return ""


@dataclass(frozen=True, eq=False)
class _Pulls:
    """Source points (M, 3), in the source's frame, each pulled along a unit vector (M, 3) there by a residual (M,)."""

    points: FloatArray
    along: FloatArray
    residuals: FloatArray
    tilt: FloatArray
    noise_m: FloatArray

    @property
    def jacobian(self) -> FloatArray:
        """(M, 6) for a motion of the source from the right, rotation first."""
        return np.concatenate([np.cross(self.points, self.along), self.along], axis=1)


def register(target: Place, source: Place, T_target_source: FloatArray) -> FloatArray | None:
    """Refine a guess (4, 4); None when too few points meet a surface."""
    cell_m = max(target.patch.cell_m, source.patch.cell_m)
    guess = T = T_target_source
    for reach, scale, step, most in _LEVELS:
        chosen = np.arange(0, len(source.points), step)
        for _ in range(most):
            pulls = _pull(target, source, T, chosen, reach * cell_m)
            if len(pulls.points) < 12:
                return None
            xi = _solve(pulls, scale * cell_m, log(inverse(guess) @ T))
            T = T @ exp(xi)
            if np.linalg.norm(xi[3:]) + source.patch.range_m * np.linalg.norm(xi[:3]) < _SETTLED * scale * cell_m:
                break
    return orthonormalize(T)


def verify(target: Place, source: Place, T_target_source: FloatArray) -> Verification | None:
    """Lay the source on the target from a guess (4, 4), and judge; None when nothing meets."""
    if min(len(target.points), len(source.points)) < 12:
        return None
    T = register(target, source, T_target_source)
    return None if T is None else judge(target, source, T)


def judge(target: Place, source: Place, T_target_source: FloatArray) -> Verification:
    """How well the source lies on the target."""
    T = T_target_source
    forward, backward = _Fit.of(target, source, T), _Fit.of(source, target, inverse(T))
    cell_m = max(target.patch.cell_m, source.patch.cell_m)
    pulls = _pull(target, source, T, np.flatnonzero(forward.fits), _REACH * cell_m)
    covariance, names = _covariance(pulls)
    # Both sides measure the same; what the nearer one of them makes of it is as good as any.
    return Verification(
        T, covariance, min(forward.overlap, backward.overlap), min(forward.explained, backward.explained),
        float(np.sqrt(np.mean(pulls.residuals**2))) if len(pulls.residuals) else np.inf,
        float(forward.fits.mean()), int(forward.fits.sum()), names,
    )  # fmt: skip


def _nearest(
    target: Place, source: Place, T: FloatArray, chosen: NDArray[np.intp], reach_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of source and target points within reach on what may be the same surface."""
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


def _pull(target: Place, source: Place, T: FloatArray, chosen: NDArray[np.intp], reach_m: float) -> _Pulls:
    """One pull a plane, and two across each line."""
    s, t = _nearest(target, source, T, chosen, reach_m)
    is_line = target.is_line[t]
    line = target.axes[t[is_line]]
    least = np.eye(3)[np.abs(line).argmin(axis=1)]
    across = np.cross(line, least)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.concatenate([target.axes[t[~is_line]], across, np.cross(line, across)])
    s = np.concatenate([s[~is_line], s[is_line], s[is_line]])
    t = np.concatenate([t[~is_line], t[is_line], t[is_line]])
    residuals = np.einsum("ij,ij->i", transform_points(T, source.points[s]) - target.points[t], along)
    noise_m = np.where(target.is_line[t], _LINE_NOISE_M, _RANGE_NOISE_M)
    return _Pulls(source.points[s], along @ T[:3, :3], residuals, target.tilt[t], noise_m)


def _solve(pulls: _Pulls, scale_m: float, away: FloatArray) -> FloatArray:
    """A step (6,) of Gauss-Newton with the kernel of Geman and McClure, held a little to where it began."""
    weights = 1.0 / ((1.0 + (pulls.residuals / scale_m) ** 2) ** 2 * (pulls.noise_m**2 + (0.5 * scale_m) ** 2))
    J = pulls.jacobian
    JW = J * (weights / _CORRELATION)[:, None]
    held = np.diag(_GUESS_SIGMAS**-2)
    return np.asarray(np.linalg.solve(JW.T @ J + held, -(JW.T @ pulls.residuals) - held @ away), dtype=np.float64)


def _covariance(pulls: _Pulls) -> tuple[FloatArray, tuple[str, ...]]:
    """(6, 6) from the normal equations, and what they leave open; along that, nothing is said but the guess."""
    variances = np.maximum(pulls.noise_m, np.sqrt(np.mean(pulls.residuals**2)) if len(pulls.points) else 1.0) ** 2
    weights = 1.0 / variances
    lever_m = float(np.sqrt(np.mean(np.sum(pulls.points**2, axis=1)))) if len(pulls.points) else 1.0
    open_ = find_degeneracy(pulls.jacobian, weights, pulls.tilt, lever_m)
    scale = np.array([lever_m] * 3 + [1.0] * 3)
    D = open_.directions
    told = np.eye(6) - (D / scale).T @ (D * scale)
    J = pulls.jacobian @ told
    information = (J * (weights / _CORRELATION)[:, None]).T @ J + np.diag(_GUESS_SIGMAS**-2)
    return np.linalg.inv(information) + np.diag(_FLOOR_SIGMAS**2), open_.names


@dataclass(frozen=True, eq=False)
class _Fit:
    """Which points (N,) of one side fit the other, the share of what it sees, and the worst direction's."""

    fits: NDArray[np.bool_]
    overlap: float
    explained: float

    @classmethod
    def of(cls, target: Place, source: Place, T: FloatArray) -> "_Fit":
        cell_m = max(target.patch.cell_m, source.patch.cell_m)
        gate_m = max(_FITS * cell_m, _FITS_MIN_M)
        there = transform_points(T, source.points)
        ranges = np.linalg.norm(there, axis=1)
        reach_m = np.maximum(_REACH * cell_m, _REACH_PER_RANGE * ranges)
        s, t = _nearest(target, source, T, np.arange(len(there)), float(reach_m.max(initial=0.0)))
        apart = there[s] - target.points[t]
        along = np.einsum("ij,ij->i", apart, target.axes[t])
        squared = np.einsum("ij,ij->i", apart, apart)
        off = np.where(target.is_line[t], np.sqrt(np.maximum(squared - along**2, 0.0)) - _LINE_NOISE_M, np.abs(along))
        fits = np.zeros(len(there), dtype=bool)
        fits[s[(off < gate_m) & (squared < reach_m[s] ** 2)]] = True
        # In front of all that the other saw that way, where it looked, it should have seen this.
        seen = target.patch.sight.ravel()[sight_cells(there, ranges)].astype(np.float64)
        in_view = fits | ((seen > 0.0) & (ranges < seen + gate_m))
        return cls(fits, float(fits.sum() / max(in_view.sum(), 1)), _explained(source, fits, in_view))


def _explained(source: Place, fits: NDArray[np.bool_], in_view: NDArray[np.bool_]) -> float:
    """The least ratio, over directions, of what fitting points tell about translation to what all in view do.

    Directions are those that the points in view, and those among them that do not fit, tell most and least of.
    """
    planes, lines = source.axes[~source.is_line], source.axes[source.is_line]
    order = np.concatenate([np.flatnonzero(~source.is_line), np.flatnonzero(source.is_line)])
    ratios = [1.0]
    for chosen in (in_view, in_view & ~fits):
        p, d = source.axes[chosen & ~source.is_line], source.axes[chosen & source.is_line]
        _, directions = np.linalg.eigh(p.T @ p + len(d) * np.eye(3) - d.T @ d)
        told = np.concatenate([(planes @ directions) ** 2, 1.0 - (lines @ directions) ** 2])
        told[told < _FACING**2] = 0.0
        everything, seen, matched = told.sum(axis=0), in_view[order] @ told, fits[order] @ told
        much = np.minimum(1.0, seen / (_MUCH_IN_VIEW * np.maximum(everything, 1e-9)))
        counts = everything > _LEAST_FACING
        ratios += list((much * matched / np.maximum(seen, 1e-9))[counts])
    return float(min(ratios))
