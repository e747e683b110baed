"""Lays one place on another: point-to-plane, and to lines what is thin, from coarse to fine."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, exp, inverse, log, orthonormalize, transform_points
from lidarslam.core.thinning import one_per_cell
from mapping.loops.place import LINE, Patch

# Reach of a pull and scale of its kernel, in cells, the share of the points, and the most steps, level after level.
_LEVELS = ((12.0, 4.0, 4, 8), (6.0, 2.0, 2, 6), (4.0, 1.0, 1, 4), (3.0, 0.5, 1, 8))
_SETTLED = 0.02  # of a cell
_LEAST_AGREEMENT = 0.6  # cosine between normals of one surface
LINE_NOISE_M = 0.08
_RANGE_NOISE_M = 0.02
# Neighbouring points err together, and count for as much less.
CORRELATION = 25.0
# Where to start from is known this well at least; radians and metres.
GUESS_SIGMAS = np.array([0.2] * 3 + [2.0] * 3)


@dataclass(frozen=True, eq=False)
class Place:
    """A keyframe with its neighbours' points, in its LiDAR frame; what lies on no surface is left out.

    Attributes:
        patch: the keyframe's own.
        points, axes: (N, 3).
        tilt: (N,).
        is_line: (N,).
        ahead_m: (N,) way from the keyframe to that which a point is of: neighbours lie where drifting estimates have
            them, the farther the less exactly.
        bend: how much a metre of that way may turn and shift them, standard deviations in radians and metres.
        middle_m: way on which a submap is drawn after its keyframe, on average.
        tree: of the points.
    """

    patch: Patch
    points: FloatArray
    axes: FloatArray
    tilt: FloatArray
    is_line: NDArray[np.bool_]
    ahead_m: FloatArray
    bend: tuple[float, float]
    middle_m: float
    tree: cKDTree

    @classmethod
    def join(
        cls,
        patch: Patch,
        neighbours: Sequence[tuple[FloatArray, Patch]] = (),
        ways_m: Sequence[float] = (),
        bend: tuple[float, float] = (0.0, 0.0),
    ) -> "Place":
        """Unite a keyframe with others, each with `T_keyframe_neighbour` (4, 4) and the way there; back is negative."""
        parts = [(np.eye(4), patch), *neighbours]
        used = [part.kinds > 0 for _, part in parts]
        points = [transform_points(T, part.points[u].astype(float)) for u, (T, part) in zip(used, parts, strict=True)]
        axes = [part.axes[u].astype(float) @ T[:3, :3].T for u, (T, part) in zip(used, parts, strict=True)]
        together = np.concatenate(points)
        kept = one_per_cell(together, 1.5 * patch.cell_m)
        tilt = np.concatenate([part.tilt[u] for u, (_, part) in zip(used, parts, strict=True)]).astype(float)
        is_line = np.concatenate([part.kinds[u] == LINE for u, (_, part) in zip(used, parts, strict=True)])
        ahead_m = np.repeat([0.0, *(ways_m or [0.0] * len(neighbours))], [int(u.sum()) for u in used])
        middle_m = 0.5 * min((abs(way_m) for way_m in ways_m), default=0.0)
        together = together[kept]
        unit = np.concatenate(axes)[kept]
        unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
        return cls(
            patch,
            together,
            unit,
            tilt[kept],
            is_line[kept],
            ahead_m[kept],
            bend,
            middle_m,
            cKDTree(together, balanced_tree=False),
        )


@dataclass(frozen=True, eq=False)
class Pulls:
    """Source points (M, 3), in the source's frame, each pulled along a unit vector (M, 3) there by a residual (M,).

    Ahead (M, 2) is of the target's and the source's keyframes, `bend` as in `Place`.
    """

    points: FloatArray
    along: FloatArray
    residuals: FloatArray
    tilt: FloatArray
    noise_m: FloatArray
    ahead_m: FloatArray
    bend: tuple[float, float]

    @property
    def trust(self) -> FloatArray:
        """(M,) how much a pull counts, beside one that is of both keyframes themselves."""
        turned, shifted = self.bend
        squared = shifted**2 + turned**2 * np.einsum("ij,ij->i", self.points, self.points)
        squared *= np.einsum("ij,ij->i", self.ahead_m, self.ahead_m)
        return np.asarray(self.noise_m**2 / (self.noise_m**2 + squared))

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
            pulls = pull(target, source, T, chosen, reach * cell_m)
            if len(pulls.points) < 12:
                return None
            xi = _solve(pulls, scale * cell_m, log(inverse(guess) @ T))
            T = T @ exp(xi)
            if np.linalg.norm(xi[3:]) + source.patch.range_m * np.linalg.norm(xi[:3]) < _SETTLED * scale * cell_m:
                break
    return orthonormalize(T)


def nearest(
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


def pull(target: Place, source: Place, T: FloatArray, chosen: NDArray[np.intp], reach_m: float) -> Pulls:
    """One pull a plane, and two across each line."""
    s, t = nearest(target, source, T, chosen, reach_m)
    is_line = target.is_line[t]
    line = target.axes[t[is_line]]
    least = np.eye(3)[np.abs(line).argmin(axis=1)]
    across = np.cross(line, least)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.concatenate([target.axes[t[~is_line]], across, np.cross(line, across)])
    s = np.concatenate([s[~is_line], s[is_line], s[is_line]])
    t = np.concatenate([t[~is_line], t[is_line], t[is_line]])
    residuals = np.einsum("ij,ij->i", transform_points(T, source.points[s]) - target.points[t], along)
    noise_m = np.where(target.is_line[t], LINE_NOISE_M, _RANGE_NOISE_M)
    ahead_m = np.stack([target.ahead_m[t], source.ahead_m[s]], axis=1)
    return Pulls(source.points[s], along @ T[:3, :3], residuals, target.tilt[t], noise_m, ahead_m, source.bend)


def _solve(pulls: Pulls, scale_m: float, away: FloatArray) -> FloatArray:
    """A step (6,) of Gauss-Newton with the kernel of Geman and McClure, held a little to where it began."""
    weights = pulls.trust / ((1.0 + (pulls.residuals / scale_m) ** 2) ** 2 * (pulls.noise_m**2 + (0.5 * scale_m) ** 2))
    J = pulls.jacobian
    JW = J * (weights / CORRELATION)[:, None]
    held = np.diag(GUESS_SIGMAS**-2)
    return np.asarray(np.linalg.solve(JW.T @ J + held, -(JW.T @ pulls.residuals) - held @ away), dtype=np.float64)
