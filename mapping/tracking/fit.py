"""Fit of a registered scan to the map: inlier ratios, and the tracking status that follows from them."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import TrackingConfig

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
# Standard deviation of a range: thicker surfaces, as planes across an edge, count less.
_RANGE_NOISE_M = 0.02
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
    # noise of their normals; None where that noise is unknown, or there are none.
    evidence: float | None = None
    weakest: tuple[float, float, float] | None = None  # that direction, unit, in the world
    unsupported: tuple[float, float, float] | None = None  # direction of the least support if that is too low

    @classmethod
    def of(
        cls, distances: FloatArray, normals: FloatArray, ranges: FloatArray, points: int, cell_m: float,
        thickness_m: FloatArray | None = None, tilt: FloatArray | None = None,
    ) -> "Fit":  # fmt: skip
        """Fit of the M of so many points that have a correspondence, to a map of this spacing.

        They have distances (M,) from their surfaces and ranges (M,); the surfaces unit normals (M, 3) in the world,
        standard deviations (M,) along these, and of the normals, radians; None where they are unknown.
        """
        if not len(distances):
            return NO_FIT
        nearest_m = max(_GATE_MIN_M, _GATE_CELLS * cell_m)
        within_m = np.maximum(nearest_m, _GATE_RATIO * ranges)
        inlier = distances < (within_m if thickness_m is None else np.maximum(within_m, _GATE_SIGMAS * thickness_m))
        residual_m, facing = float(np.median(distances)), np.abs(normals).argmax(axis=1)
        counts, inliers = np.bincount(facing), np.bincount(facing, weights=inlier)
        ratios = (inliers / np.maximum(counts, 1))[counts >= _FEWEST_FACING]
        distances = distances / (_HALF_CELLS * cell_m)
        weights = None if thickness_m is None else 1.0 / (1.0 + (thickness_m / _RANGE_NOISE_M) ** 2)
        information = translation_information(normals, distances, weights)
        evidence, weakest = None, None
        if tilt is not None and weights is not None:
            noise = float((weights / (1.0 + distances**2)) @ tilt**2)
            values, axes = np.linalg.eigh(information[1])
            evidence, weakest = float(values[0]) / max(noise, 1e-12), tuple(axes[:, 0].tolist())
        support, least = directional_support(*information)
        return cls(
            matched=len(distances),
            overlap=len(distances) / points,
            residual_m=residual_m,
            inlier_ratio=float(ratios.min() if len(ratios) else inlier.mean()),
            support=support,
            evidence=evidence,
            weakest=weakest,
            unsupported=tuple(least.tolist()) if support < _DEGRADED_SUPPORT else None,
        )

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


def translation_information(
    normals: FloatArray, distances: FloatArray, weights: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, float]:
    """Sums (3, 3) of `n n^T` without and with inlier weights `1 / (1 + d^2)`, and the mean inlier weight.

    Of unit normals (N, 3), distances (N,) in units at which a point has half the weight, and further weights (N,),
    if any.
    """
    weights = np.ones(len(distances)) if weights is None else weights
    inlier = weights / (1.0 + distances**2)
    share = float(inlier.sum() / weights.sum()) if len(weights) else 0.0
    return (normals * weights[:, None]).T @ normals, (normals * inlier[:, None]).T @ normals, share
