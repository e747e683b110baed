"""Dynamic points of a map, by visibility: points that later or earlier range images saw through.

Every few scans, a small range image is kept. A point of the map is dynamic where at least three images saw farther,
and no more of them saw a surface there. After Pomerleau et al., "Long-term 3D map maintenance in dynamic environments"
(ICRA 2014), and Kim and Kim, "Remove, then revert" (IROS 2020).

Row 0 of an image is the lowest; centres of rows are at integers, and columns begin at integers, from azimuth 0 towards
y. A pixel is 0 where nothing returned.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state import Shape, Stateful

Ranges = NDArray[np.float32]
TWO_PI = 2.0 * math.pi
# Of the nine pixels around a point, its own and this many in all must hold a return: glass and the sky are no evidence.
_LEAST_RETURNS = 6
# A return is at a point's range within this margin and a voxel: noise, errors of poses, and a surface seen at a slant.
_MARGIN_M = 0.1
_MARGIN_OF_RANGE = 0.01
# A dynamic point is seen through by at least as many views as support it. Of lasers with gaps between them most pass a
# thin board, which single ones meet: such views count half.
_WITH_GAPS = 0.5
# Half the height of a row: views whose beams pass this far from its centre have no gaps.
NO_GAPS = 0.5
# This many votes suffice to classify a point, where hundreds would be cast.
_ENOUGH = 64
_UNKNOWN, _SUPPORTS, _THROUGH = 0, 1, 2
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
# About four per pixel; more take time and show no more.
_ENOUGH_POINTS = 24_000
# Points at which a pixel is wider than this many voxels are left out, except near ones.
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
    """

    _every: int
    _offered: int
    _grid: Annotated[FloatArray, Shape(3)] | None  # of the first scan with points
    _numbers: list[int]
    _images: list[Annotated[NDArray[np.float16], Shape(_ROWS, _COLUMNS)]]

    def __init__(self, every: int = _EVERY) -> None:
        self._every, self._offered, self._grid = every, 0, None
        self._numbers, self._images = [], []

    def __len__(self) -> int:
        return len(self._images)

    def add(self, points: FloatArray, number: int) -> None:
        """Offer the next scan that belongs in the map, by its number in the recording; one in k becomes an image."""
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
    """(M,) which points (M, 3) of a map, in the world, are dynamic: at least `least_through` images see through them.

    An image with gaps between its beams counts half. Where more than 64 images see a point, 64 of them vote.
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


@compiled
def draw(points: FloatArray, grid: FloatArray, image: Ranges) -> None:
    """Draw the points (N, 3) into an image, in the sensor's frame: the nearest of each pixel."""
    image[:] = 0.0
    rows, columns = image.shape
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        distance = math.sqrt(x * x + y * y + z * z)
        if not (distance > 0.0 and distance < math.inf):
            continue
        row = math.floor((math.atan2(z, math.hypot(x, y)) - grid[0]) * grid[1] + 0.5)
        if row < 0 or row >= rows:
            continue
        column = _column(x, y, columns)
        if image[row, column] == 0.0 or distance < image[row, column]:
            image[row, column] = distance


@compiled
def judge(
    points: FloatArray, T_lidar_world: FloatArray, images: Ranges, grids: FloatArray, reach_m: float,
    voxel_size_m: float, least_through: int, moved: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Write which points (M, 3), in the world, moved, as images (V, rows, columns) in random order see them."""
    views = len(images)
    for m in range(len(points)):
        a, b, c = points[m, 0], points[m, 1], points[m, 2]
        through, support, weight = 0, 0, 0.0
        for v in range(views):
            vote = _vote(a, b, c, v, T_lidar_world, images, grids, reach_m, voxel_size_m)
            if vote == _THROUGH:
                through += 1
                weight += 1.0 if grids[v, 2] >= NO_GAPS else _WITH_GAPS
            elif vote == _SUPPORTS:
                support += 1
            # Most points are static: stop once the views that are left cannot turn the balance.
            left = views - 1 - v
            outvoted = through + left < least_through or weight + left < support
            if outvoted or through + support >= _ENOUGH:
                break
        moved[m] = through >= least_through and weight >= support


@compiled_part
def _vote(
    a: float, b: float, c: float, v: int, T: FloatArray, images: Ranges, grids: FloatArray, reach_m: float,
    voxel_size_m: float,
) -> int:  # fmt: skip
    """The vote of view v on the point (a, b, c); whole arrays, because slicing one costs more than all else."""
    _, rows, columns = images.shape
    x = T[v, 0, 0] * a + T[v, 0, 1] * b + T[v, 0, 2] * c + T[v, 0, 3]
    y = T[v, 1, 0] * a + T[v, 1, 1] * b + T[v, 1, 2] * c + T[v, 1, 3]
    z = T[v, 2, 0] * a + T[v, 2, 1] * b + T[v, 2, 2] * c + T[v, 2, 3]
    squared = x * x + y * y + z * z
    if not (squared <= reach_m * reach_m):
        return _UNKNOWN
    height = (math.atan2(z, math.hypot(x, y)) - grids[v, 0]) * grids[v, 1]
    row = math.floor(height + 0.5)
    if row < 0 or row >= rows:
        return _UNKNOWN
    column = _column(x, y, columns)
    distance = math.sqrt(squared)
    margin = _MARGIN_M + _MARGIN_OF_RANGE * distance + voxel_size_m
    returns, is_hidden = 0, False
    for i in range(max(row - 1, 0), min(row + 2, rows)):
        for j in range(column - 1, column + 2):
            seen = images[v, i, j % columns]
            if seen == 0.0:
                continue
            returns += 1
            if abs(seen - distance) <= margin:
                return _SUPPORTS
            if seen < distance:
                is_hidden = True
    # Between lasers that are far apart a board lies unseen: only a view whose beam passes the point may see through.
    is_looked_at = images[v, row, column] > 0.0 and abs(height - row) <= grids[v, 2]
    return _THROUGH if is_looked_at and returns >= _LEAST_RETURNS and not is_hidden else _UNKNOWN


@compiled_part
def _column(x: float, y: float, columns: int) -> int:
    """The column of a direction."""
    azimuth = math.atan2(y, x)
    if azimuth < 0.0:
        azimuth += TWO_PI
    # Just below 0 may be rounded to 2 pi, which is 0 again.
    return int(azimuth * columns / TWO_PI) % columns
