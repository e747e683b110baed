"""Dynamic points of a map, by visibility: points that later or earlier range images saw through.

Now and then a scan leaves a small range image. A point of the map is dynamic where at least three images saw farther,
and no more of them saw a surface there. After Pomerleau et al., "Long-term 3D map maintenance in dynamic environments"
(ICRA 2014), and Kim and Kim, "Remove, then revert" (IROS 2020).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state.stateful import Shape, Stateful, Within
from lidarslam.mapping.global_map.visibility_kernels import NO_GAPS, TWO_PI, draw, judge

_ROWS, _COLUMNS = 16, 360
# Elevations of the first scan's points between these quantiles make the rows, so that strays do not stretch them.
_STRAY_SHARE = 0.002
_LEAST_HEIGHT = math.radians(1.0)
# Beams fill a row evenly when most fourths of all rows hold a tenth of the mean number of points.
_FOURTHS, _FILLED_OF_MEAN, _MOST = 4, 0.1, 0.6
_AT_CENTRE, _EVERYWHERE = 0.3, NO_GAPS
# Short recordings need an image of every second scan; of longer ones every fourth is enough, and costs half.
_EVERY, _EVERY_LATER = 2, 4
_MANY_IMAGES, _MOST_IMAGES = 64, 512
# Some four a pixel; more take time and show no more.
_ENOUGH_POINTS = 24_000
# Farther points are narrower than a pixel of so many voxels; near ones count all the same.
_PIXEL_OF_VOXEL = 3.0
_LEAST_REACH_M = 5.0
# Views that see through a dynamic point, at least.
_LEAST_THROUGH = 3


@dataclass(frozen=True, eq=False)
class PlacedViews:
    """Range images with poses."""

    images: NDArray[np.float32]  # (V, rows, columns) float32, the nearest range in each pixel, 0 where there is none
    # (V, 3) the elevation of the centre of row 0, radians; rows a radian; and the distance from the centre of a row, in
    # rows, up to which there are beams
    grids: FloatArray
    T_world_lidar: FloatArray  # (V, 4, 4)

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


class Views(Stateful):
    """Range images of every k-th scan in the map, at most 512 and 6 MB of them.

    k doubles when there would be more, and as long as it is less than 4, when there would be more than 64.

    Args:
        every: k at first.
    """

    _every: int
    _offered: int
    _grid: Annotated[FloatArray, Shape(3)] | None  # of the first scan with points
    _numbers: list[int]
    _images: list[Annotated[NDArray[np.float16], Shape(_ROWS, _COLUMNS), Within(low=0.0)]]

    def __init__(self, every: int = _EVERY) -> None:
        self._every, self._offered, self._grid = every, 0, None
        self._numbers, self._images = [], []

    def _after_restore(self) -> None:
        is_sorted = self._numbers == sorted({*self._numbers})
        if self._every < 1 or not is_sorted or len(self._numbers) != len(self._images):
            raise ValueError(
                f"{len(self._images)} images of every {self._every}th scan have {len(self._numbers)} numbers"
            )

    def __len__(self) -> int:
        return len(self._images)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Of the scans that the images are of."""
        return tuple(self._numbers)

    def add(self, points: FloatArray, number: int) -> None:
        """Offer the next scan that belongs in the map; one in k becomes an image.

        Args:
            points: (N, 3) in the LiDAR frame at the scan's stamp, compensated.
            number: of the scan in its recording, for its final pose.
        """
        if not len(points):
            return
        self._offered += 1
        if (self._offered - 1) % self._every:
            return
        if self._grid is None:
            self._grid = _grid_around(points)
        image = np.empty((_ROWS, _COLUMNS), dtype=np.float32)
        # An odd stride meets all lasers, whose numbers are powers of two, in whatever order points come.
        stride = -(-len(points) // _ENOUGH_POINTS) | 1
        draw(np.ascontiguousarray(points[::stride]), self._grid, image)
        self._numbers.append(number)
        self._images.append(image.astype(np.float16))
        if len(self) > (_MOST_IMAGES if self._every >= _EVERY_LATER else _MANY_IMAGES):
            self._every *= 2
            self._numbers, self._images = self._numbers[::2], self._images[::2]

    def placed(self, T_world_lidar: FloatArray) -> PlacedViews:
        """The images with the poses (N, 4, 4) of all scans of the recording; those of later scans are left out."""
        if self._grid is None:
            return PlacedViews.join([])
        known = [number < len(T_world_lidar) for number in self._numbers]
        images = np.array(self._images, dtype=np.float32)[known]
        return PlacedViews(images, np.tile(self._grid, (len(images), 1)), T_world_lidar[np.array(self._numbers)[known]])


def seen_through(
    points: FloatArray, views: PlacedViews, voxel_size_m: float, least_through: int = _LEAST_THROUGH
) -> NDArray[np.bool_]:
    """(M,) which points (M, 3) of a map, in the world, are dynamic: at least so many images see through them.

    An image with gaps between its beams counts half. Where more than 64 images see a point, as many are asked, from the
    whole time.
    """
    moved = np.zeros(len(points), dtype=np.bool_)
    reach_m = max(_LEAST_REACH_M, _PIXEL_OF_VOXEL * voxel_size_m * _COLUMNS / TWO_PI)
    order = np.random.default_rng(0).permutation(len(views))
    if len(points):  # views out of reach of all points have no vote
        sensors = views.T_world_lidar[order, :3, 3]
        off = sensors - np.clip(sensors, points.min(axis=0), points.max(axis=0))
        order = order[np.einsum("ij,ij->i", off, off) <= (reach_m + voxel_size_m) ** 2]
    T_lidar_world = np.ascontiguousarray(inverse(views.T_world_lidar[order]))
    images, grids = views.images[order], views.grids[order]
    judge(np.ascontiguousarray(points), T_lidar_world, images, grids, reach_m, voxel_size_m, least_through, moved)
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
