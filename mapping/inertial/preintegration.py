"""Preintegration of IMU samples between scans (Forster et al., T-RO 2017), by GTSAM."""

import numpy as np
from gtsam import PreintegratedCombinedMeasurements, PreintegrationCombinedParams
from gtsam.imuBias import ConstantBias

from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.mapping.inertial.gyroscope import Integral

STANDARD_GRAVITY = 9.81  # m/s^2
# Least white noise: rad/s/sqrt(Hz) and m/s^2/sqrt(Hz); walk of the biases, rad/s/sqrt(s) and m/s^2/sqrt(s).
_GYROSCOPE, _ACCELEROMETER = 5e-4, 5e-3
_GYROSCOPE_WALK, _ACCELEROMETER_WALK = 1e-4, 1e-3
# Error of scale and axes, as a share of the turn and of the acceleration; error of the clock, seconds.
_SCALE, _CLOCK_S = 0.001, 0.001
_INTEGRATION = 1e-4  # m/s/sqrt(Hz)
# Longest step of the integration.
_STEP_S = 0.01


class Preintegration:
    """Samples in the LiDAR's axes, linear between their stamps.

    Args:
        samples: of at least three instants.
        R_lidar_imu: (3, 3) extrinsic rotation.
    """

    def __init__(self, samples: ImuSamples, R_lidar_imu: FloatArray) -> None:
        rates, forces = samples.angular_velocities @ R_lidar_imu.T, samples.accelerations @ R_lidar_imu.T
        self._stamps, self._integral = samples.stamps, Integral(samples.stamps, np.hstack([rates, forces]))
        # Second differences of samples show noise and vibration, which the integration takes for motion.
        second = np.diff(np.hstack([rates, forces]), n=2, axis=0).reshape(-1, 2, 3)
        self._variances = np.cumsum(np.pad((second**2).mean(axis=2) / 6.0, ((2, 0), (0, 0))), axis=0)

    def between(self, first_s: float, last_s: float, bias: FloatArray) -> PreintegratedCombinedMeasurements:
        """The measurements between two stamps, about a bias (6,), accelerometer first."""
        inside = self._stamps[np.searchsorted(self._stamps, first_s, "right") : np.searchsorted(self._stamps, last_s)]
        even = np.linspace(first_s, last_s, max(2, int(np.ceil((last_s - first_s) / _STEP_S)) + 1))
        instants = (
            np.union1d(inside, even) if len(inside) < len(even) else np.concatenate([[first_s], inside, [last_s]])
        )
        steps = np.diff(instants)
        means = self.means(instants)
        pim = PreintegratedCombinedMeasurements(
            self._noise(first_s, last_s, len(inside)), ConstantBias(bias[:3], bias[3:])
        )
        for step, mean in zip(steps, means, strict=True):
            if step > 0.0:
                pim.integrateMeasurement(mean[3:], mean[:3], step)
        return pim

    def means(self, instants: FloatArray) -> FloatArray:
        """(M - 1, 6) mean angular velocity and specific force between M instants."""
        inside = np.clip(instants, self._stamps[0], self._stamps[-1])
        steps = np.diff(inside)
        at_ends = self._integral.rates(inside[1:])
        with np.errstate(divide="ignore", invalid="ignore"):
            means = self._integral.between(inside) / steps[:, None]
        return np.where(steps[:, None] > 0.0, means, at_ends)

    def _noise(self, first_s: float, last_s: float, count: int) -> PreintegrationCombinedParams:
        interval_s = last_s - first_s
        begin, end = np.searchsorted(self._stamps, (first_s, last_s)).clip(0, len(self._stamps) - 1)
        variances = (self._variances[end] - self._variances[begin]) / max(end - begin, 1)
        densities2 = variances * interval_s / max(count, 1) + np.array([_GYROSCOPE, _ACCELEROMETER]) ** 2
        ends = self._integral.rates(np.clip([first_s, last_s], self._stamps[0], self._stamps[-1]))
        change = (ends[1] - ends[0]).reshape(2, 3)
        mean = self.means(np.array([first_s, last_s]))[0].reshape(2, 3)
        mean[1] -= STANDARD_GRAVITY * mean[1] / max(float(np.linalg.norm(mean[1])), 1e-9)
        systematic = _SCALE**2 * (mean**2).sum(axis=1) * interval_s**2 + _CLOCK_S**2 * (change**2).sum(axis=1)
        densities2 = densities2 + systematic / interval_s
        params = PreintegrationCombinedParams.MakeSharedU(STANDARD_GRAVITY)
        params.setGyroscopeCovariance(densities2[0] * np.eye(3))
        params.setAccelerometerCovariance(densities2[1] * np.eye(3))
        params.setIntegrationCovariance(_INTEGRATION**2 * np.eye(3))
        params.setBiasOmegaCovariance(_GYROSCOPE_WALK**2 * np.eye(3))
        params.setBiasAccCovariance(_ACCELEROMETER_WALK**2 * np.eye(3))
        return params
