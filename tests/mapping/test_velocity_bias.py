"""The bias that the velocities during successive sweeps have in common."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.mapping.motion.prediction import MotionState, VelocityBias
from lidarslam.mapping.surfels.surfel_map import SurfelMap

INTERVAL_S = 0.1
VELOCITY = np.array([0.02, -0.01, 0.1, 5.0, 0.2, -0.1])  # rad/s, m/s
MOTION = exp(INTERVAL_S * VELOCITY)
BIAS = np.array([0.01, 0.0, -0.04, 0.1, -0.15, 0.05])
GAINS = SurfelMap.velocity_gains
COVARIANCE = np.diag(np.array([0.001] * 3 + [0.01] * 3 + [0.02] * 3 + [0.2] * 3) ** 2)


def swept(number: int, velocity: FloatArray, seen_from_s: float) -> MotionState:
    """A scan of a sensor that moves steadily, with an estimate of its velocity."""
    T_world_lidar = exp(number * INTERVAL_S * VELOCITY)
    return MotionState(number * INTERVAL_S, T_world_lidar, velocity, COVARIANCE, INTERVAL_S - seen_from_s)


@pytest.mark.parametrize("seen_from_s", [0.0, 0.05, 0.1])
def test_what_all_sweeps_have_in_common_is_corrected(seen_from_s):
    """With stamps at the beginning of the sweeps, in their middle, and at their end."""
    bias, last = VelocityBias(), swept(0, VELOCITY + BIAS, seen_from_s)
    for number in range(1, 60):
        state = swept(number, VELOCITY + BIAS, seen_from_s)
        bias = bias.updated(last, state, seen_from_s, GAINS)
        last = bias.corrected(state)
    np.testing.assert_allclose(last.velocity, VELOCITY, atol=1e-6)
    np.testing.assert_allclose(bias.correction, -BIAS, atol=1e-6)


def test_a_sudden_acceleration_is_no_bias():
    """Of 360 deg/s and 30 m/s, 2.4 degrees and 10 cm per second are taken over."""
    sudden = np.array([0.0, 0.0, np.deg2rad(360.0), 30.0, 0.0, 0.0])
    bias = VelocityBias().updated(swept(0, VELOCITY - sudden, 0.0), swept(1, VELOCITY, 0.0), 0.0, GAINS)
    np.testing.assert_allclose(bias.correction[[2, 3]], [np.deg2rad(2.4), 0.1], rtol=1e-6)


def test_a_gap_between_sweeps_begins_anew():
    for last, now in ((0, 2), (1, 1)):
        bias = VelocityBias(BIAS).updated(swept(last, VELOCITY, 0.0), swept(now, VELOCITY, 0.0), 0.0, GAINS)
        assert not bias.correction.any()


def test_the_pose_follows_as_it_is_correlated():
    """Known best in the middle of a sweep, the pose at its begin goes back by half of the velocity's sweep."""
    covariance = COVARIANCE.copy()
    covariance[:6, 6:] = covariance[6:, :6] = -0.5 * INTERVAL_S * COVARIANCE[6:, 6:]
    state = MotionState(0.0, MOTION, VELOCITY, covariance, INTERVAL_S)
    corrected = VelocityBias(BIAS).corrected(state)
    np.testing.assert_allclose(log(inverse(MOTION) @ corrected.T_world_lidar), -0.05 * BIAS, atol=1e-12)
    np.testing.assert_allclose(corrected.velocity, VELOCITY + BIAS)


def test_the_loop_of_correction_and_map_is_damped():
    """Where the next velocity follows from the map of corrected sweeps, a bias dies away: its swings do not last."""
    bias, last, errors = VelocityBias(), swept(0, VELOCITY + BIAS, 0.05), []
    for number in range(1, 30):
        state = swept(number, last.velocity, 0.05)
        bias = bias.updated(last, state, 0.05, GAINS)
        last = bias.corrected(state)
        errors.append((last.velocity - VELOCITY) / np.where(BIAS == 0.0, np.inf, BIAS))
    assert np.abs(errors[15:]).max() < 0.15
