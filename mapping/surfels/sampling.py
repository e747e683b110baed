"""Sampling of a scan for a map of surfels."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.scan import Scan
from lidarslam.core.thinning import one_per_cell
from lidarslam.mapping.registration.sampled_scan import Sampler

# Spacing of the points that go into the map, in cells.
_MAP_SPACING = 0.5


class SurfelSampler(Sampler):
    """One point in each half of a cell."""

    def _choose(self, scan: Scan, has_rings: bool, cell_m: float) -> tuple[NDArray[np.intp], None]:  # noqa: ARG002
        return one_per_cell(scan.points, _MAP_SPACING * cell_m), None
