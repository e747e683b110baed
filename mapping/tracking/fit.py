"""How well a scan lies on the map, and whether its pose is to be believed."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.tracking import Status
from mapping.config import TrackingConfig
from mapping.surfels.surfel_map import LocalMap

# Fewer surfaces facing one way are not counted apart.
_FEWEST_FACING = 30
# A scan that meets the map with less of its points has come to a new place, or is lost.
_LEAST_OVERLAP = 0.1
# A point so far from its surface, in cells, counts half in the support; and a part of what constrains all directions
# together that is added to each, so that one which next to nothing constrains is not judged by noise.
_HALF_CELLS = 0.5
_LEAST_FELT = 0.005


@dataclass(frozen=True)
class Fit:
    """How a scan lies on the map.

    Attributes:
        matched: points that met a surface.
        overlap: their share of all.
        residual_m: median distance of the matched points from their surfaces; None when there are none.
        inlier_ratio: share of the matched points that lie on their surface, the worst of those facing each axis of the
            world: nearly everything fits the ground. None when there are none.
        support: the inlier ratio of the points that constrain the least supported direction of translation; most
            points fit wherever a scan is slid along a street, and those that constrain it along the street do not.
            None when there are none.
    """

    matched: int
    overlap: float
    residual_m: float | None
    inlier_ratio: float | None
    support: float | None = None

    @property
    def inlier_share(self) -> float:
        """Share of all points that lie on the map, by the worst axis."""
        return self.overlap * (self.inlier_ratio or 0.0)

    def status(self, config: TrackingConfig) -> Status:
        """What that means."""
        if self.inlier_ratio is None or self.overlap < _LEAST_OVERLAP or self.inlier_ratio < config.lost_below:
            return Status.LOST
        support = 1.0 if self.support is None else self.support
        if support < config.lost_below_support:
            return Status.LOST
        slides = support < config.degraded_below_support
        return Status.DEGRADED if slides or self.inlier_ratio < config.degraded_below else Status.OK

    def explain(self, config: TrackingConfig) -> str:
        """Why the status is not ok; empty when it is."""
        if self.status(config) is Status.OK:
            return ""
        if self.inlier_ratio is None or self.overlap < _LEAST_OVERLAP:
            return f"only {100.0 * self.overlap:.0f} % of the scan meets the map"
        if self.inlier_ratio < config.degraded_below:
            return f"only {100.0 * self.inlier_ratio:.0f} % of the scan lies on the map"
        return (
            f"only {100.0 * (self.support or 0.0):.0f} % of what constrains one direction lies on the map: it may slide"
        )


def measure_fit(points: FloatArray, T_world_lidar: FloatArray, local_map: LocalMap, config: TrackingConfig) -> Fit:
    """Hold compensated points (N, 3) of the LiDAR frame at a pose against the map."""
    world = transform_points(T_world_lidar, points)
    matches = local_map.match_planes(world, T_world_lidar).one_each()
    if not len(matches):
        return Fit(0, 0.0, None, None)
    distances = np.abs(matches.residuals(world.take(matches.index, axis=0)))
    ranges = np.linalg.norm(points.take(matches.index, axis=0), axis=1)
    nearest = max(config.gate_min_m, config.gate_cells * local_map.cell_m)
    inlier = distances < np.maximum(nearest, config.gate_ratio * ranges)
    facing = np.abs(matches.normals).argmax(axis=1)
    shares = [float(inlier[facing == axis].mean()) for axis in range(3) if (facing == axis).sum() >= _FEWEST_FACING]
    return Fit(
        matched=len(matches),
        overlap=len(matches) / len(points),
        residual_m=float(np.median(distances)),
        inlier_ratio=min(shares, default=float(inlier.mean())),
        support=directional_support(matches.normals, distances / (_HALF_CELLS * local_map.cell_m)),
    )


def directional_support(normals: FloatArray, distances: FloatArray) -> float:
    """The least inlier ratio over all directions of translation, each point weighted by how much it constrains it.

    The smallest generalised eigenvalue of the sums of `n n^T` over the points, with and without inlier weights.

    Args:
        normals: (N, 3) unit, of the surfaces.
        distances: (N,) of the points from them, in units at which a point counts half.
    """
    everything, held, share = constrained(normals, distances)
    ridge = _LEAST_FELT * float(np.trace(everything)) * np.eye(3)
    # What the ridge adds to both is supported as well as the whole.
    return float(eigh(held + share * ridge, everything + ridge, eigvals_only=True)[0])


def constrained(normals: FloatArray, distances: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """How points constrain each direction of translation: sums (3, 3) of `n n^T` over them, without and with inlier
    weights, and the mean of the weights.

    Args:
        normals: (N, 3) unit, of the surfaces.
        distances: (N,) of the points from them, in units at which a point counts half.
    """
    weights = 1.0 / (1.0 + distances**2)
    share = float(weights.mean()) if len(weights) else 0.0
    return normals.T @ normals, (normals * weights[:, None]).T @ normals, share
