"""Odometry that does not look at the points."""

import numpy as np
import pytest

from lidarslam.core.errors import ConfigError
from lidarslam.core.geometry import exp
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from odometry.config import OdometryConfig
from odometry.constant_velocity import ConstantVelocity
from odometry.external import ExternalOdometry
from odometry.registry import make_odometry

VELOCITY = np.array([0.1, -0.2, 1.5, 2.0, 0.3, -0.1])


def scan_at(stamp: float) -> Scan:
    return Scan(np.ones((5, 3)), stamp)


def test_constant_velocity_stands_still_until_it_is_corrected() -> None:
    odometry = ConstantVelocity()
    for stamp in (0.0, 0.1):
        motion = odometry.estimate(scan_at(stamp))
        np.testing.assert_array_equal(motion.T_prev_curr, np.eye(4))
        assert motion.points_used == 0


def test_constant_velocity_scales_with_the_real_interval() -> None:
    odometry = ConstantVelocity()
    odometry.estimate(scan_at(0.0))
    odometry.estimate(scan_at(0.1))
    odometry.correct(exp(0.1 * VELOCITY))
    np.testing.assert_allclose(odometry.estimate(scan_at(0.4)).T_prev_curr, exp(0.3 * VELOCITY), atol=1e-12)


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


def test_a_gap_in_the_cover_is_made_up_by_the_next_covered_scan() -> None:
    odometry = external(first=0.5)
    assert odometry.estimate(scan_at(0.1)).failure is not None
    assert odometry.estimate(scan_at(0.6)).failure is None
    np.testing.assert_allclose(odometry.estimate(scan_at(0.7)).T_prev_curr, exp(0.1 * VELOCITY), atol=1e-9)


def test_external_needs_a_prior_and_only_external_takes_one() -> None:
    prior = Trajectory(np.array([0.0, 1.0]), np.stack([np.eye(4)] * 2))
    with pytest.raises(ConfigError, match="give both or neither"):
        make_odometry(OdometryConfig(method="external"))
    with pytest.raises(ConfigError, match="give both or neither"):
        make_odometry(OdometryConfig(), prior)
    assert isinstance(make_odometry(OdometryConfig(method="external"), prior), ExternalOdometry)
