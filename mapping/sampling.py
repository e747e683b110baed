"""Which points of a scan go into the map, and which of those are registered to it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from lidarslam.core.thinning import central_per_cell, one_per_cell
from mapping.config import MappingConfig
from mapping.registration import Sweep

# Spacing of the points that go into the map, and of those that are registered, in cells.
_MAP_SPACING = 0.5
_KEY_SPACING = 2.5
# The cells follow the scene when its median range has become this many times larger or smaller.
_OTHER_SCENE = 2.0
_SCENE_MEMORY = 0.05
_CELL_BOUNDS_M = (0.05, 1.0)


@dataclass(frozen=True, eq=False)
class SampledScan:
    """The points of a scan that matter to the map, as measured.

    Attributes:
        stamp: of the scan, seconds.
        cell_m: the size of cells that suits the scene.
        range_m: the median range of the scene.
        points: (N, 3) that go into the map.
        elevations: (N,) the angles above the sensor's equator that they were seen at, radians.
        times: (N,) seconds from the stamp; None when the scan is compensated already.
        keys: (K,) which of them are registered.
    """

    stamp: float
    cell_m: float
    range_m: float
    points: FloatArray
    elevations: FloatArray
    times: FloatArray | None
    keys: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.points)

    def state(self) -> State:
        """All of it."""
        names = ("stamp", "cell_m", "range_m", "points", "elevations", "times", "keys")
        return {name: getattr(self, name) for name in names}

    @classmethod
    def restored(cls, saved: Saved) -> "SampledScan":
        """The sample with a state."""
        points = saved.array("points", (None, 3))
        keys = saved.array("keys", (None,), np.intp)
        if len(keys) and not 0 <= keys.min() <= keys.max() < len(points):
            raise saved.refuse(f"keys go beyond {len(points)} points")
        return cls(
            saved.number("stamp"),
            saved.number("cell_m"),
            saved.number("range_m"),
            points,
            saved.array("elevations", (len(points),)),
            saved.optional_array("times", (len(points),)),
            keys,
        )

    @property
    def seen_until_s(self) -> float:
        """From the stamp to the last point; 0 when the scan is compensated already."""
        return 0.0 if self.times is None or not len(self) else max(0.0, float(self.times.max()))

    @property
    def seen_from_s(self) -> float:
        """From the first point to the stamp; 0 when the scan is compensated already."""
        return 0.0 if self.times is None or not len(self) else max(0.0, -float(self.times.min()))

    @cached_property
    def sweep(self) -> Sweep:
        """What is registered."""
        times = None if self.times is None else self.times.take(self.keys)
        return Sweep(self.points.take(self.keys, axis=0), times)


class Sampler:
    """Thins scans by the scale of the scene, which it follows."""

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self._cell_range_m = 0.0  # the median range that the cell size was chosen for
        self._range_m = 0.0

    def state(self) -> State:
        """The scale of the scene."""
        return {"cell_range_m": self._cell_range_m, "range_m": self._range_m}

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        self._cell_range_m, self._range_m = saved.number("cell_range_m"), saved.number("range_m")

    def sample(self, scan: Scan) -> SampledScan:
        """Choose the points of a scan."""
        squared = np.einsum("ij,ij->i", scan.points, scan.points)
        cell_m = self._follow_scene(squared)
        kept = one_per_cell(scan.points, _MAP_SPACING * cell_m)
        near, far = self._config.min_range_m**2, self._config.max_range_m**2
        inside = squared.take(kept)
        kept = kept[(inside > near) & (inside < far)]
        points = scan.points.take(kept, axis=0)
        ranges = np.sqrt(squared.take(kept))
        times = scan.time_offsets
        return SampledScan(
            stamp=scan.stamp,
            cell_m=cell_m,
            range_m=self._range_m,
            points=points,
            elevations=np.arcsin(points[:, 2] / ranges),
            times=None if times is None else times.take(kept),
            # Were they the last of the sweep, they would lie on the same side of every tree, and each scan would be
            # laid a little turned on the one before: a sensor that stands still would turn.
            keys=_thin_to(central_per_cell(points, _KEY_SPACING * cell_m), self._config.keypoints),
        )

    def _follow_scene(self, squared: FloatArray) -> float:
        """The cell size for the median range of the latest scans; it changes only when the scene has, clearly."""
        # A cover over the sensor, or a few stray points, are no other scene.
        if np.count_nonzero(squared > self._config.min_range_m**2) >= self._config.refinement.min_matches:
            median_m = float(np.sqrt(np.median(squared[:: max(1, len(squared) // 5000)])))
            new = self._range_m == 0.0
            self._range_m = median_m if new else self._range_m + _SCENE_MEMORY * (median_m - self._range_m)
        if self._config.cell_m is not None:
            return self._config.cell_m
        if self._range_m > 0.0 and not (
            self._cell_range_m / _OTHER_SCENE <= self._range_m <= self._cell_range_m * _OTHER_SCENE
        ):
            self._cell_range_m = self._range_m
        low, high = _CELL_BOUNDS_M
        return float(np.clip(self._cell_range_m / self._config.cells_per_range, low, high))


def _thin_to(index: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """About `count` of the indices, evenly, or all when there are fewer."""
    if len(index) <= count:
        return index
    return index[np.linspace(0, len(index) - 1, count).astype(np.intp)]
