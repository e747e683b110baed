"""KISS-ICP behind the protocol: the library's own poses, at the scans' stamps, and no way for it to take us along."""

import signal

import numpy as np
import pytest
from kiss_icp.config import load_config
from kiss_icp.kiss_icp import KissICP

from lidarslam.core.geometry import inverse, rotation_angle
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import chain
from lidarslam.odometry.config import KissConfig
from lidarslam.odometry.methods.kiss import KissOdometry

# Small enough for the room to have structure at KISS-ICP's resolution.
INDOOR = KissConfig(voxel_size_m=0.2, max_range_m=30.0)


@pytest.fixture
def kiss():
    odometry = KissOdometry(INDOOR)
    yield odometry
    odometry.close()


def drive_poses(odometry, scans):
    return chain(np.eye(4), np.stack([odometry.estimate(scan).T_prev_curr for scan in scans])[1:])


def assert_predicted(motion, *words: str) -> None:
    assert all(word in motion.failure for word in words)
    assert motion.points_used == 0
    assert 0.05 < np.linalg.norm(motion.T_prev_curr[:3, 3]) < 0.11, "a prediction goes on moving, 0.8 m/s at 10 Hz"


@pytest.mark.parametrize("has_times", [False, True])
def test_motions_are_the_librarys_own(kiss, room, drive, has_times):
    """Of sweeps that are stamped at their last points, where the library's poses are from the third on."""
    config = load_config(None)
    config.data.max_range, config.mapping.voxel_size = 30.0, 0.2
    library, expected, scans = KissICP(config), [], []
    for number in range(1, 11):
        sweep = room.sweep(drive, 0.1 * number, stamp_at=1.0)
        times = sweep.time_offsets - sweep.time_offsets.max() if has_times else None
        scans.append(Scan(sweep.points, sweep.stamp, times))
        library.register_frame(sweep.points, times if has_times else np.empty(0))
        expected.append(library.last_pose)
    found = np.stack([kiss.estimate(scan).T_prev_curr for scan in scans])
    np.testing.assert_allclose(found[3:], inverse(np.stack(expected[2:-1])) @ np.stack(expected[3:]), atol=1e-9)


@pytest.mark.parametrize("stamp_at", [0.0, 0.5, 1.0])
def test_poses_belong_to_the_stamp_wherever_it_lies_in_the_sweep(kiss, room, drive, stamp_at):
    stamps = 0.1 * np.arange(1, 13)
    poses = drive_poses(kiss, [room.sweep(drive, float(stamp), stamp_at) for stamp in stamps])
    truth = drive(stamps)
    error = inverse(inverse(truth[0]) @ truth) @ poses
    # Half a sweep is 4 cm and 0.9 degrees here: expressing the pose at another instant would be seen.
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.035
    assert np.rad2deg(rotation_angle(error)).max() < 0.4


def test_too_few_points_and_equal_times_are_kept_from_the_library(kiss, room_scans, room_truth):
    scans = room_scans[:12]
    scans[6] = Scan(scans[6].points[:1], scans[6].stamp, np.zeros(1))
    scans[8] = Scan(scans[8].points, scans[8].stamp, np.full(len(scans[8]), 0.05))
    motions = [kiss.estimate(scan) for scan in scans]
    assert_predicted(motions[6], "too few")
    assert [index for index, motion in enumerate(motions) if motion.failure is not None] == [6]
    # The next scan catches up.
    poses = chain(np.eye(4), np.stack([motion.T_prev_curr for motion in motions])[1:])
    truth = inverse(room_truth.T_world_lidar[0]) @ room_truth.T_world_lidar
    assert np.linalg.norm(poses[-1, :3, 3] - truth[len(scans) - 1, :3, 3]) < 0.03


def test_an_abort_of_the_library_does_not_take_us_along_and_it_starts_again(kiss, room_scans, monkeypatch):
    for scan in room_scans[:5]:
        kiss.estimate(scan)
    with monkeypatch.context() as patched:
        # Let through what is otherwise kept from it: equal times divide zero by zero in the library.
        patched.setattr(KissOdometry, "_usable_offsets", lambda _, scan: np.zeros(len(scan)))
        assert_predicted(kiss.estimate(room_scans[5]), f"status {-signal.SIGABRT}", "starts again")
    restarted, *after = [kiss.estimate(scan) for scan in room_scans[6:10]]
    assert_predicted(restarted, "prediction")
    for motion in after:
        assert motion.failure is None
        assert 0.05 < np.linalg.norm(motion.T_prev_curr[:3, 3]) < 0.11
