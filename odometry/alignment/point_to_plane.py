"""Point-to-plane normal equations of a pair of sweeps, and the quality of their alignment."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from lidarslam.odometry.alignment.correspondences import Motion, Planes
from lidarslam.odometry.alignment.residuals import accumulate
from lidarslam.odometry.alignment.sweep_motion import SweepPair
from lidarslam.odometry.images.projection import Floats
from lidarslam.odometry.images.sweep_images import SweepImages

# Twice as many rows add hardly any information if half as many points are taken of each.
_FULL_ROWS = 32
# How far along its row a pixel without a normal looks for one. A point is held against a plane, which goes on beyond
# its pixel; the gate sees to it that it does not go too far.
_FILL_COLUMNS = 4
# Scale of the residuals of inliers.
FINE_M = 0.05


@dataclass(frozen=True, eq=False)
class Fit:
    """Sums over the inliers of a motion, which have residuals within twice the finest scale."""

    H: FloatArray  # (12, 12) of the normal equations, each inlier with a weight of 1
    # in_view, inlier: (3, 3) of the squares of normals in the previous frame: of all points in view, and of inliers
    in_view: FloatArray
    inlier: FloatArray
    # share_in_view, inlier_share: of the points with a normal
    share_in_view: float
    inlier_share: float
    inliers: int  # how many
    squared_residuals: float  # their sum


class PointToPlane:
    """The points of the current sweep against the planes of the previous one.

    Args:
        sweeps: the pair.
        column_step: every so-manieth column's points are used.
    """

    def __init__(self, sweeps: SweepPair, column_step: int) -> None:
        self._points, self._count = _points(sweeps.current, column_step)
        self._planes = _planes(sweeps.previous)

    def normal_equations(self, motion: Motion, scale_m: float) -> tuple[FloatArray, FloatArray]:
        """H (12, 12) and g (12,) of squared residuals with Geman and McClure's weights of this scale.

        The unknowns are a change of T_prev_curr from the left, rotation first, and the change (6,) of velocity.
        """
        total, unused = np.zeros((13, 13)), np.zeros((3, 3))
        accumulate(self._points, self._count, self._planes, motion, scale_m, True, total, unused, unused)
        return total[:12, :12].copy(), total[:12, 12].copy()

    def fit(self, motion: Motion) -> Fit:
        """The inliers of a motion."""
        total, in_view, inlier = np.zeros((13, 13)), np.zeros((3, 3)), np.zeros((3, 3))
        seen, count = accumulate(self._points, self._count, self._planes, motion, FINE_M, False, total, in_view, inlier)
        points = max(self._count, 1)
        return Fit(total[:12, :12], in_view, inlier, seen / points, count / points, count, float(total[12, 12]))


def _points(images: SweepImages, column_step: int) -> tuple[Floats, int]:
    """(7, N or more) point, normal and seconds of pixels that have a normal, and N; of more rows fewer each."""
    height, width = images.offsets.shape
    fewer = max(1, height // _FULL_ROWS)
    room = np.empty((7, height * (width // (fewer * column_step) + 1)), dtype=np.float32)
    return room, _sample(images.points, images.normals, images.offsets, column_step, fewer, room)


def _planes(images: SweepImages) -> Planes:
    height, width = images.offsets.shape
    pixels = np.empty((height * width, 7), dtype=np.float32)
    _fill(images.points, images.normals, images.offsets, min(_FILL_COLUMNS, width - 1), pixels)
    return Planes(pixels, height, width, images.low, images.high, bool(images.offsets.any()))


@compiled
def _sample(points: Floats, normals: Floats, offsets: Floats, step: int, fewer: int, chosen: Floats) -> int:
    """Write (7, N) point, normal and seconds of one of `step * fewer` pixels of each row, if it has a normal; N.

    So many rows in turn begin a step later.
    """
    height, width = offsets.shape
    count = 0
    for i in range(height):
        for j in range(i % fewer * step, width, step * fewer):
            u, v, w = normals[0, i, j], normals[1, i, j], normals[2, i, j]
            if u * u + v * v + w * w > 0.5:
                for axis in range(3):
                    chosen[axis, count], chosen[3 + axis, count] = points[axis, i, j], normals[axis, i, j]
                chosen[6, count] = offsets[i, j]
                count += 1
    return count


@compiled
def _fill(points: Floats, normals: Floats, offsets: Floats, columns: int, pixels: Floats) -> None:
    """Write the pixels (H * W, 7) of images (3, H, W), (3, H, W), (H, W).

    Those without a normal get the nearest one in their row, up to so many columns away.
    """
    height, width = offsets.shape
    there = np.empty(width, dtype=np.bool_)
    for i in range(height):
        # Row by row: an index into all of an image is slower.
        x, y, z, u, v, w = points[0, i], points[1, i], points[2, i], normals[0, i], normals[1, i], normals[2, i]
        seconds = offsets[i]
        for j in range(width):
            there[j] = u[j] * u[j] + v[j] * v[j] + w[j] * w[j] > 0.5
        for j in range(width):
            source = j
            if not there[j]:
                for distance in range(1, columns + 1):
                    left, right = (j - distance) % width, (j + distance) % width
                    if there[left] or there[right]:
                        source = left if there[left] else right
                        break
            pixel = pixels[i * width + j]
            pixel[0], pixel[1], pixel[2], pixel[3] = x[source], y[source], z[source], u[source]
            pixel[4], pixel[5], pixel[6] = v[source], w[source], seconds[source]
