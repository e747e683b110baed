"""What has moved away, by what was seen through later or before: a map keeps the trails of all that passed otherwise.

Now and then a scan leaves a small range image. Where several of them saw farther than a point of the map, and no more
saw something there, the point is of something that passed. After Pomerleau et al., "Long-term 3D map maintenance in
dynamic environments" (ICRA 2014), and Kim and Kim, "Remove, then revert" (IROS 2020); but with the benefit of the doubt
for what stands.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state import Saved, State
from mapping.global_map.visibility_kernels import NO_GAPS, TWO_PI, draw, judge

_ROWS, _COLUMNS = 16, 360
# Elevations of the first scan's points between these quantiles make the rows, so that strays do not stretch them.
_STRAY_SHARE = 0.002
_LEAST_HEIGHT = math.radians(1.0)
# Whether there are beams all over a row is told by fourths of it: most hold a tenth of the mean number of points.
_FOURTHS, _FILLED_OF_MEAN, _MOST = 4, 0.1, 0.6
_AT_CENTRE, _EVERYWHERE = 0.3, NO_GAPS
# Short recordings need a view of every second scan; of longer ones every fourth is enough, and costs half.
_EVERY, _EVERY_LATER = 2, 4
_MANY_VIEWS, _MOST_VIEWS = 64, 512
# Some four a pixel; more take time and show no more.
_ENOUGH_POINTS = 24_000
# A view says nothing where a pixel is wider than so many voxels, but for what is near all the same.
_PIXEL_OF_VOXEL = 3.0
_LEAST_REACH_M = 5.0


@dataclass(frozen=True, eq=False)
class PlacedViews:
    """Range images, and where they were seen from.

    Attributes:
        images: (V, rows, columns) float32, the nearest range in each pixel, 0 where there is none.
        grids: (V, 3) the elevation of the centre of row 0, radians; rows a radian; and how far from the centre of a
            row beams pass for sure, in rows.
        T_world_lidar: (V, 4, 4).
    """

    images: NDArray[np.float32]
    grids: FloatArray
    T_world_lidar: FloatArray

    def __len__(self) -> int:
        return len(self.images)

    @classmethod
    def join(cls, parts: "Sequence[PlacedViews]") -> "PlacedViews":
        """All of them, of sensors that may differ, in one world."""
        return cls(
            np.concatenate([np.empty((0, _ROWS, _COLUMNS), dtype=np.float32), *(part.images for part in parts)]),
            np.concatenate([np.empty((0, 3)), *(part.grids for part in parts)]),
            np.concatenate([np.empty((0, 4, 4)), *(part.T_world_lidar for part in parts)]),
        )


class Views:
    """Range images of every k-th scan in the map, at most 512 and 6 MB of them.

    k doubles when there would be more, and as long as it is less than 4, when there would be more than 64.

    Args:
        every: k at first.
    """

    def __init__(self, every: int = _EVERY) -> None:
        self._every = every
        self._offered = 0
        self._grid: FloatArray | None = None  # (3,), of the first scan with points
        self._numbers: list[int] = []
        self._images: list[NDArray[np.float16]] = []

    def __len__(self) -> int:
        return len(self._images)

    def state(self) -> State:
        """All of it."""
        return {
            "every": self._every,
            "offered": self._offered,
            "grid": self._grid,
            "numbers": np.array(self._numbers, dtype=np.int64),
            "images": np.array(self._images, dtype=np.float16).reshape(-1, _ROWS, _COLUMNS),
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        numbers = saved.array("numbers", (None,), np.int64)
        images = saved.array("images", (len(numbers), _ROWS, _COLUMNS), np.float16)
        self._every, self._offered = saved.integer("every"), saved.integer("offered")
        if self._every < 1:
            raise saved.refuse("views are of every 0th scan")
        self._grid = saved.optional_array("grid", (3,))
        self._numbers, self._images = numbers.tolist(), [image.copy() for image in images]

    def add(self, points: FloatArray, number: int) -> None:
        """Offer the next scan that belongs in the map; one in k becomes a view.

        Args:
            points: (N, 3) in the LiDAR frame at the scan's stamp, compensated.
            number: of the scan in its recording, for its pose in the end.
        """
        if not len(points):
            return
        due = self._offered % self._every == 0
        self._offered += 1
        if not due:
            return
        if self._grid is None:
            self._grid = _grid_around(points)
        image = np.empty((_ROWS, _COLUMNS), dtype=np.float32)
        # An odd stride meets all lasers, whose numbers are powers of two, in whatever order points come.
        stride = -(-len(points) // _ENOUGH_POINTS) | 1
        draw(np.ascontiguousarray(points[::stride]), self._grid, image)
        self._numbers.append(number)
        self._images.append(image.astype(np.float16))
        if len(self) > (_MOST_VIEWS if self._every >= _EVERY_LATER else _MANY_VIEWS):
            self._every *= 2
            self._numbers, self._images = self._numbers[::2], self._images[::2]

    def placed(self, T_world_lidar: FloatArray) -> PlacedViews:
        """The views with the poses (N, 4, 4) of all scans of the recording; those of later scans are left out."""
        if self._grid is None:
            return PlacedViews.join([])
        known = [number < len(T_world_lidar) for number in self._numbers]
        images = np.array(self._images, dtype=np.float32)[known]
        return PlacedViews(images, np.tile(self._grid, (len(images), 1)), T_world_lidar[np.array(self._numbers)[known]])


def seen_through(points: FloatArray, views: PlacedViews, voxel_size_m: float) -> NDArray[np.bool_]:
    """Whether what was at the points has moved away: at least three views see through, and no fewer than do not.

    Of views with gaps between their beams it takes two for each that does not.

    Where more than 64 have something to say of a point, as many are heard, from the whole time.

    Args:
        points: (M, 3) of a map, in the world.
        views: in the same.
        voxel_size_m: of the map.

    Returns:
        (M,)
    """
    moved = np.zeros(len(points), dtype=np.bool_)
    reach_m = max(_LEAST_REACH_M, _PIXEL_OF_VOXEL * voxel_size_m * _COLUMNS / TWO_PI)
    # Not all views are heard where there are many: those that are should be from the whole time.
    order = np.random.default_rng(0).permutation(len(views))
    T_lidar_world = np.ascontiguousarray(inverse(views.T_world_lidar[order]))
    images, grids = views.images[order], views.grids[order]
    judge(np.ascontiguousarray(points), T_lidar_world, images, grids, reach_m, voxel_size_m, moved)
    return moved


def _grid_around(points: FloatArray) -> FloatArray:
    """The grid (3,) whose rows span the elevations of a scan's points (N, 3)."""
    elevations = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    low, high = np.quantile(elevations, [_STRAY_SHARE, 1.0 - _STRAY_SHARE])
    per_radian = (_ROWS - 1) / max(high - low, _LEAST_HEIGHT)
    fourths = (_FOURTHS * ((elevations - low) * per_radian + 0.5)).astype(np.intp)
    points_each = np.bincount(np.clip(fourths, 0, _FOURTHS * _ROWS - 1), minlength=_FOURTHS * _ROWS)
    filled = np.mean(points_each > _FILLED_OF_MEAN * points_each.mean())
    return np.array([low, per_radian, _EVERYWHERE if filled > _MOST else _AT_CENTRE])
