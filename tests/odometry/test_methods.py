"""Odometry by its name, odometry that does not look at the points, and what it says after it was saved and restored."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import exp
from lidarslam.core.scan import Scan
from lidarslam.core.state import State
from lidarslam.core.trajectory import Trajectory
from lidarslam.odometry.config import OdometryConfig
from lidarslam.odometry.interface import Odometry
from lidarslam.odometry.methods.consistency import ConsistencyCheck
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.odometry.methods.learned import LearnedOdometry
from lidarslam.odometry.registry import make_odometry

ThroughDisk = Callable[[State], State]
EMPTY, GARBAGE = 3, 5


@pytest.fixture(scope="module")
def scans(room_scans: list[Scan]) -> list[Scan]:
    """Nine sweeps, the first hardly any points, one empty and one that fits nothing."""
    chosen = [scan.select(np.arange(0, len(scan), 3)) for scan in room_scans[:9]]
    chosen[0] = chosen[0].select(np.arange(50))
    chosen[EMPTY] = chosen[EMPTY].select(np.arange(0))
    noise = np.random.default_rng(0).uniform(-6.0, 6.0, (2000, 3))
    chosen[GARBAGE] = Scan(noise, chosen[GARBAGE].stamp, np.linspace(0.0, 0.1, 2000))
    return chosen


def assert_goes_on(make: Callable[[], Odometry], scans: list[Scan], through_disk: ThroughDisk, begins: Sequence[int]):
    """An odometry that was restored after so many scans says what the first one says; to the last bit."""
    whole = make()
    expected = [whole.estimate(scan) for scan in scans]
    for after in begins:
        first, second = make(), make()
        for scan in scans[:after]:
            first.estimate(scan)
        second.restore(through_disk(first.state()))
        for scan, one in zip(scans[after:], expected[after:], strict=True):
            other = second.estimate(scan)
            assert (one.points_used, one.failure) == (other.points_used, other.failure)
            np.testing.assert_array_equal(one.T_prev_curr, other.T_prev_curr)
            np.testing.assert_array_equal(one.covariance, other.covariance)
    return expected


def test_the_learned_odometry_is_the_default_and_goes_on(scans, through_disk):
    assert isinstance(make_odometry(OdometryConfig()), LearnedOdometry)
    begins = (1, EMPTY + 1, GARBAGE + 1)
    expected = assert_goes_on(lambda: make_odometry(OdometryConfig()), scans, through_disk, begins)
    assert sum(motion.failure is not None for motion in expected) >= 2


def test_a_given_trajectory_goes_on(scans, room_truth, through_disk):
    short = Trajectory(room_truth.stamps[2:], room_truth.T_world_lidar[2:])
    assert_goes_on(lambda: ExternalOdometry(short, tolerance_s=0.0), scans, through_disk, range(9))


def test_constant_velocity_and_kiss_have_their_say():
    constant = make_odometry(OdometryConfig(method="constant-velocity"))
    assert constant.state() == {}
    constant.restore({})
    motion = constant.estimate(scan_at(0.0))
    np.testing.assert_array_equal(motion.T_prev_curr, np.eye(4))
    assert (motion.points_used, motion.failure is None) == (0, False)
    kiss = make_odometry(OdometryConfig(method="kiss-icp"))
    try:
        assert kiss.state() is None
        with pytest.raises(InputError, match="KISS-ICP has no state"):
            kiss.restore({})
    finally:
        kiss.close()


def test_the_check_goes_on(scans, room_truth, through_disk):
    motions = np.concatenate([np.eye(4)[None], room_truth.relative_motions()])
    check = ConsistencyCheck()
    expected = [check.check(scan.points, T) for scan, T in zip(scans, motions, strict=False)]
    assert len({consistency.status for consistency in expected}) > 1
    for after in range(9):
        first, second = ConsistencyCheck(), ConsistencyCheck()
        for scan, T in zip(scans[:after], motions, strict=False):
            first.check(scan.points, T)
        second.restore(through_disk(first.state()))
        found = [second.check(scan.points, T) for scan, T in zip(scans[after:], motions[after:], strict=False)]
        assert found == expected[after:]


VELOCITY = np.array([0.1, -0.2, 1.5, 2.0, 0.3, -0.1])


def scan_at(stamp: float) -> Scan:
    return Scan(np.ones((5, 3)), stamp)


def test_external_motion_is_read_between_the_given_poses():
    stamps, start = np.arange(0.0, 2.01, 0.05), exp([0.3, 0.2, 0.1, 7.0, 8.0, 9.0])
    odometry = ExternalOdometry(Trajectory(stamps, start @ exp(np.multiply.outer(stamps, VELOCITY))))
    np.testing.assert_array_equal(odometry.estimate(scan_at(0.512)).T_prev_curr, np.eye(4))
    np.testing.assert_allclose(odometry.estimate(scan_at(0.637)).T_prev_curr, exp(0.125 * VELOCITY), atol=1e-9)


@pytest.mark.parametrize("stamp", [0.0015, 0.7, 1.3985])
def test_a_scan_in_a_hole_of_the_external_trajectory_or_outside_of_it_is_not_covered(stamp):
    stamps = np.concatenate([np.linspace(-0.9, 0.0, 10), np.linspace(1.4, 2.3, 10)])
    odometry = ExternalOdometry(Trajectory(stamps, exp(np.multiply.outer(stamps, VELOCITY))))
    odometry.estimate(scan_at(-0.1))
    failed = odometry.estimate(scan_at(stamp))
    assert failed.points_used == 0
    assert "no pose from 0.000000 to 1.400000" in failed.failure
    caught_up = odometry.estimate(scan_at(1.45))
    assert caught_up.failure is None
    np.testing.assert_allclose(caught_up.T_prev_curr, exp(1.55 * VELOCITY), atol=1e-9)
    assert "does not cover" in odometry.estimate(scan_at(2.5)).failure


@pytest.mark.parametrize("poses", [0, 1])
def test_a_prior_of_fewer_than_two_poses_is_refused(poses):
    with pytest.raises(InputError, match=f"needs two poses or more, this one has {poses}"):
        ExternalOdometry(Trajectory(np.arange(float(poses)), np.tile(np.eye(4), (poses, 1, 1))))


def test_external_needs_a_prior_and_only_external_takes_one():
    prior = Trajectory(np.array([0.0, 1.0]), np.stack([np.eye(4)] * 2))
    with pytest.raises(ConfigError, match="give both or neither"):
        make_odometry(OdometryConfig(method="external"))
    with pytest.raises(ConfigError, match="give both or neither"):
        make_odometry(OdometryConfig(), prior)
    assert isinstance(make_odometry(OdometryConfig(method="external"), prior), ExternalOdometry)
