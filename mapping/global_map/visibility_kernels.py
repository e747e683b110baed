"""Compiled loops over points and pixels behind `mapping.global_map.moved_points`.

An image is (rows, columns) of ranges in metres, 0 where nothing returned; row 0 is the lowest, centres of rows are at
integers, and columns begin at integers, from azimuth 0 towards y. A grid is (3,): the elevation of the centre of row 0,
radians, rows a radian, and how far from the centre of a row, in rows, beams pass for sure.
"""

import math

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray

Ranges = NDArray[np.float32]
TWO_PI = 2.0 * math.pi

# Of the nine pixels around a point, its own and so many in all must hold a return: glass and the sky prove nothing.
_LEAST_RETURNS = 6
# A return is at a point's range within this margin and a voxel: noise, errors of poses, and a surface seen at a slant.
_MARGIN_M = 0.1
_MARGIN_OF_RANGE = 0.01
# A dynamic point is seen through by at least as many views as support it. Of lasers with gaps between them most pass a
# thin board, which single ones meet: such views count half.
_WITH_GAPS = 0.5
# Half the height of a row: views whose beams pass this far from its centre have no gaps.
NO_GAPS = 0.5
# So many votes are enough to classify a point by, where hundreds would be cast.
_ENOUGH = 64

_UNKNOWN, _SUPPORTS, _THROUGH = 0, 1, 2


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
    points: FloatArray,
    T_lidar_world: FloatArray,
    images: Ranges,
    grids: FloatArray,
    reach_m: float,
    voxel_size_m: float,
    least_through: int,
    moved: NDArray[np.bool_],
) -> None:
    """Classify the points (M, 3): dynamic or static.

    Args:
        points: in the world.
        T_lidar_world: (V, 4, 4) of the views.
        images, grids: (V, rows, columns) and (V, 3), the views, in random order.
        reach_m: farther points get no vote.
        voxel_size_m: of the map that the points are of.
        least_through: of a dynamic point, how many views see through it at least.
        moved: (M,) written.
    """
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
    a: float,
    b: float,
    c: float,
    v: int,
    T: FloatArray,
    images: Ranges,
    grids: FloatArray,
    reach_m: float,
    voxel_size_m: float,
) -> int:
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
