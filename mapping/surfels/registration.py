"""Scan-to-map registration: pose at the stamp, and velocity during the sweep, by point-to-plane Gauss-Newton.

Correspondences with the map's surfels are found anew at every iteration, as in LOAM (Zhang and Singh, RSS 2014), with
robust weights. The sensor moves during a sweep, so that its velocity is estimated together with its pose, as begin and
end of a scan are in CT-ICP (Dellenbach et al., ICRA 2022).
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.degeneracy import Degeneracy
from lidarslam.core.geometry import FloatArray, displacement_m, exp, inverse, log, orthonormalize, transform_points
from lidarslam.mapping.least_squares.degeneracy import DEGENERATE_INFORMATION, find_degeneracy
from lidarslam.mapping.least_squares.gauss_newton import geman_mcclure, point_to_plane_jacobian
from lidarslam.mapping.motion.deskew import Sweep, body_velocity
from lidarslam.mapping.motion.prediction import MotionState, Prediction
from lidarslam.mapping.surfels.sampling import MIN_CORRESPONDENCES
from lidarslam.mapping.surfels.surfel_map import LEVELS, Correspondences, SurfelMap

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
# Errors of neighbouring points are correlated: so many count as one. From true errors on simulated recordings.
_CORRELATION = 25.0
# A velocity that differs by less than this over the interval needs no second compensation.
_SAME_ROTATION, _SAME_TRANSLATION_M = np.deg2rad(0.1), 0.01


@dataclass(frozen=True, eq=False)
class Registration:
    """A registered scan."""

    T_world_lidar: FloatArray  # (4, 4) at the stamp
    velocity: FloatArray  # (6,) during the sweep, in the LiDAR frame, rotation first
    # (12, 12) of pose and velocity. The pose's error is `xi` in `T_true = T_world_lidar @ exp(xi)`: rotation first, in
    # the LiDAR frame, as GTSAM has it.
    covariance: FloatArray
    degeneracy: Degeneracy  # the directions along which the prediction was kept
    iterations: int  # of Gauss-Newton


def register(
    sweep: Sweep, prediction: Prediction, surfel_map: SurfelMap, with_velocity: bool, coarse_first: bool = True,
    patient: bool = False,
) -> Registration | None:  # fmt: skip
    """Register a sweep to the map; None where it has too few correspondences.

    Args:
        sweep: the keypoints.
        prediction: start, and prior with its covariance.
        surfel_map: local map.
        with_velocity: whether to estimate the velocity during the sweep.
        coarse_first: whether to begin on coarse cells, for predictions that may be off by more than half a cell.
        patient: whether to allow more iterations.
    """
    T_world_lidar, velocity, iterations = prediction.T_world_lidar, prediction.velocity, 0
    coarse, most = _PATIENT_ITERATIONS if patient else _ITERATIONS
    try:
        for level in reversed(range(len(LEVELS))) if coarse_first else (0,):
            cell_m = surfel_map.cell_m * LEVELS[level]
            for _ in range(coarse if level else most - iterations):
                points = sweep.compensated(velocity)
                matches = surfel_map.match(transform_points(T_world_lidar, points), T_world_lidar, level)
                if len(matches) < MIN_CORRESPONDENCES:
                    return None
                system = _Linearised.at(T_world_lidar, points, matches, cell_m)
                times = sweep.times.take(matches.index) if with_velocity and sweep.times is not None else None
                solution = _solve(system, times, prediction, T_world_lidar, velocity)
                T_world_lidar = T_world_lidar @ exp(solution.step[:6])
                velocity = velocity + solution.step[6:]
                iterations += 1
                if _has_converged(solution.step, level, cell_m, system.lever_m):
                    break
        covariance = solution.covariance()
    except np.linalg.LinAlgError:  # neither the map nor the prediction constrains the pose
        return None
    return Registration(orthonormalize(T_world_lidar), velocity, covariance, solution.degeneracy, iterations)


def with_mean_velocity(
    registration: Registration, sweep: Sweep, prediction: Prediction, last: MotionState, surfel_map: SurfelMap,
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
        second = register(sweep, again, surfel_map, with_velocity=False, coarse_first=False, patient=patient)
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


def _has_converged(step: FloatArray, level: int, cell_m: float, lever_m: float) -> bool:
    if level > 0:
        return displacement_m(step[:6], lever_m) < _COARSE_CONVERGED * cell_m
    rotation, translation_m = np.linalg.norm(step[:3]), np.linalg.norm(step[3:6])
    return bool(rotation < _CONVERGED_ROTATION and translation_m < _CONVERGED_TRANSLATION_M)


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Residuals (M,), their Jacobian (M, 6), information (M,) and tilt (M,) of the normals, at a pose."""

    residuals: FloatArray
    jacobian: FloatArray
    weights: FloatArray
    tilt: FloatArray
    lever_m: float

    @classmethod
    def at(
        cls, T_world_lidar: FloatArray, points: FloatArray, matches: Correspondences, cell_m: float
    ) -> "_Linearised":
        p = points.take(matches.index, axis=0)
        residuals = matches.residuals(transform_points(T_world_lidar, p))
        jacobian = point_to_plane_jacobian(p, matches.normals @ T_world_lidar[:3, :3])
        size, thickness2 = np.abs(residuals), matches.thickness_m**2
        scale = max(_SCALE_PER_MEDIAN * float(np.median(size)), _LEAST_SCALE * cell_m)
        weights = geman_mcclure(size, scale**2 + thickness2, thickness2 + _RANGE_NOISE_M**2)
        weights[size > _GATE * cell_m] = 0.0
        lever_m = float(np.sqrt(np.einsum("ij,ij->", p, p) / max(len(p), 1)))
        return cls(residuals, jacobian, weights, matches.tilt, lever_m)


@dataclass(frozen=True, eq=False)
class _Solution:
    """A Gauss-Newton step (12,), with the Hessian (12, 12) of the correspondences and the prior's information."""

    step: FloatArray
    hessian: FloatArray
    prior: FloatArray
    degeneracy: Degeneracy

    def covariance(self) -> FloatArray:
        """(12, 12); along degenerate directions the correspondences' information does not count."""
        scale = np.array([self.degeneracy.lever_m] * 3 + [1.0] * 3)
        D = self.degeneracy.directions
        observed = np.kron(np.eye(2), np.eye(6) - (D / scale).T @ (D * scale))
        return np.asarray(np.linalg.inv(observed.T @ self.hessian @ observed + self.prior), dtype=np.float64)


def _solve(
    system: _Linearised, times: FloatArray | None, prediction: Prediction, T_world_lidar: FloatArray,
    velocity: FloatArray,
) -> _Solution:  # fmt: skip
    """One Gauss-Newton step of pose and, where `times` (M,) are given, velocity.

    The Jacobian with the velocity is `t` times that with the pose, to first order.
    """
    J, r = system.jacobian, system.residuals
    degeneracy = find_degeneracy(J, system.weights, system.tilt, system.lever_m)
    held = DEGENERATE_INFORMATION * degeneracy.projector()
    prior: FloatArray = np.asarray(np.linalg.inv(prediction.covariance), dtype=np.float64)
    error = np.concatenate([log(inverse(prediction.T_world_lidar) @ T_world_lidar), velocity - prediction.velocity])
    JW = J * (system.weights / _CORRELATION)[:, None]
    hessian, holding, b = np.zeros((12, 12)), np.zeros((12, 12)), -prior @ error
    hessian[:6, :6], holding[:6, :6] = JW.T @ J, held
    b[:6] -= JW.T @ r + held @ error[:6]
    if times is not None:
        Jt, JWt = J * times[:, None], JW * times[:, None]
        hessian[:6, 6:] = JW.T @ Jt
        hessian[6:, :6] = hessian[:6, 6:].T
        hessian[6:, 6:], holding[6:, 6:] = JWt.T @ Jt, held * float(np.mean(times**2))
        b[6:] -= JWt.T @ r + holding[6:, 6:] @ error[6:]
    step: FloatArray = np.asarray(np.linalg.solve(hessian + prior + holding, b), dtype=np.float64)
    return _Solution(step, hessian, prior, degeneracy)
