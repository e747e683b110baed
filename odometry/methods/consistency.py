"""Whether two consecutive scans fit each other under a motion: a check that no odometry can talk itself out of.

Points of the new scan are taken to the previous scan's frame and held against small planes through its points. Odometry
that goes astray lays walls where there are none, and the share of points that find their plane falls.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.tracking import Status
from odometry.config import ConsistencyConfig

_PLANE_POINTS = 6
# Thickness of a neighbourhood that still counts as a plane, relative to its extent (ratio of standard deviations).
_MAX_THICKNESS = 0.3
# With fewer planes than this nothing can be said, about the scan or about one direction.
_MIN_PLANES = 20
# Points are thinned to cells of this fraction of the median range, so that the dense ground does not outvote the rest.
_CELL_PER_RANGE = 0.03
# Points looked at before thinning; more do not change the answer.
_MAX_POINTS = 20_000


@dataclass(frozen=True)
class Consistency:
    """How well a scan lies on the previous one.

    Attributes:
        residual_m: median point-to-plane distance; None when there were too few planes to tell.
        inlier_ratio: share of the looked-up points that lie on their plane, 0 to 1; None likewise.
        status: what the ratio means.
    """

    residual_m: float | None
    inlier_ratio: float | None
    status: Status


class ConsistencyCheck:
    """Remembers one scan and holds the next against it."""

    def __init__(self, config: ConsistencyConfig) -> None:
        self._config = config
        self._held: FloatArray | None = None
        self._T_held_prev = np.eye(4)

    def state(self) -> State:
        """The scan that is held, and the way since."""
        return {"held": self._held, "T_held_prev": self._T_held_prev}

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        self._held = saved.optional_array("held", (None, 3))
        self._T_held_prev = saved.array("T_held_prev", (4, 4))

    @staticmethod
    def sample(scan: Scan) -> Scan:
        """The points of a scan that `check` looks at; only they need to be motion compensated."""
        return scan.select(np.arange(0, len(scan), max(1, len(scan) // _MAX_POINTS)))

    def check(self, points: FloatArray, T_prev_curr: FloatArray) -> Consistency:
        """Hold a scan's motion-compensated points (N, 3) against the previous call's.

        The first scan has nothing to be held against and is ok. A scan that is all but empty is lost, and the next one
        is held against the one before it.
        """
        even = _thin_evenly(points)
        T_held_curr = self._T_held_prev @ T_prev_curr
        if len(even) < _MIN_PLANES:  # go on holding the last scan that had something to see
            self._T_held_prev = T_held_curr
            return Consistency(None, None, Status.LOST)
        held, self._held, self._T_held_prev = self._held, even, np.eye(4)
        if held is None:
            return Consistency(None, None, Status.OK)
        queries = _every_nth(even, self._config.queries)
        ranges = np.linalg.norm(queries, axis=1)
        distances, facing = plane_distances(transform_points(T_held_curr, queries), held)
        known = np.isfinite(distances)
        if np.count_nonzero(known) < _MIN_PLANES:
            return Consistency(None, None, Status.DEGRADED)
        gate = np.maximum(self._config.gate_min_m, self._config.gate_ratio * ranges)
        ratio = _worst_share(distances[known] < gate[known], facing[known])
        return Consistency(float(np.median(distances[known])), ratio, self._judge(ratio))

    def _judge(self, inlier_ratio: float) -> Status:
        if inlier_ratio < self._config.lost_below:
            return Status.LOST
        return Status.DEGRADED if inlier_ratio < self._config.degraded_below else Status.OK


def plane_distances(queries: FloatArray, points: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Hold queries (M, 3) against the planes through their nearest points.

    Returns:
        Distances (M,), NaN where the nearest points form no plane, and the axis (M,), 0 to 2, that the plane's normal
        is closest to.
    """
    _, nearest = cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False).query(queries, _PLANE_POINTS)
    neighbourhood = points[nearest]
    centre = neighbourhood.mean(axis=1)
    deviation = neighbourhood - centre[:, None]
    variances, axes = np.linalg.eigh(np.swapaxes(deviation, 1, 2) @ deviation)
    normals = axes[:, :, 0]
    flat = variances[:, 0] < _MAX_THICKNESS**2 * variances[:, 1]
    distance = np.abs(np.einsum("ij,ij->i", queries - centre, normals))
    return np.where(flat, distance, np.nan), np.abs(normals).argmax(axis=1)


def _worst_share(inlier: NDArray[np.bool_], facing: NDArray[np.intp]) -> float:
    """The smallest inlier ratio among the planes facing x, y and z.

    Most points lie on the ground, which fits under every motion along it; what faces forwards or sideways tells.
    """
    groups = [inlier[facing == axis] for axis in range(3)]
    shares = [float(group.mean()) for group in groups if len(group) >= _MIN_PLANES]
    return min(shares, default=float(inlier.mean()))


def _thin_evenly(points: FloatArray) -> FloatArray:
    """One point a cell, the cells sized by the scene."""
    if not len(points):
        return points
    cell = _CELL_PER_RANGE * float(np.median(np.linalg.norm(points, axis=1)))
    return np.asarray(points[one_per_cell(points, cell)], dtype=np.float64)


def _every_nth(points: FloatArray, count: int) -> FloatArray:
    """About `count` points, taken at equal steps through the sweep."""
    return points[:: max(1, len(points) // count)]
