"""Odometry that does not look at the points."""

import numpy as np
import pytest

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import exp
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.odometry.config import OdometryConfig
from lidarslam.odometry.interface import ConstantVelocity
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.odometry.registry import make_odometry

VELOCITY = np.array([0.1, -0.2, 1.5, 2.0, 0.3, -0.1])


def scan_at(stamp: float) -> Scan:
    return Scan(np.ones((5, 3)), stamp)


def test_constant_velocity_says_that_it_measures_nothing() -> None:
    odometry = ConstantVelocity()
    for stamp in (0.0, 0.1):
        motion = odometry.estimate(scan_at(stamp))
        np.testing.assert_array_equal(motion.T_prev_curr, np.eye(4))
        assert motion.points_used == 0
        assert motion.failure is not None


def external(first: float = 0.0, last: float = 2.0) -> ExternalOdometry:
    stamps = np.arange(first, last + 1e-9, 0.05)
    start = exp([0.3, 0.2, 0.1, 7.0, 8.0, 9.0])
    return ExternalOdometry(Trajectory(stamps, start @ exp(np.multiply.outer(stamps, VELOCITY))))


def test_external_motion_is_read_between_the_given_poses() -> None:
    odometry = external()
    np.testing.assert_array_equal(odometry.estimate(scan_at(0.512)).T_prev_curr, np.eye(4))
    np.testing.assert_allclose(odometry.estimate(scan_at(0.637)).T_prev_curr, exp(0.125 * VELOCITY), atol=1e-9)


def test_scans_outside_the_external_trajectory_are_said_to_be_uncovered() -> None:
    odometry = external(last=1.0)
    odometry.estimate(scan_at(0.9))
    failed = odometry.estimate(scan_at(1.2))
    assert failed.failure is not None
    assert "does not cover" in failed.failure


def with_a_hole(step_s: float, hole_s: float, largest_interval_s: float | None = None) -> ExternalOdometry:
    """Ten poses up to second 0, ten from the end of the hole on."""
    before = step_s * np.arange(-9, 1)
    stamps = np.concatenate([before, hole_s - before[::-1]])
    trajectory = Trajectory(stamps, exp(np.multiply.outer(stamps, VELOCITY)))
    return ExternalOdometry(trajectory, largest_interval_s=largest_interval_s)


@pytest.mark.parametrize("stamp", [0.0015, 0.7, 1.3985])
def test_a_scan_in_a_hole_of_the_external_trajectory_is_not_covered(stamp: float) -> None:
    odometry = with_a_hole(step_s=0.1, hole_s=1.4)
    odometry.estimate(scan_at(-0.1))
    failed = odometry.estimate(scan_at(stamp))
    assert failed.points_used == 0
    assert failed.failure is not None
    assert "does not cover this scan: it has no pose from 0.000000 to 1.400000" in failed.failure
    caught_up = odometry.estimate(scan_at(1.45))
    assert caught_up.failure is None
    np.testing.assert_allclose(caught_up.T_prev_curr, exp(1.55 * VELOCITY), atol=1e-9)


@pytest.mark.parametrize("poses", [0, 1])
def test_a_prior_of_fewer_than_two_poses_is_refused(poses: int) -> None:
    with pytest.raises(InputError, match=f"needs two poses or more, this one has {poses}"):
        ExternalOdometry(Trajectory(np.arange(float(poses)), np.tile(np.eye(4), (poses, 1, 1))))


def test_external_needs_a_prior_and_only_external_takes_one() -> None:
    prior = Trajectory(np.array([0.0, 1.0]), np.stack([np.eye(4)] * 2))
    with pytest.raises(ConfigError, match="give both or neither"):
        make_odometry(OdometryConfig(method="external"))
    with pytest.raises(ConfigError, match="give both or neither"):
        make_odometry(OdometryConfig(), prior)
    assert isinstance(make_odometry(OdometryConfig(method="external"), prior), ExternalOdometry)
