"""Linearised point-to-plane residuals and their normal equations: the compiled loops of scan-to-map registration."""

import math

import numpy as np

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.registration.local_map import Surfaces

# Columns of a linearised residual: Jacobian (6), residual, standard deviation of the surface, of the normal, seconds.
RESIDUAL, THICKNESS, TILT, TIME = 6, 7, 8, 9
COLUMNS = 10
# Residuals that are added up together.
_BLOCK = 256


@compiled
def linearise(
    points: FloatArray, times: FloatArray, T_world_lidar: FloatArray, surfaces: Surfaces, inflation: FloatArray,
    rows: FloatArray,
) -> tuple[int, float]:  # fmt: skip
    """Write a row (10,) for every residual of points (N, 3) of the LiDAR frame at a pose (4, 4).

    The Jacobian is for a motion from the right, rotation first. `times` (N,) are seconds from the stamp, or empty;
    `inflation` (N,) are factors on the standard deviation of each point's surface.

    Returns:
        Number of residuals, and the sum of the squared ranges of their points.
    """
    T, count, squared = T_world_lidar, 0, 0.0
    for n in range(len(points)):
        if surfaces.counts[n] == 0:
            continue
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        s = surfaces.points[n]
        a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3] - s[0]
        b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3] - s[1]
        c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3] - s[2]
        for k in range(surfaces.counts[n]):
            normal, row = surfaces.normals[n, k], rows[count]
            u = T[0, 0] * normal[0] + T[1, 0] * normal[1] + T[2, 0] * normal[2]
            v = T[0, 1] * normal[0] + T[1, 1] * normal[1] + T[2, 1] * normal[2]
            w = T[0, 2] * normal[0] + T[1, 2] * normal[1] + T[2, 2] * normal[2]
            row[0], row[1], row[2] = y * w - z * v, z * u - x * w, x * v - y * u
            row[3], row[4], row[5] = u, v, w
            row[RESIDUAL] = a * normal[0] + b * normal[1] + c * normal[2]
            row[THICKNESS], row[TILT] = inflation[n] * surfaces.thickness_m[n, k], surfaces.tilt[n, k]
            row[TIME] = times[n] if len(times) else 0.0
            squared += x * x + y * y + z * z
            count += 1
    return count, squared


@compiled
def accumulate(
    rows: FloatArray, squared_scale: float, noise_m: float, gate_m: float, unknown: FloatArray, total: FloatArray
) -> tuple[float, float, float]:
    """Add the weighted products of residuals (M, 10) up, with Geman and McClure's weights over the variances.

    Args:
        rows: of `linearise`.
        squared_scale: of the robust kernel, to which the variance of each surface is added.
        noise_m: standard deviation of a range.
        gate_m: residuals beyond do not count.
        unknown: (3, 6, 6) coefficients of the pose's covariance t seconds from the stamp, a polynomial in t; the
            variance that it propagates to a residual widens the kernel.
        total: (13, 13), zero, written: the Hessian of pose and velocity, and in the last column the gradient.

    Returns:
        The sums of the weights and of the weighted squares of the normals' standard deviations, and the mean square of
        the times.
    """
    block = np.empty((_BLOCK, 13))
    weights, tilts, times = 0.0, 0.0, 0.0
    for begin in range(0, len(rows), _BLOCK):
        size = min(_BLOCK, len(rows) - begin)
        for i in range(size):
            row, out = rows[begin + i], block[i]
            r, variance, t = row[RESIDUAL], row[THICKNESS] * row[THICKNESS], row[TIME]
            kernel = 1.0 + r * r / (squared_scale + variance + _propagated(row, t, unknown))
            weight = 0.0 if abs(r) > gate_m else 1.0 / (kernel * kernel * (variance + noise_m * noise_m))
            root = math.sqrt(weight)
            for j in range(6):
                out[j] = root * row[j]
                out[6 + j] = t * out[j]
            out[12] = root * r
            weights += weight
            tilts += weight * row[TILT] * row[TILT]
            times += t * t
        total += np.dot(block[:size].T, block[:size])
    return weights, tilts, times / max(len(rows), 1)


@compiled_part
def _propagated(row: FloatArray, t: float, unknown: FloatArray) -> float:
    """The variance of a residual (10,) by the covariance of the pose t seconds from the stamp, as for `accumulate`."""
    variance = 0.0
    for i in range(6):
        part = 0.0
        for j in range(6):
            part += row[j] * (unknown[0, i, j] + t * (unknown[1, i, j] + t * unknown[2, i, j]))
        variance += row[i] * part
    return variance
