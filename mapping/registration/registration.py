"""Scan-to-map registration: pose at the stamp, and velocity during the sweep, by point-to-plane Gauss-Newton.

Correspondences with the map's surfaces are updated at every iteration, as in LOAM (Zhang and Singh, RSS 2014), with
robust weights. The sensor moves during a sweep, so that its velocity is estimated together with its pose, as begin and
end of a scan are in CT-ICP (Dellenbach et al., ICRA 2022).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse, transform_points
from lidarslam.core.tracking import Degeneracy
from lidarslam.mapping.motion.deskew import Sweep, body_velocity
from lidarslam.mapping.motion.prediction import MeasuredPose, MotionState, Prediction
from lidarslam.mapping.registration.iteration import Iteration, heavy_tailed, iterate, onto_observed, step_by
from lidarslam.mapping.registration.local_map import COARSE, LocalMap, Matcher, Surfaces
from lidarslam.mapping.registration.sampled_scan import MIN_POINTS

# Iterations on each coarse level, and in all; the second pair where the start is a guess.
_ITERATIONS, _PATIENT_ITERATIONS = (3, 20), (10, 40)
# Steps below these end the iteration; on a coarse level, below this share of a cell.
_CONVERGED_ROTATION, _CONVERGED_TRANSLATION_M = np.deg2rad(0.02), 0.001
_COARSE_CONVERGED = 0.1
# The uncertainty of the prediction widens the kernel, less at each iteration.
_NARROWING = 0.8
# Share of the correspondences' information in the resulting covariance: scans have errors in common, which the balance
# with the prediction need not allow for. From true errors on real drives.
_INFORMATION_SHARE = 0.25
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


@dataclass(frozen=True, eq=False)
class Registration:
    """A registered scan."""

    T_world_lidar: FloatArray  # (4, 4) at the stamp
    velocity: FloatArray  # (6,) during the sweep, in the LiDAR frame, rotation first
    # (12, 12) of pose and velocity. The pose's error is `xi` in `T_true = T_world_lidar @ exp(xi)`: rotation first, in
    # the LiDAR frame, as GTSAM has it.
    covariance: FloatArray
    last: Iteration
    velocity_error: FloatArray  # (6,) of the predicted velocity
    iterations: int  # of Gauss-Newton
    matcher: Matcher  # with the correspondences of the keypoints in the finest cells
    held: FloatArray | None = None  # (6,) direction that is not measured, as the prediction was held along it

    @property
    def degeneracy(self) -> Degeneracy:
        """The directions along which the prediction was kept."""
        return Degeneracy(self.last.directions, self.last.lever_m)

    @property
    def observed(self) -> FloatArray:
        """(6, 6) projector onto the directions of motion that are not degenerate."""
        return onto_observed(self.last.directions, self.last.lever_m)[:6, :6]

    @property
    def measured(self) -> MeasuredPose:
        """The pose by the correspondences alone.

        The velocity during the sweep is marginalised, with the uncertainty of its prediction.
        """
        last, onto = self.last, onto_observed(self.last.directions, self.last.lever_m)
        H, g = onto.T @ last.hessian @ onto, onto.T @ (last.gradient + last.hessian @ last.step)
        known = np.linalg.inv(np.linalg.inv(last.prior)[6:, 6:])
        H[6:, 6:], g[6:] = H[6:, 6:] + known, g[6:] + known @ self.velocity_error
        gain = np.linalg.solve(H[6:, 6:], H[6:, :6]).T
        measured = MeasuredPose.minimum(self.T_world_lidar, H[:6, :6] - gain @ H[6:, :6], g[:6] - gain @ g[6:])
        measured = replace(measured, information=_INFORMATION_SHARE * measured.information)
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
    # The compiled iteration takes contiguous arrays.
    predicted = prediction.T_world_lidar, prediction.velocity, prediction.covariance
    T_predicted, velocity_predicted, covariance = map(np.ascontiguousarray, predicted)
    T_world_lidar, velocity, iterations = T_predicted, velocity_predicted, 0
    times = sweep.times if with_velocity and sweep.times is not None else np.empty(0)
    coarse, most = _PATIENT_ITERATIONS if patient else _ITERATIONS
    unknown = covariance
    try:
        information = uninflated = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        inflation = uniform = np.ones(len(sweep))
        for level in range(COARSE, -1, -1) if coarse_first else (0,):
            cell_m = local_map.cells_m[level]
            matcher = local_map.matcher(sweep, level, prediction.is_inertial)
            for _ in range(coarse if level else most - iterations):
                points, world = sweep.placed(velocity, T_world_lidar)
                matcher.match(world, T_world_lidar)
                if matcher.surfaces.counts.sum() < MIN_POINTS:
                    if level > 0:  # of a thin map
                        break
                    return None
                last = iterate(
                    points, times, T_world_lidar, velocity, matcher.surfaces, inflation, cell_m, unknown,
                    T_predicted, velocity_predicted, information,
                )  # fmt: skip
                T_world_lidar, velocity, iterations = last.T_world_lidar, last.velocity, iterations + 1
                unknown = _NARROWING**iterations * last.covariance
                if _has_converged(last, level, cell_m):
                    if level > 0 or inflation is not uniform:
                        break
                    factors = inflation_of_small(points, T_world_lidar, matcher.surfaces, local_map)
                    if factors is None:
                        break
                    # An odometry saw the same small surfaces.
                    inflation, unknown, information = factors, covariance, information / _INFLATION**2
        # Where no large surface observes a direction, the pose is still known by the prediction.
        onto = onto_observed(last.directions, last.lever_m)
        share, prior = _INFORMATION_SHARE * last.hessian, heavy_tailed(uninflated, last.error)
        covariance = np.asarray(np.linalg.inv(onto.T @ share @ onto + prior), dtype=np.float64)
    except np.linalg.LinAlgError:  # neither the map nor the prediction constrains the pose
        return None
    error = velocity - velocity_predicted
    return Registration(T_world_lidar, velocity, covariance, last, error, iterations, matcher)


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
    is_large = np.zeros(len(points), dtype=np.bool_)
    is_large[large] = True
    step_m = step_by(points, np.ascontiguousarray(T_world_lidar), surfaces, is_large, _SUFFICIENT)
    return np.where(is_large, 1.0, _INFLATION) if step_m > _CONTRADICTION_CELLS * local_map.cell_m else None


def _has_converged(last: Iteration, level: int, cell_m: float) -> bool:
    if level > 0:
        return last.translation_m + last.lever_m * last.rotation < _COARSE_CONVERGED * cell_m
    return last.rotation < _CONVERGED_ROTATION and last.translation_m < _CONVERGED_TRANSLATION_M
