"""Where a scan is expected, from what its odometry says and how far that is to be trusted."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse, log
from mapping.config import MappingConfig
from mapping.prediction import Carrier, Prediction, Prior, State, predict

VELOCITY = np.array([0.1, -0.2, 0.5, 2.0, 0.3, -0.1])  # rad/s, m/s
MOVED = exp(0.1 * VELOCITY)
# What the odometry says differs from going on by 3 degrees and 20 cm.
OFF = np.array([0.03, -0.03, 0.03, 0.1, -0.1, 0.15])
AS_TOLD = MappingConfig(prior_caution=1.0)


def predicted(prior: Prior, config: MappingConfig | None = None, pose: FloatArray | None = None) -> Prediction:
    known = np.diag(np.array([0.02] * 3 + [0.05] * 3 + [0.5] * 3 + [1.0] * 3) ** 2)
    state = State(5.0, np.eye(4) if pose is None else pose, VELOCITY, known, seen_until_s=0.1)
    return predict(state, 5.1, prior, Carrier(), config or AS_TOLD)


def step(prediction: Prediction) -> FloatArray:
    """(6,) from where the sensor would be if it went on, to where it is expected."""
    return log(inverse(MOVED) @ prediction.T_world_lidar)


def isotropic(sigma: float) -> FloatArray:
    return sigma**2 * np.eye(6)


def test_without_an_odometry_the_sensor_goes_on() -> None:
    prediction = predicted(Prior())
    np.testing.assert_allclose(prediction.T_world_lidar, MOVED, atol=1e-12)
    np.testing.assert_allclose(prediction.velocity, VELOCITY)


def test_an_odometry_that_is_sure_is_believed() -> None:
    prediction = predicted(Prior(MOVED @ exp(OFF), covariance=isotropic(1e-5)))
    np.testing.assert_allclose(step(prediction), OFF, atol=1e-4)
    assert np.sqrt(np.diag(prediction.pose_covariance)).max() < 1.1e-5


def test_an_odometry_that_is_unsure_is_not() -> None:
    alone, with_prior = (predicted(p) for p in (Prior(), Prior(MOVED @ exp(OFF), covariance=isotropic(1e3))))
    np.testing.assert_allclose(step(with_prior), 0.0, atol=1e-6)
    np.testing.assert_allclose(with_prior.pose_covariance, alone.pose_covariance, rtol=1e-4, atol=1e-9)


def test_each_direction_is_believed_as_its_own_covariance_says() -> None:
    """In the frame of the sensor as it is now, wherever it is in the world."""
    covariance = isotropic(1e-4)
    covariance[3, 3] = 1e6
    for pose in (np.eye(4), exp([0.4, -0.3, 1.5, 10.0, -5.0, 2.0])):
        prediction = predicted(Prior(MOVED @ exp(OFF), covariance=covariance), pose=pose)
        moved = log(inverse(pose @ MOVED) @ prediction.T_world_lidar)
        np.testing.assert_allclose(np.delete(moved, 3), np.delete(OFF, 3), atol=2e-3)
        sigmas = np.sqrt(np.diag(prediction.pose_covariance))
        assert sigmas[3] > 0.005
        assert np.delete(sigmas, 3).max() < 2e-4


def test_an_odometry_is_believed_less_than_it_says_by_the_caution() -> None:
    motion = MOVED @ exp(OFF)
    cautious = predicted(Prior(motion, VELOCITY + 1.0, isotropic(0.01)), MappingConfig(prior_caution=5.0))
    told = predicted(Prior(motion, VELOCITY + 1.0, isotropic(0.05)))
    for name, value in vars(cautious).items():
        np.testing.assert_allclose(value, getattr(told, name), atol=1e-12)


def test_an_odometry_that_does_not_say_is_believed_as_configured() -> None:
    config = MappingConfig(prior_rotation_deg=2.0, prior_translation_m=0.3)
    sigmas = np.array([np.deg2rad(2.0)] * 3 + [0.3] * 3)
    motion = MOVED @ exp(OFF)
    silent = predicted(Prior(motion, VELOCITY + 1.0), config)
    told = predicted(Prior(motion, VELOCITY + 1.0, np.diag(sigmas**2)))
    for name, value in vars(silent).items():
        np.testing.assert_allclose(value, getattr(told, name), atol=1e-12)
    other = predicted(Prior(motion, VELOCITY + 1.0), MappingConfig(prior_translation_m=0.01))
    assert not np.allclose(silent.T_world_lidar, other.T_world_lidar, atol=1e-4)


@pytest.mark.parametrize(("sigma", "followed"), [(1e-6, 1.0), (1e4, 0.0)])
def test_velocities_are_believed_as_far_as_their_covariance_says(sigma: float, followed: float) -> None:
    faster = VELOCITY + 1.0
    prediction = predicted(Prior(velocity=faster, covariance=isotropic(sigma)))
    np.testing.assert_allclose(prediction.velocity, VELOCITY + followed, atol=1e-3)


def test_a_velocity_is_believed_less_than_the_motion_it_was_had_from() -> None:
    """Twice the deviation: of a carrier that shakes from sweep to sweep the odometry tells a part only."""
    sigma, widest = 1e-4, np.linalg.inv(predicted(Prior()).velocity_covariance)
    prediction = predicted(Prior(velocity=VELOCITY, covariance=isotropic(sigma)), MappingConfig(prior_caution=1.0))
    told = np.linalg.inv(prediction.velocity_covariance) - widest
    np.testing.assert_allclose(np.diag(told), (2.0 * sigma / 0.1) ** -2, rtol=1e-6)


def test_uncertainty_goes_along_with_the_sensor() -> None:
    """Half a metre along x of the last scan is along y of one that has turned by 90 degrees meanwhile."""
    turning = np.array([0.0, 0.0, 0.5 * np.pi / 0.1, 0.0, 0.0, 0.0])
    covariance = np.diag(np.array([1e-4] * 3 + [0.5, 1e-4, 1e-4] + [1e-4] * 6) ** 2)
    prediction = predict(State(5.0, np.eye(4), turning, covariance, 0.1), 5.1, Prior(), Carrier(), MappingConfig())
    sigmas = np.sqrt(np.diag(prediction.pose_covariance))
    assert sigmas[4] == pytest.approx(0.5, rel=0.01)
    assert sigmas[3] < 0.1
    A = adjoint(inverse(exp(0.1 * turning)))
    np.testing.assert_allclose((A @ [0, 0, 0, 1.0, 0, 0])[3:], [0.0, -1.0, 0.0], atol=1e-12)
