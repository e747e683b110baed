"""An odometry that is saved and restored says what it would have said, to the last bit."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from lidarslam.core.trajectory import Trajectory
from lidarslam.odometry.config import OdometryConfig
from lidarslam.odometry.interface import Motion, Odometry
from lidarslam.odometry.methods.consistency import ConsistencyCheck
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.odometry.registry import make_odometry

ThroughDisk = Callable[[State], Saved]
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


def assert_same(found: Sequence[Motion], expected: Sequence[Motion]) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.T_prev_curr, other.T_prev_curr)
        assert (one.points_used, one.failure) == (other.points_used, other.failure)
        assert (one.covariance is None) == (other.covariance is None)
        if one.covariance is not None:
            np.testing.assert_array_equal(one.covariance, other.covariance)


def go_on(make: Callable[[], Odometry], scans: list[Scan], after: int, through_disk: ThroughDisk) -> list[Motion]:
    """The motions of the scans after so many, by an odometry that was restored there."""
    first, second = make(), make()
    for scan in scans[:after]:
        first.estimate(scan)
    state = first.state()
    assert state is not None
    second.restore(through_disk(state))
    return [second.estimate(scan) for scan in scans[after:]]


def test_the_learned_odometry_goes_on(scans: list[Scan], through_disk: ThroughDisk) -> None:
    def make() -> Odometry:
        return make_odometry(OdometryConfig())

    odometry = make()
    expected = [odometry.estimate(scan) for scan in scans]
    assert [motion.failure is None for motion in expected].count(False) >= 2
    for after in (0, 1, 2, EMPTY + 1, GARBAGE + 1, 8):
        assert_same(go_on(make, scans, after, through_disk), expected[after:])


def test_a_given_trajectory_goes_on(scans: list[Scan], room_truth: Trajectory, through_disk: ThroughDisk) -> None:
    short = Trajectory(room_truth.stamps[2:], room_truth.T_world_lidar[2:])

    def make() -> Odometry:
        return ExternalOdometry(short, tolerance_s=0.0)

    odometry = make()
    expected = [odometry.estimate(scan) for scan in scans]
    for after in range(9):
        assert_same(go_on(make, scans, after, through_disk), expected[after:])


def test_constant_velocity_and_kiss_have_their_say() -> None:
    constant = make_odometry(OdometryConfig(method="constant-velocity"))
    assert constant.state() == {}
    constant.restore(Saved({}))
    kiss = make_odometry(OdometryConfig(method="kiss-icp"))
    try:
        assert kiss.state() is None
        with pytest.raises(InputError, match="KISS-ICP has no state"):
            kiss.restore(Saved({}))
    finally:
        kiss.close()


def test_the_check_goes_on(scans: list[Scan], room_truth: Trajectory, through_disk: ThroughDisk) -> None:
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
