"""Normal equations of point-to-plane residuals of two sweeps, in compiled loops."""

import numpy as np

from lidarslam.core.compiled import compiled, compiled_part, compiled_sums
from lidarslam.core.geometry import FloatArray
from lidarslam.odometry.alignment.correspondences import (
    BLOCK,
    IN_VIEW,
    INLIER,
    POINT_T,
    RESIDUAL,
    ROW,
    SIZE,
    STRIDE,
    TURNED_U,
    TURNED_V,
    TURNED_W,
    WEIGHTED,
    Motion,
    Planes,
    U,
    V,
    W,
    X,
    Y,
    Z,
    correspond,
)
from lidarslam.odometry.images.projection import Floats

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@compiled
def accumulate(
    points: Floats, count: int, planes: Planes, motion: Motion, scale_m: float, is_robust: bool, total: FloatArray,
    in_view: FloatArray, inlier: FloatArray,
) -> tuple[int, int]:  # fmt: skip
    """Sums over the correspondences of the first `count` points (7, N).

    A point seen t seconds after the middle of its sweep, on a pixel seen t' after that of its own, moves with the
    change of velocity (t + t') times as it does with the motion.

    Args:
        points, count, planes, motion: see above.
        scale_m: of the residuals.
        is_robust: all inliers, with Geman and McClure's weights; else those within twice the scale, unweighted.
        total: (13, 13), zero, written: H (12, 12) and, in the last column, g (12,) and the sum of squared residuals.
        in_view, inlier: (3, 3), zero, written unless robust: sums of squared normals in the previous frame, of points
            in view and of inliers.

    Returns:
        How many points are in view, and how many are inliers.
    """
    work = np.zeros(SIZE, dtype=np.float32)
    seen, matches = 0, 0
    for begin in range(0, count, BLOCK):
        size = min(BLOCK, count - begin)
        for quantity in range(7):
            row = points[quantity]
            for k in range(size):
                work[quantity * STRIDE + k] = row[begin + k]
        correspond(size, planes, motion, np.float32(scale_m), is_robust, work)
        _weigh(size, np.float32(scale_m), is_robust, work)
        for p in range(7):
            for q in range(p, 7):
                one, by_time, by_time_twice = _products(size, ROW + p * STRIDE, ROW + q * STRIDE, POINT_T, work)
                last = q == 6
                total[p if p < 6 else 12, 12 if last else q] += one
                if p < 6:
                    total[p + 6, 12 if last else q + 6] += by_time if last else by_time_twice
                    if not last:
                        total[p, q + 6] += by_time
        for k in range(size):
            seen += 1 if work[IN_VIEW + k] > _ZERO else 0
            matches += 1 if work[INLIER + k] > _ZERO else 0
        if not is_robust:
            for p in range(3):
                for q in range(p, 3):
                    sums = _products(size, TURNED_U + p * STRIDE, TURNED_U + q * STRIDE, INLIER, work)
                    in_view[p, q] += sums[0]
                    inlier[p, q] += sums[1]
    _mirror(total, in_view, inlier)
    return seen, matches


@compiled_part
def _weigh(size: int, scale_m: np.float32, is_robust: bool, work: Floats) -> None:
    """Write Jacobians and residuals times the roots of their weights, zero of outliers; and normals of what is seen."""
    each = _ONE / scale_m if is_robust else _ZERO
    for k in range(size):
        x, y, z, u, v, w = work[X + k], work[Y + k], work[Z + k], work[U + k], work[V + k], work[W + k]
        residual, keep = work[RESIDUAL + k], work[INLIER + k] > _ZERO
        share = residual * each
        root = _ONE / (_ONE + share * share)
        # Not times zero: what is no number would stay none.
        work[ROW + k] = root * (y * w - z * v) if keep else _ZERO
        work[ROW + STRIDE + k] = root * (z * u - x * w) if keep else _ZERO
        work[ROW + 2 * STRIDE + k] = root * (x * v - y * u) if keep else _ZERO
        work[ROW + 3 * STRIDE + k] = root * u if keep else _ZERO
        work[ROW + 4 * STRIDE + k] = root * v if keep else _ZERO
        work[ROW + 5 * STRIDE + k] = root * w if keep else _ZERO
        work[WEIGHTED + k] = root * residual if keep else _ZERO
    for k in range(size):
        seen = work[IN_VIEW + k] > _ZERO
        work[TURNED_U + k] = work[TURNED_U + k] if seen else _ZERO
        work[TURNED_V + k] = work[TURNED_V + k] if seen else _ZERO
        work[TURNED_W + k] = work[TURNED_W + k] if seen else _ZERO


@compiled_sums
def _products(size: int, first: int, second: int, by: int, work: Floats) -> tuple[float, float, float]:
    """The sum of the products of two quantities of a block, the same times a third, and times its square.

    In double precision, so that rounding leaves no information along directions that have none.
    """
    a, b, times = work[first : first + size], work[second : second + size], work[by : by + size]
    one, two, three = 0.0, 0.0, 0.0
    for k in range(size):
        product, time = np.float64(a[k]) * np.float64(b[k]), np.float64(times[k])
        one += product
        two += product * time
        three += product * time * time
    return one, two, three


@compiled_part
def _mirror(total: FloatArray, in_view: FloatArray, inlier: FloatArray) -> None:
    """Complete the sums from what is above the diagonals of their blocks."""
    for p in range(6):
        for q in range(p):
            total[p, q + 6] = total[q, p + 6]
    for p in range(13):
        for q in range(p):
            total[p, q] = total[q, p]
    for p in range(3):
        for q in range(p):
            in_view[p, q], inlier[p, q] = in_view[q, p], inlier[q, p]
