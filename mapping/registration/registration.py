"""Scan-to-map registration: pose at the stamp, and velocity during the sweep, by point-to-plane Gauss-Newton.

Correspondences with the map's surfaces are updated at every iteration, as in LOAM (Zhang and Singh, RSS 2014), with
robust weights. The sensor moves during a sweep, so that its velocity is estimated together with its pose, as begin and
end of a scan are in CT-ICP (Dellenbach et al., ICRA 2022).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray, displacement_m, exp, inverse, log, orthonormalize, transform_points
from lidarslam.core.tracking import Degeneracy, lever_scale
from lidarslam.mapping.motion.deskew import Sweep, body_velocity
from lidarslam.mapping.motion.prediction import MeasuredPose, MotionState, Prediction
from lidarslam.mapping.registration.gauss_newton import DEGENERATE_INFORMATION, degenerate_directions
from lidarslam.mapping.registration.local_map import COARSE, LocalMap, Matcher, Surfaces
from lidarslam.mapping.registration.sampled_scan import MIN_POINTS

# Iterations on each coarse level, and in all; the second pair where the start is a guess.
_ITERATIONS, _PATIENT_ITERATIONS = (3, 20), (10, 40)
# Steps below these end the iteration; on a coarse level, below this share of a cell.
_CONVERGED_ROTATION, _CONVERGED_TRANSLATION_M = np.deg2rad(0.02), 0.001
_COARSE_CONVERGED = 0.1
# Standard deviation of a range measurement: no surface is known better.
_RANGE_NOISE_M = 0.02
# Scale of the robust kernel: this many times the median residual, at least this share of a cell.
_SCALE_PER_MEDIAN, _LEAST_SCALE = 1.5, 0.03
# Residuals beyond this, in cells, are outliers.
_GATE = 6.0
# The uncertainty of the prediction widens the kernel, less at each iteration.
_NARROWING = 0.8
# Errors of neighbouring points are correlated: this many count as one. From true errors on simulated recordings.
_CORRELATION = 4.0
# Share of the correspondences' information in the resulting covariance: scans have errors in common, which the balance
# with the prediction need not allow for. From true errors on real drives.
_INFORMATION_SHARE = 0.25
# Degrees of freedom of the prediction's error.
_FREEDOM = 4.0
# A velocity that differs by less than this over the interval needs no second compensation.
_SAME_ROTATION, _SAME_TRANSLATION_M = np.deg2rad(0.1), 0.01

# The plane of a point is part of a large one, as a wall or floor, where the coarse cell has a plane of nearly its
# normal, no thicker than this share of that cell.
_SAME_COSINE, _MOST_THICKNESS = 0.94, 0.08
# Large surfaces suffice where they constrain every direction this many times as well as the noise of their normals.
_SUFFICIENT, _FEWEST_LARGE = 15.0, 100
# They contradict a pose from which they alone would move this many cells away. On recordings without crowds: below 0.1.
_CONTRADICTION_CELLS = 0.2
# Factor by which small surfaces are less certain then.
_INFLATION = 6.0
# Columns of a linearised residual: Jacobian (6), residual, standard deviation of the surface, of the normal, seconds.
RESIDUAL, THICKNESS, TILT, TIME = 6, 7, 8, 9
COLUMNS = 10
# Residuals that are added up together.
_BLOCK = 256


@dataclass(frozen=True, eq=False)
class Registration:
    """A registered scan."""

    T_world_lidar: FloatArray  # (4, 4) at the stamp
    velocity: FloatArray  # (6,) during the sweep, in the LiDAR frame, rotation first
    # (12, 12) of pose and velocity. The pose's error is `xi` in `T_true = T_world_lidar @ exp(xi)`: rotation first, in
    # the LiDAR frame, as GTSAM has it.
    covariance: FloatArray
    solution: "_Solution"  # of the last iteration
    velocity_error: FloatArray  # (6,) of the predicted velocity
    iterations: int  # of Gauss-Newton
    matcher: Matcher  # with the correspondences of the keypoints in the finest cells
    held: FloatArray | None = None  # (6,) direction that is not measured, as the prediction was held along it

    @property
    def degeneracy(self) -> Degeneracy:
        """The directions along which the prediction was kept."""
        return self.solution.system.degeneracy

    @property
    def observed(self) -> FloatArray:
        """(6, 6) projector onto the directions of motion that are not degenerate."""
        return self.solution.observed[:6, :6]

    @property
    def measured(self) -> MeasuredPose:
        """The pose by the correspondences alone."""
        measured = self.solution.measured(self.T_world_lidar, self.velocity_error)
        return measured if self.held is None else measured.without(self.held)

    def without(self, direction: FloatArray, prediction: Prediction) -> "Registration":
        """The registration, after holding a prediction along a direction (3,) of the world, with its uncertainty."""
        along = self.T_world_lidar[:3, :3].T @ direction
        uncertain = np.zeros((12, 2))
        uncertain[3:6, 0] = uncertain[9:, 1] = along
        added = uncertain @ (uncertain.T @ prediction.covariance @ uncertain) @ uncertain.T
        return replace(self, covariance=self.covariance + added, held=uncertain[:6, 0])


def register(
    sweep: Sweep, prediction: Prediction, local_map: LocalMap, with_velocity: bool, coarse_first: bool = True,
    patient: bool = False,
) -> Registration | None:  # fmt: skip
    """Register the keypoints of a sweep to the map; None where they have too few correspondences.

    The prediction is the start, and a prior with its covariance. Begins on coarse cells for predictions that may be
    off by more than half a cell; with more iterations if patient.
    """
    T_world_lidar, velocity, iterations = prediction.T_world_lidar, prediction.velocity, 0
    times = sweep.times if with_velocity and sweep.times is not None else np.empty(0)
    coarse, most = _PATIENT_ITERATIONS if patient else _ITERATIONS
    unknown = prediction.covariance
    try:
        prior = predicted = np.asarray(np.linalg.inv(prediction.covariance), dtype=np.float64)
        inflation = uniform = np.ones(len(sweep))
        for level in range(COARSE, -1, -1) if coarse_first else (0,):
            cell_m = local_map.cells_m[level]
            matcher = local_map.matcher(sweep, level, prediction.is_inertial)
            for _ in range(coarse if level else most - iterations):
                points = sweep.compensated(velocity)
                matcher.match(transform_points(T_world_lidar, points), T_world_lidar)
                system = _System.of(points, times, T_world_lidar, matcher.surfaces, inflation, cell_m, unknown)
                if system is None:
                    if level > 0:  # of a thin map
                        break
                    return None
                away = log(inverse(prediction.T_world_lidar) @ T_world_lidar)
                error = np.concatenate([away, velocity - prediction.velocity])
                solution = _solve(system, _heavy_tailed(prior, error), error)
                T_world_lidar = T_world_lidar @ exp(solution.step[:6])
                velocity = velocity + solution.step[6:]
                iterations += 1
                unknown = _NARROWING**iterations * solution.covariance()
                if _has_converged(solution.step, level, cell_m, system.degeneracy.lever_m):
                    if level > 0 or inflation is not uniform:
                        break
                    found = inflation_of_small(points, T_world_lidar, matcher.surfaces, local_map)
                    if found is None:
                        break
                    # An odometry saw the same small surfaces.
                    inflation, unknown, prior = found, prediction.covariance, prior / _INFLATION**2
        # Where no large surface observes a direction, the pose is still known by the prediction.
        covariance = replace(solution, prior=_heavy_tailed(predicted, error)).covariance(_INFORMATION_SHARE)
    except np.linalg.LinAlgError:  # neither the map nor the prediction constrains the pose
        return None
    T_world_lidar, error = orthonormalize(T_world_lidar), velocity - prediction.velocity
    return Registration(T_world_lidar, velocity, covariance, solution, error, iterations, matcher)


def with_mean_velocity(
    registration: Registration, sweep: Sweep, prediction: Prediction, last: MotionState, local_map: LocalMap,
    patient: bool,
) -> Registration | None:  # fmt: skip
    """The registration with the mean velocity since the last scan, where none was estimated during the sweep.

    A sweep that was compensated with another velocity is compensated and registered again.
    """
    interval_s = prediction.stamp - last.stamp
    velocity = body_velocity(inverse(last.T_world_lidar) @ registration.T_world_lidar, interval_s)
    change = np.abs(velocity - prediction.velocity) * interval_s
    same = np.linalg.norm(change[:3]) < _SAME_ROTATION and np.linalg.norm(change[3:]) < _SAME_TRANSLATION_M
    if sweep.times is not None and not same:
        again = replace(prediction, T_world_lidar=registration.T_world_lidar, velocity=velocity)
        second = register(sweep, again, local_map, with_velocity=False, coarse_first=False, patient=patient)
        if second is None:
            return None
        registration = second
        velocity = body_velocity(inverse(last.T_world_lidar) @ registration.T_world_lidar, interval_s)
    pose = registration.covariance[:6, :6]
    covariance = np.block([
        [pose, pose / interval_s],
        [pose / interval_s, (pose + last.covariance[:6, :6]) / interval_s**2],
    ])  # fmt: skip
    return replace(registration, velocity=velocity, covariance=covariance)


def are_large(local_map: LocalMap, points: FloatArray, normals: FloatArray, sensor: FloatArray) -> NDArray[np.bool_]:
    """Whether planes (N, 3) at points (N, 3) of the world, seen from (3,), are part of large ones."""
    coarse, spread_m = local_map.coarse_planes(points, sensor)
    is_thin = spread_m < _MOST_THICKNESS * local_map.cells_m[COARSE]
    return np.asarray(is_thin & (np.abs(np.einsum("ij,ij->i", normals, coarse)) > _SAME_COSINE))


def inflation_of_small(
    points: FloatArray, T_world_lidar: FloatArray, surfaces: Surfaces, local_map: LocalMap
) -> FloatArray | None:
    """Factors (N,) on the standard deviations of the points' surfaces, larger for small ones; None where these agree.

    Relative to a crowd that walks along, a sensor is at rest; only walls, floor and ceiling differ. In a bare
    corridor or a stairwell, large surfaces do not suffice for a pose, and small ones count in full. The points (N,
    3) of the LiDAR frame were registered at the pose (4, 4) to all surfaces with equal weight.
    """
    matched = np.flatnonzero(surfaces.counts)
    world, normals = transform_points(T_world_lidar, points[matched]), surfaces.normals[matched, 0]
    large = matched[are_large(local_map, world, normals, T_world_lidar[:3, 3])]
    if len(large) < _FEWEST_LARGE:
        return None
    inflation, counts = np.full(len(points), _INFLATION), np.zeros_like(surfaces.counts)
    inflation[large] = counts[large] = 1
    rows, total, at_rest = np.empty((len(large), COLUMNS)), np.zeros((13, 13)), np.empty(0)
    _, squared = linearise(points, at_rest, T_world_lidar, surfaces._replace(counts=counts), inflation, rows)
    squared_scale = (_SCALE_PER_MEDIAN * _median_residual_m(rows)) ** 2 + _RANGE_NOISE_M**2
    _, tilt, _ = accumulate(rows, squared_scale, _RANGE_NOISE_M, np.inf, np.zeros((3, 6, 6)), total)
    scale = lever_scale(float(np.sqrt(squared / len(large))))
    hessian = total[:6, :6] / np.outer(scale, scale)
    if np.linalg.eigvalsh(hessian)[0] < _SUFFICIENT * tilt:
        return None
    step_m = np.linalg.norm(np.linalg.solve(hessian, total[:6, 12] / scale))
    return inflation if step_m > _CONTRADICTION_CELLS * local_map.cell_m else None


def _heavy_tailed(prior: FloatArray, error: FloatArray) -> FloatArray:
    """The information (12, 12) of a prediction that is off by an error (12,), for Student's distribution."""
    share = (_FREEDOM + len(error)) / (_FREEDOM + float(error @ prior @ error))
    return min(1.0, share) * prior


def _has_converged(step: FloatArray, level: int, cell_m: float, lever_m: float) -> bool:
    if level > 0:
        return displacement_m(step[:6], lever_m) < _COARSE_CONVERGED * cell_m
    rotation, translation_m = np.linalg.norm(step[:3]), np.linalg.norm(step[3:6])
    return bool(rotation < _CONVERGED_ROTATION and translation_m < _CONVERGED_TRANSLATION_M)


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations (12, 12) and (12,) of pose and velocity, and the directions that they leave open."""

    hessian: FloatArray
    gradient: FloatArray
    degeneracy: Degeneracy
    squared_time: float  # mean square of the residuals' times

    @classmethod
    def of(
        cls, points: FloatArray, times: FloatArray, T_world_lidar: FloatArray, surfaces: Surfaces,
        inflation: FloatArray, cell_m: float, unknown: FloatArray,
    ) -> "_System | None":  # fmt: skip
        """Of points (N, 3) with times (N,), or none to keep the velocity; None where too few have a surface.

        The Jacobian with the velocity is `t` times that with the pose, to first order. The kernel is as wide as the
        covariance (12, 12) of the remaining error propagates to each residual: the few points that constrain a
        direction are no outliers while it is unknown, however well all others fit.
        """
        rows = np.empty((3 * len(points), COLUMNS))
        count, squared = linearise(points, times, np.ascontiguousarray(T_world_lidar), surfaces, inflation, rows)
        if count < MIN_POINTS:
            return None
        rows, total = rows[:count], np.zeros((13, 13))
        scale = max(_SCALE_PER_MEDIAN * _median_residual_m(rows), _LEAST_SCALE * cell_m)
        crossed = unknown[:6, 6:]
        of_time = np.array([unknown[:6, :6], crossed + crossed.T, unknown[6:, 6:]])
        weight, tilt, squared_time = accumulate(rows, scale**2, _RANGE_NOISE_M, _GATE * cell_m, of_time, total)
        degeneracy = degenerate_directions(total[:6, :6], tilt, weight, float(np.sqrt(squared / count)))
        return cls(total[:12, :12] / _CORRELATION, total[:12, 12] / _CORRELATION, degeneracy, squared_time)


@dataclass(frozen=True, eq=False)
class _Solution:
    """A Gauss-Newton step (12,), with the correspondences' normal equations and the prior's information (12, 12)."""

    step: FloatArray
    system: _System  # of the correspondences, before the step
    prior: FloatArray

    def covariance(self, share: float = 1.0) -> FloatArray:
        """(12, 12) with a share of the correspondences' information, none of it along degenerate directions."""
        observed = self.observed
        return np.asarray(
            np.linalg.inv(share * observed.T @ self.system.hessian @ observed + self.prior), dtype=np.float64
        )

    def measured(self, T_world_lidar: FloatArray, velocity_error: FloatArray) -> MeasuredPose:
        """The pose by the correspondences alone, from the pose (4, 4) and the velocity's error (6,) after the step.

        The velocity during the sweep is marginalised, with the uncertainty of its prediction.
        """
        observed, hessian = self.observed, self.system.hessian
        H, g = observed.T @ hessian @ observed, observed.T @ (self.system.gradient + hessian @ self.step)
        known = np.linalg.inv(np.linalg.inv(self.prior)[6:, 6:])
        H[6:, 6:], g[6:] = H[6:, 6:] + known, g[6:] + known @ velocity_error
        gain = np.linalg.solve(H[6:, 6:], H[6:, :6]).T
        pose = MeasuredPose.minimum(T_world_lidar, H[:6, :6] - gain @ H[6:, :6], g[:6] - gain @ g[6:])
        return replace(pose, information=_INFORMATION_SHARE * pose.information)

    @cached_property
    def observed(self) -> FloatArray:
        """(12, 12) projector onto the directions that are not degenerate."""
        scale, D = lever_scale(self.system.degeneracy.lever_m), self.system.degeneracy.directions
        observed = np.zeros((12, 12))  # several times as fast as `np.kron`
        observed[:6, :6] = observed[6:, 6:] = np.eye(6) - (D / scale).T @ (D * scale)
        return observed


def _solve(system: _System, prior: FloatArray, error: FloatArray) -> _Solution:
    """One Gauss-Newton step with a prior's information (12, 12), at an error (12,) of the present state from it."""
    held, holding = DEGENERATE_INFORMATION * system.degeneracy.projector(), np.zeros((12, 12))
    holding[:6, :6], holding[6:, 6:] = held, held * system.squared_time
    b = -(prior + holding) @ error - system.gradient
    step: FloatArray = np.asarray(np.linalg.solve(system.hessian + prior + holding, b), dtype=np.float64)
    return _Solution(step, system, prior)


def _median_residual_m(rows: FloatArray) -> float:
    """The upper median of the absolute residuals of rows (M, 10), in half the time of NumPy's."""
    middle = len(rows) // 2
    return float(np.partition(np.abs(rows[:, RESIDUAL]), middle)[middle])


@compiled
def linearise(
    points: FloatArray, times: FloatArray, T_world_lidar: FloatArray, surfaces: Surfaces, inflation: FloatArray,
    rows: FloatArray,
) -> tuple[int, float]:  # fmt: skip
    """Write a row (10,) for every residual of points (N, 3) of the LiDAR frame at a pose (4, 4).

    The Jacobian is for a motion from the right, rotation first. `times` (N,) are seconds from the stamp, or empty;
    `inflation` (N,) are factors on the standard deviation of each point's surface. Returned are the number of residuals
    and the sum of the squared ranges of their points.
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
    """Add the weighted products of rows (M, 10) up, with Geman and McClure's weights over the variances.

    The robust kernel is wider by the variance of each surface, and by the variance that the pose's covariance t seconds
    from the stamp, a polynomial in t of coefficients (3, 6, 6), propagates to a residual. Into `total` (13, 13), zero
    before, go the Hessian of pose and velocity, and in the last column the gradient.

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
