"""A MEMS inertial measurement unit on the LiDAR: samples of the exact motion, with noise and random-walk biases."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, log, make_transform
from lidarslam.core.imu import ImuSamples

GRAVITY = 9.81  # m/s^2, downwards along z of the world
# Half the base line of the central differences. Of a sway of 6 Hz they lose 1e-5 of the acceleration, and rounding of
# positions a kilometre from the origin costs 1e-5 m/s^2: both are a hundredth of a sample's noise or less.
_STEP_S = 2e-4
# Its stream of random numbers; those of the scans are numbered from 0.
_STREAM = 2**32 - 1

# Below and behind the LiDAR's centre, turned by about 180 degrees, as where the cable leaves in the other direction.
_T_LIDAR_IMU = make_transform(exp([0.02, -0.015, 3.11, 0.0, 0.0, 0.0])[:3, :3], [-0.05, 0.03, -0.08])


@dataclass(frozen=True)
class InertialErrors:
    """Errors of each axis of a gyroscope (unit u = rad/s) or an accelerometer (u = m/s^2)."""

    density: float  # of the white noise, u / sqrt(Hz)
    bias: float  # standard deviation of the bias at the start, u
    walk: float  # of the bias as a random walk, u / sqrt(s)


@dataclass(frozen=True, eq=False)
class ImuModel:
    """An IMU rigidly mounted on the LiDAR."""

    rate_hz: float
    gyroscope: InertialErrors
    accelerometer: InertialErrors
    T_lidar_imu: FloatArray  # (4, 4)


# A consumer's MEMS unit such as a BMI088: densities of its data sheet (0.014 deg/s and 175 ug per sqrt(Hz)), biases
# after a factory calibration (0.3 deg/s, 5 mg), walks of the size that Allan deviations of such units show.
MEMS_IMU = ImuModel(200.0, InertialErrors(2.4e-4, 5e-3, 3e-5), InertialErrors(1.7e-3, 5e-2, 5e-4), _T_LIDAR_IMU)
_NO_ERRORS = InertialErrors(0.0, 0.0, 0.0)
EXACT_IMU = ImuModel(200.0, _NO_ERRORS, _NO_ERRORS, _T_LIDAR_IMU)


def sample_imu(
    model: ImuModel, T_world_lidar_at: Callable[[FloatArray], FloatArray], first_s: float, last_s: float, seed: int
) -> ImuSamples:
    """Samples of a motion on the grid of the IMU's rate that begins at zero, from `first_s` to `last_s`, inclusive.

    The motion has to be twice differentiable between the two; outside, it is not evaluated.
    """
    stamps = np.arange(np.ceil(first_s * model.rate_hz), np.floor(last_s * model.rate_hz + 1e-6) + 1) / model.rate_hz
    # A motion may begin and end at speed: there the differences of the nearest instant inside are used.
    instants = np.clip(stamps, first_s + _STEP_S, last_s - _STEP_S)
    exact = np.hstack(_angular_velocity_and_force(model.T_lidar_imu, T_world_lidar_at, instants))
    rng = np.random.default_rng([seed, _STREAM])
    biases = bias_paths(model, len(stamps), seed)
    densities = np.repeat([model.gyroscope.density, model.accelerometer.density], 3)
    # White noise within the band of half the rate
    measured = exact + biases + densities * np.sqrt(model.rate_hz / 2.0) * rng.standard_normal(biases.shape)
    return ImuSamples(stamps, measured[:, :3], measured[:, 3:], model.T_lidar_imu)


def bias_paths(model: ImuModel, count: int, seed: int) -> FloatArray:
    """Biases (N, 6) of the first N samples, of the gyroscope (rad/s) and then of the accelerometer (m/s^2)."""
    rng = np.random.default_rng([seed, _STREAM, 1])
    both = (model.gyroscope, model.accelerometer)
    start = np.repeat([errors.bias for errors in both], 3) * rng.standard_normal(6)
    steps = np.repeat([errors.walk for errors in both], 3) / np.sqrt(model.rate_hz) * rng.standard_normal((count, 6))
    return np.asarray(start + np.cumsum(steps, axis=0))


def _angular_velocity_and_force(
    T_lidar_imu: FloatArray, T_world_lidar_at: Callable[[FloatArray], FloatArray], times: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Angular velocity (N, 3) and specific force R^T (a - g) (N, 3) in the IMU's frame, by central differences."""
    before, now, after = (T_world_lidar_at(times + step) @ T_lidar_imu for step in (-_STEP_S, 0.0, _STEP_S))
    angular_velocity = log(inverse(before) @ after)[:, :3] / (2.0 * _STEP_S)
    acceleration = (before[:, :3, 3] - 2.0 * now[:, :3, 3] + after[:, :3, 3]) / _STEP_S**2
    acceleration[:, 2] += GRAVITY
    return angular_velocity, np.einsum("nij,ni->nj", now[:, :3, :3], acceleration)
