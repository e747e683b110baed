"""One iteration of a scan's registration, compiled: linearise, weight robustly, solve for pose and velocity."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.compiled_motion import orthonormalize_nearly, write_exp, write_inverse, write_log, write_product
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.registration.gauss_newton import open_directions
from lidarslam.mapping.registration.local_map import Surfaces

# Standard deviation of a range measurement: no surface is known better.
RANGE_NOISE_M = 0.02
# Scale of the robust kernel: this many times the median residual, at least this share of a cell.
_SCALE_PER_MEDIAN, _LEAST_SCALE = 1.5, 0.03
# Residuals beyond this, in cells, are outliers.
_GATE = 6.0
# Errors of neighbouring points are correlated: this many count as one. From true errors on simulated recordings.
_CORRELATION = 4.0
# Degrees of freedom of the prediction's error.
_FREEDOM = 4.0
# Information of the prediction along degenerate directions: that of a tenth of a millimetre.
_DEGENERATE_INFORMATION = 1e8
# Rows of linearised residuals: Jacobian (6), residual, standard deviation of the surface, of the normal, seconds.
_RESIDUAL, _THICKNESS, _TILT, _TIME = 6, 7, 8, 9
_ROWS = 10
# Residuals that are added up together.
_BLOCK = 256


class Iteration(NamedTuple):
    """A Gauss-Newton step of pose and velocity, rotation first, and what it was computed from."""

    T_world_lidar: FloatArray  # (4, 4) after the step
    velocity: FloatArray  # (6,) after the step
    step: FloatArray  # (12,)
    rotation: float  # radians, of the step
    translation_m: float  # of the step
    error: FloatArray  # (12,) of the state before the step, compared with the prediction
    hessian: FloatArray  # (12, 12) of the correspondences
    gradient: FloatArray  # (12,) of the correspondences, before the step
    prior: FloatArray  # (12, 12) information of the prediction
    covariance: FloatArray  # (12, 12)
    directions: FloatArray  # (D, 6) that the correspondences do not constrain, see `Degeneracy`
    lever_m: float  # root mean square range


@compiled
def iterate(
    points: FloatArray, times: FloatArray, T_world_lidar: FloatArray, velocity: FloatArray, surfaces: Surfaces,
    inflation: FloatArray, cell_m: float, unknown: FloatArray, T_predicted: FloatArray, velocity_predicted: FloatArray,
    information: FloatArray,
) -> Iteration:  # fmt: skip
    """One step from a pose (4, 4) and a velocity (6,), for points (N, 3) of the LiDAR frame with some surfaces.

    The points have times (N,), seconds from the stamp, or none to keep the velocity; the Jacobian with the velocity is
    `t` times that with the pose, to first order. `inflation` (N,) are factors on the standard deviations of the
    surfaces. The kernel is as wide as the covariance (12, 12) of the error that may remain, `unknown`, propagates to
    each residual: the few points that constrain a direction are no outliers while it is unknown, however well all
    others fit. The prediction counts with its information (12, 12), and less the farther the state is from it.

    Raises:
        LinAlgError: neither the correspondences nor the prediction constrain a direction.
    """
    count = surfaces.counts.sum()
    linearised = np.empty((_ROWS, count))
    squared_range = _linearise(points, times, T_world_lidar, surfaces, inflation, linearised)
    total, error, change, moved = np.zeros((13, 13)), np.empty(12), np.empty((4, 4)), np.empty((4, 4))
    write_inverse(T_predicted, change)
    write_product(change, T_world_lidar, moved)
    write_log(moved, error[:6])
    for i in range(6):
        error[6 + i] = velocity[i] - velocity_predicted[i]
    prior = heavy_tailed(information, error)
    scale = max(_SCALE_PER_MEDIAN * _median_residual_m(linearised), _LEAST_SCALE * cell_m)
    weight, tilt, squared_time = _accumulate(linearised, scale * scale, _GATE * cell_m, unknown, total)
    lever_m = math.sqrt(squared_range / count)
    directions = open_directions(total[:6, :6], tilt, weight, lever_m)
    hessian, gradient, known = np.empty((12, 12)), np.empty(12), prior.copy()
    for i in range(12):
        gradient[i] = total[i, 12] / _CORRELATION
        for j in range(12):
            hessian[i, j] = total[i, j] / _CORRELATION
    # Along directions that are not constrained, the prediction is held, and the correspondences do not count.
    observed = hessian
    if len(directions):
        for i in range(6):
            for j in range(6):
                held = _DEGENERATE_INFORMATION * _along(directions, lever_m, i, j)
                known[i, j] += held
                known[6 + i, 6 + j] += squared_time * held
        onto = onto_observed(directions, lever_m)
        observed = onto.T @ hessian @ onto
    step = np.asarray(np.linalg.solve(hessian + known, -(known @ error) - gradient), dtype=np.float64)
    write_exp(step[:6], change)
    write_product(T_world_lidar, change, moved)
    orthonormalize_nearly(moved)
    covariance = np.ascontiguousarray(np.linalg.inv(observed + prior))
    rotation = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    translation_m = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    return Iteration(
        moved, velocity + step[6:], step, rotation, translation_m, error, hessian, gradient, prior, covariance,
        directions, lever_m,
    )  # fmt: skip


@compiled
def step_by(
    points: FloatArray, T_world_lidar: FloatArray, surfaces: Surfaces, chosen: NDArray[np.bool_], least: float
) -> float:
    """The step from a pose (4, 4), without a prediction, by the chosen of points (N, 3) alone, metres.

    Zero unless these constrain every direction so many times as well as the noise of their normals feigns.
    """
    counts = np.minimum(surfaces.counts, 1) * chosen
    alone = Surfaces(counts, surfaces.points, surfaces.normals, surfaces.thickness_m, surfaces.tilt)
    linearised, total, at_rest = np.empty((_ROWS, counts.sum())), np.zeros((13, 13)), np.empty(0)
    squared_range = _linearise(points, at_rest, T_world_lidar, alone, np.ones(len(points)), linearised)
    squared_scale = (_SCALE_PER_MEDIAN * _median_residual_m(linearised)) ** 2 + RANGE_NOISE_M**2
    _, tilt, _ = _accumulate(linearised, squared_scale, np.inf, np.zeros((12, 12)), total)
    lever_m = math.sqrt(squared_range / linearised.shape[1])
    hessian, gradient = np.empty((6, 6)), np.empty(6)
    for i in range(6):
        own = lever_m if i < 3 else 1.0
        gradient[i] = total[i, 12] / own
        for j in range(6):
            hessian[i, j] = total[i, j] / own / (lever_m if j < 3 else 1.0)
    values, _ = np.linalg.eigh(hessian)
    if values[0] < least * tilt:
        return 0.0
    step, squared = np.linalg.solve(hessian, gradient), 0.0
    for i in range(6):
        squared += step[i] ** 2
    return math.sqrt(squared)


@compiled
def heavy_tailed(information: FloatArray, error: FloatArray) -> FloatArray:
    """The information (12, 12) of a prediction that is off by an error (12,), for Student's distribution."""
    share = (_FREEDOM + len(error)) / (_FREEDOM + float(error @ information @ error))
    return min(1.0, share) * information


@compiled_part
def _along(directions: FloatArray, lever_m: float, i: int, j: int) -> float:
    """An entry of `Degeneracy.projector` of directions (D, 6)."""
    total = 0.0
    for d in range(len(directions)):
        total += directions[d, i] * directions[d, j]
    return total * (lever_m if i < 3 else 1.0) * (lever_m if j < 3 else 1.0)


@compiled
def onto_observed(directions: FloatArray, lever_m: float) -> FloatArray:
    """(12, 12) projector of pose and velocity onto the directions other than (D, 6)."""
    onto = np.eye(12)
    for i in range(6):
        for j in range(6):
            part = _along(directions, lever_m, i, j) / (lever_m * lever_m if i < 3 else 1.0)
            onto[i, j] -= part
            onto[6 + i, 6 + j] -= part
    return onto


@compiled_part
def _median_residual_m(linearised: FloatArray) -> float:
    """The upper median of the absolute residuals of (10, M)."""
    middle = linearised.shape[1] // 2
    return float(np.partition(np.abs(linearised[_RESIDUAL]), middle)[middle])


@compiled_part
def _linearise(
    points: FloatArray, times: FloatArray, T_world_lidar: FloatArray, surfaces: Surfaces, inflation: FloatArray,
    linearised: FloatArray,
) -> float:  # fmt: skip
    """Write a column (10,) for every residual of points (N, 3) of the LiDAR frame at a pose (4, 4).

    The Jacobian is for a motion from the right, rotation first. The sum of the squared ranges of the residuals' points
    is returned.
    """
    T, m, squared = T_world_lidar, 0, 0.0
    for n in range(len(points)):
        if surfaces.counts[n] == 0:
            continue
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        s = surfaces.points[n]
        a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3] - s[0]
        b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3] - s[1]
        c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3] - s[2]
        for k in range(surfaces.counts[n]):
            normal = surfaces.normals[n, k]
            u = T[0, 0] * normal[0] + T[1, 0] * normal[1] + T[2, 0] * normal[2]
            v = T[0, 1] * normal[0] + T[1, 1] * normal[1] + T[2, 1] * normal[2]
            w = T[0, 2] * normal[0] + T[1, 2] * normal[1] + T[2, 2] * normal[2]
            linearised[0, m], linearised[1, m], linearised[2, m] = y * w - z * v, z * u - x * w, x * v - y * u
            linearised[3, m], linearised[4, m], linearised[5, m] = u, v, w
            linearised[_RESIDUAL, m] = a * normal[0] + b * normal[1] + c * normal[2]
            linearised[_THICKNESS, m] = inflation[n] * surfaces.thickness_m[n, k]
            linearised[_TILT, m] = surfaces.tilt[n, k]
            linearised[_TIME, m] = times[n] if len(times) else 0.0
            squared += x * x + y * y + z * z
            m += 1
    return squared


@compiled_part
def _accumulate(
    linearised: FloatArray, squared_scale: float, gate_m: float, unknown: FloatArray, total: FloatArray
) -> tuple[float, float, float]:
    """Add the weighted products of residuals (10, M) up, with Geman and McClure's weights over the variances.

    The robust kernel is wider by the variance of each surface, and by that which the covariance (12, 12) of pose and
    velocity propagates to a residual. Into `total` (13, 13), zero before, go the Hessian of pose and velocity, and in
    the last column the gradient.

    Returns:
        The sums of the weights and of the weighted squares of the normals' standard deviations, and the mean square of
        the times.
    """
    weights, tilts, times, count = 0.0, 0.0, 0.0, linearised.shape[1]
    weighted, variance = np.zeros((13, _BLOCK)), np.empty(_BLOCK)
    for begin in range(0, count, _BLOCK):
        size = min(_BLOCK, count - begin)
        block = linearised[:, begin : begin + size]
        _propagate(block, unknown, variance)
        for m in range(size):
            r, t, tilt = block[_RESIDUAL, m], block[_TIME, m], block[_TILT, m]
            own = block[_THICKNESS, m] * block[_THICKNESS, m]
            kernel = 1.0 + r * r / (squared_scale + own + variance[m])
            weight = 0.0 if abs(r) > gate_m else 1.0 / (kernel * kernel * (own + RANGE_NOISE_M * RANGE_NOISE_M))
            variance[m] = math.sqrt(weight)
            weighted[12, m] = variance[m] * r
            weights += weight
            tilts += weight * tilt * tilt
            times += t * t
        for j in range(6):
            for m in range(size):
                weighted[j, m] = variance[m] * block[j, m]
                weighted[6 + j, m] = block[_TIME, m] * weighted[j, m]
        weighted[:, size:] = 0.0
        total += np.dot(weighted, weighted.T)
    return weights, tilts, times / max(count, 1)


@compiled_part
def _propagate(block: FloatArray, unknown: FloatArray, variance: FloatArray) -> None:
    """Write the variances (M,) of residuals (10, M) by the covariance (12, 12) of pose and velocity."""
    for m in range(block.shape[1]):
        variance[m] = 0.0
    for i in range(6):
        for j in range(i, 6):
            # Entries off the diagonal come twice; a processor takes several residuals at once.
            factor = 1.0 if i == j else 2.0
            pose, motion = factor * unknown[i, j], factor * unknown[6 + i, 6 + j]
            both = factor * (unknown[i, 6 + j] + unknown[j, 6 + i])
            for m in range(block.shape[1]):
                t = block[_TIME, m]
                variance[m] += block[i, m] * block[j, m] * (pose + t * (both + t * motion))
