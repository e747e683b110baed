"""Lays one place on another, and says whether they are the same.

Registration is point-to-plane, and to lines what is thin, from coarse to fine. It is judged from both sides by what
each could see of the other: in a row of like rooms, and along any corridor, most surfaces fit though the pose is wrong;
what would tell does not. So of what all points say about each direction of translation, that which fits must be most at
the worst direction too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse, transform_points
from mapping.degeneracy import find_degeneracy
from mapping.loops.loop_config import LoopConfig
from mapping.loops.place import sight_cells
from mapping.loops.registration import CORRELATION, GUESS_SIGMAS, LINE_NOISE_M, Place, Pulls, nearest, pull, register

# A point fits that lies so near its surface, in cells and at least in metres, and so near to what was seen of it.
_FITS = 0.3
_FITS_MIN_M = 0.06
_REACH = 4.0
_REACH_PER_RANGE = 0.06
_FLOOR_SIGMAS = np.array([np.deg2rad(0.15)] * 3 + [0.015] * 3)
# Points tell about a direction that face it by more than noise would make them; so many must, for it to count.
_FACING = 0.3
_LEAST_FACING = 10
# Where less than this share of what tells about a direction is in view, too little is known of it.
_MUCH_IN_VIEW = 0.3


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
    pulls = pull(target, source, T, np.flatnonzero(forward.fits), _REACH * cell_m)
    covariance, names = _covariance(pulls, np.array([target.middle_m, source.middle_m]))
    # Both sides measure the same; what the nearer one of them makes of it is as good as any.
    return Verification(
        T, covariance, min(forward.overlap, backward.overlap), min(forward.explained, backward.explained),
        float(np.sqrt(np.mean(pulls.residuals**2))) if len(pulls.residuals) else np.inf,
        float(forward.fits.mean()), int(forward.fits.sum()), names,
    )  # fmt: skip


def _covariance(pulls: Pulls, middles_m: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
    """(6, 6) from the normal equations, and what they leave open; along that, nothing is said but the guess."""
    variances = np.maximum(pulls.noise_m, np.sqrt(np.mean(pulls.residuals**2)) if len(pulls.points) else 1.0) ** 2
    weights = pulls.trust / variances
    lever_m = float(np.sqrt(np.mean(np.sum(pulls.points**2, axis=1)))) if len(pulls.points) else 1.0
    open_ = find_degeneracy(pulls.jacobian, weights, pulls.tilt, lever_m)
    scale = np.array([lever_m] * 3 + [1.0] * 3)
    D = open_.directions
    told = np.eye(6) - (D / scale).T @ (D * scale)
    J = pulls.jacobian @ told
    information = (J * (weights / CORRELATION)[:, None]).T @ J + np.diag(GUESS_SIGMAS**-2)
    besides = _FLOOR_SIGMAS**2 + _bend_variances(pulls, weights, middles_m)
    return np.linalg.inv(information) + np.diag(besides), open_.names


def _bend_variances(pulls: Pulls, weights: FloatArray, middles_m: FloatArray) -> FloatArray:
    """(6,) of where neighbours lie: what drift does along a stretch is alike, and does not average out but ahead.

    Middles (2,) are of the target's and the source's submaps.
    """
    if not len(weights):
        return np.zeros(6)
    ways_m = np.average(pulls.ahead_m, axis=0, weights=weights) + middles_m
    turned, shifted = pulls.bend
    # Drift is told as the length of an error; each axis has a third of its square.
    return np.repeat([turned**2, shifted**2], 3) * float(ways_m @ ways_m) / 3.0


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
        s, t = nearest(target, source, T, np.arange(len(there)), float(reach_m.max(initial=0.0)))
        apart = there[s] - target.points[t]
        along = np.einsum("ij,ij->i", apart, target.axes[t])
        squared = np.einsum("ij,ij->i", apart, apart)
        off = np.where(target.is_line[t], np.sqrt(np.maximum(squared - along**2, 0.0)) - LINE_NOISE_M, np.abs(along))
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
