"""Scale of the scene, the smoothed median range, which the resolution of the local map follows."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Stateful
from lidarslam.mapping.config import MappingConfig

# Least number of points for a pose, and for the scale.
MIN_POINTS = 60
# Cells per median range, and bounds of their size. Where walls are closer than a few metres, the cells are the
# smallest: steps and door frames are as large in a wider stairwell.
_CELLS_PER_RANGE = 30.0
_CELL_BOUNDS_M = (0.05, 1.0)
_CLOSE_M = 3.0
# The cell size changes when the smoothed median range has changed by this factor.
_RANGE_CHANGE = 2.0
_RANGE_SMOOTHING = 0.05


class SceneScale(Stateful):
    """Chooses the size of the map's cells, with hysteresis."""

    range_m: float  # smoothed median range; 0 before the first scan with points
    _cell_range_m: float

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self.range_m = 0.0
        self._cell_range_m = 0.0  # median range of the present cell size

    def update(self, squared: FloatArray) -> float:
        """The cell size for the latest squared ranges (N,)."""
        # Fewer points are a covered sensor, not another scene.
        if np.count_nonzero(squared > self._config.min_range_m**2) >= MIN_POINTS:
            median_m = float(np.sqrt(np.median(squared[:: max(1, len(squared) // 5000)])))
            new = self.range_m == 0.0
            self.range_m = median_m if new else self.range_m + _RANGE_SMOOTHING * (median_m - self.range_m)
        if self._config.cell_m is not None:
            return self._config.cell_m
        low_m, high_m = self._cell_range_m / _RANGE_CHANGE, self._cell_range_m * _RANGE_CHANGE
        if self.range_m > 0.0 and not low_m <= self.range_m <= high_m:
            self._cell_range_m = self.range_m
        if self._cell_range_m < _CLOSE_M:
            return _CELL_BOUNDS_M[0]
        return float(np.clip(self._cell_range_m / _CELLS_PER_RANGE, *_CELL_BOUNDS_M))
