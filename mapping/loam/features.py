"""Edge and planar features of a sweep by curvature along its rings (Zhang and Singh, "LOAM", RSS 2014, section V-A)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.scan import Scan
from lidarslam.core.thinning import one_per_cell
from lidarslam.mapping.loam.feature_kernels import EDGE, PLANE, classify, write_curvatures
from lidarslam.mapping.loam.rings import ring_order
from lidarslam.mapping.motion.deskew import Sweep

# Curvature above which a point is an edge, and below which it is planar, square metres: that of the authors' program.
_CURVATURE_M2 = 0.1
# An edge needs this many times the median curvature as well. Flat surfaces seen with a range noise of more than one
# centimetre exceed the published threshold all over, and these edges, on rings that move with the sensor, hold it back.
_ABOVE_NOISE = 10.0


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a sweep, as measured."""

    edges: Sweep
    planes: Sweep
    spacing_m: float  # of either, at least
    middle_s: float  # time from the stamp to the middle of the sweep; 0 where the points are compensated

    def __len__(self) -> int:
        return len(self.edges) + len(self.planes)


def extract_features(scan: Scan, min_range_m: float, max_range_m: float, spacing_m: float) -> Features:
    """Extract the sharpest points of each sector of a ring, and the points of small curvature.

    Args:
        scan: as read.
        min_range_m, max_range_m: nearer and farther points are no features.
        spacing_m: edge of the voxels of which one feature is kept.
    """
    order, rings = ring_order(scan)
    points = scan.points.take(order, axis=0)
    ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
    curvature, kinds = np.empty(len(points)), np.empty(len(points), dtype=np.int8)
    write_curvatures(points, rings, curvature)
    known = curvature[np.isfinite(curvature)]
    noise_m2 = float(np.median(known)) if len(known) else 0.0
    classify(points, ranges, rings, curvature, max(_CURVATURE_M2, _ABOVE_NOISE * noise_m2), _CURVATURE_M2, kinds)
    usable = (ranges > min_range_m) & (ranges < max_range_m)
    edges, planes = (
        _thinned(scan, order.take(np.flatnonzero(usable & (kinds == kind))), spacing_m) for kind in (EDGE, PLANE)
    )
    return Features(edges, planes, spacing_m, scan.middle_offset_s)


def _thinned(scan: Scan, chosen: NDArray[np.intp], spacing_m: float) -> Sweep:
    """The chosen points of a scan, one a voxel."""
    kept = chosen.take(one_per_cell(scan.points.take(chosen, axis=0), spacing_m))
    times = None if scan.time_offsets is None else scan.time_offsets.take(kept)
    return Sweep(scan.points.take(kept, axis=0), times)
