"""Edge and planar features of a sweep by curvature along its rings (Zhang and Singh, "LOAM", RSS 2014, section V-A)."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.scan import Scan
from lidarslam.core.thinning import central_per_cell, one_per_cell
from lidarslam.mapping.loam.feature_kernels import EDGE, PLANE, classify, write_curvatures
from lidarslam.mapping.loam.rings import ring_order
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.sampled_scan import Sampler

# Spacing of the features that go into the map, in cells.
_MAP_SPACING = 0.5
# Largest number of edges that are registered, and their spacing in cells.
_MOST_EDGES, _EDGE_SPACING = 1000, 1.0
# Of maps that follow the scene: in sparser ones, neighbours are too far apart for a line or plane.
_MOST_SPACING_M = 0.4
# Curvature above which a point is an edge, square metres: that of the authors' program. All others are planar.
_CURVATURE_M2 = 0.1
# An edge needs this many times the median curvature as well. Flat surfaces seen with a range noise of more than one
# centimetre exceed the published threshold all over, and these edges, on rings that move with the sensor, hold it back.
_ABOVE_NOISE = 10.0
# The median is taken over one in this many points.
_SAMPLED = 4


class FeatureSampler(Sampler):
    """Edges and planar points."""

    def _spacing_m(self, cell_m: float) -> float:
        return cell_m if self._config.cell_m is not None else min(cell_m, _MOST_SPACING_M)

    def _choose(self, scan: Scan, has_rings: bool, cell_m: float) -> tuple[NDArray[np.intp], NDArray[np.int8]]:
        if has_rings:
            order, kinds = find_features(scan)
        else:  # the ends of strokes are no edges, and points that lie on no plane find none in the map
            order, kinds = np.arange(len(scan)), np.full(len(scan), PLANE, dtype=np.int8)
        chosen = []
        for kind in (EDGE, PLANE):
            features = order.take(np.flatnonzero(kinds == kind))
            chosen.append(features.take(one_per_cell(scan.points.take(features, axis=0), _MAP_SPACING * cell_m)))
        return np.concatenate(chosen), np.repeat(np.array([EDGE, PLANE], dtype=np.int8), [len(part) for part in chosen])

    def _keypoints(self, sweep: Sweep, cell_m: float) -> NDArray[np.intp]:
        assert sweep.kinds is not None
        edges, planes = (np.flatnonzero(sweep.kinds == kind) for kind in (EDGE, PLANE))
        edges = edges.take(central_per_cell(sweep.points.take(edges, axis=0), _EDGE_SPACING * cell_m))
        if len(edges) > _MOST_EDGES:
            edges = edges[np.linspace(0, len(edges) - 1, _MOST_EDGES).astype(np.intp)]
        return np.concatenate([edges, planes.take(super()._keypoints(sweep.take(planes), cell_m))])


def find_features(scan: Scan) -> tuple[NDArray[np.intp], NDArray[np.int8]]:
    """The sharpest points of each sector of a ring, and all others that are reliable.

    Returns:
        Indices (N,) of the scan's points, ring after ring, and whether each is `EDGE`, `PLANE` or neither, 0.
    """
    order, rings = ring_order(scan)
    points = scan.points.take(order, axis=0)
    ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
    curvature, kinds = np.empty(len(points)), np.empty(len(points), dtype=np.int8)
    write_curvatures(points, rings, curvature)
    known = curvature[::_SAMPLED]
    known = known[np.isfinite(known)]
    noise_m2 = float(np.median(known)) if len(known) else 0.0
    classify(points, ranges, rings, curvature, max(_CURVATURE_M2, _ABOVE_NOISE * noise_m2), kinds)
    return order, kinds
