"""Consistency of consecutive scans under a motion, by point-to-plane distances; independent of every odometry.

Points of the new scan are taken to the previous scan's frame and compared with planes through its points. A wrong
motion places walls where there are none, and the inlier ratio falls.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.state import TRANSFORM, Shape, Stateful
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.tracking import Status

# Inlier ratios under which a scan is degraded, and lost.
_DEGRADED_BELOW, _LOST_BELOW = 0.70, 0.40
# Largest residual of an inlier: as a fraction of its range, and close to the sensor.
_GATE_RATIO, _LEAST_GATE_M = 0.02, 0.10
# Points of the new scan that are looked up in the previous one.
_QUERIES = 1000
_PLANE_POINTS = 6
# Thickness of a neighbourhood that still counts as a plane, relative to its extent (ratio of standard deviations).
_MAX_THICKNESS = 0.3
# With fewer planes the ratio is unknown, of the scan or of one direction.
_MIN_PLANES = 20
# Points are thinned to cells of this fraction of the median range, so that the dense ground does not outvote the rest.
_CELL_PER_RANGE = 0.03
# Points looked at before thinning; more do not change the answer.
_MAX_POINTS = 20_000


@dataclass(frozen=True)
class Consistency:
    """Fit of a scan to the previous one."""

    residual_m: float | None  # median point-to-plane distance; None with too few planes
    inlier_ratio: float | None  # of the points that have a plane, 0 to 1; None likewise
    status: Status  # by the ratio


class ConsistencyCheck(Stateful):
    """Compares each scan with the one before."""

    _reference: Annotated[FloatArray, Shape(None, 3)] | None
    _T_reference_prev: Annotated[FloatArray, TRANSFORM]

    def __init__(self) -> None:
        self._reference = None
        self._T_reference_prev = np.eye(4)

    @staticmethod
    def sample(scan: Scan) -> Scan:
        """The points of a scan that `check` looks at; only they need to be motion compensated."""
        return scan.select(np.arange(0, len(scan), max(1, len(scan) // _MAX_POINTS)))

    def check(self, points: FloatArray, T_prev_curr: FloatArray) -> Consistency:
        """Compare a scan's motion-compensated points (N, 3) with the previous call's.

        The first scan is ok. A scan that is all but empty is lost, and the next one is compared with the one before it.
        """
        thinned = _thinned(points)
        T_reference_curr = self._T_reference_prev @ T_prev_curr
        if len(thinned) < _MIN_PLANES:
            self._T_reference_prev = T_reference_curr
            return Consistency(None, None, Status.LOST)
        reference, self._reference, self._T_reference_prev = self._reference, thinned, np.eye(4)
        if reference is None:
            return Consistency(None, None, Status.OK)
        queries = thinned[:: max(1, len(thinned) // _QUERIES)]
        distances, facing = plane_distances(transform_points(T_reference_curr, queries), reference)
        known = np.isfinite(distances)
        if np.count_nonzero(known) < _MIN_PLANES:
            return Consistency(None, None, Status.DEGRADED)
        gate = np.maximum(_LEAST_GATE_M, _GATE_RATIO * np.linalg.norm(queries, axis=1))
        ratio = _least_ratio(distances[known] < gate[known], facing[known])
        status = Status.LOST if ratio < _LOST_BELOW else Status.DEGRADED if ratio < _DEGRADED_BELOW else Status.OK
        return Consistency(float(np.median(distances[known])), ratio, status)


def plane_distances(queries: FloatArray, points: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Distances of queries (M, 3) from the planes through their nearest points.

    Returns:
        Distances (M,), NaN where the nearest points form no plane, and the axis (M,), 0 to 2, that the plane's normal
        is closest to.
    """
    from scipy.spatial import cKDTree  # takes a while to load

    _, nearest = cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False).query(queries, _PLANE_POINTS)
    neighbourhood = points[nearest]
    centre = neighbourhood.mean(axis=1)
    deviation = neighbourhood - centre[:, None]
    variances, axes = np.linalg.eigh(np.swapaxes(deviation, 1, 2) @ deviation)
    normals = axes[:, :, 0]
    flat = variances[:, 0] < _MAX_THICKNESS**2 * variances[:, 1]
    distance = np.abs(np.einsum("ij,ij->i", queries - centre, normals))
    return np.where(flat, distance, np.nan), np.abs(normals).argmax(axis=1)


def _least_ratio(inlier: NDArray[np.bool_], facing: NDArray[np.intp]) -> float:
    """The smallest inlier ratio among the planes facing x, y and z.

    Most points lie on the ground, which fits under every motion along it.
    """
    groups = [inlier[facing == axis] for axis in range(3)]
    ratios = [float(group.mean()) for group in groups if len(group) >= _MIN_PLANES]
    return min(ratios, default=float(inlier.mean()))


def _thinned(points: FloatArray) -> FloatArray:
    if len(points) < _MIN_PLANES:
        return points
    return points[one_per_cell(points, _CELL_PER_RANGE * float(np.median(np.linalg.norm(points, axis=1))))]
