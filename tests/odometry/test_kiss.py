"""KISS-ICP behind the protocol: the library's own poses, at the scans' stamps, and no way for it to take us along."""

import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from kiss_icp.config import load_config
from kiss_icp.kiss_icp import KissICP

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, chain
from lidarslam.odometry.config import KissConfig
from lidarslam.odometry.methods.kiss import KissOdometry

# Small enough for the room to have structure at KISS-ICP's resolution.
INDOOR = KissConfig(voxel_size_m=0.2, max_range_m=30.0)


@pytest.fixture
def kiss() -> Iterator[KissOdometry]:
    odometry = KissOdometry(INDOOR)
    yield odometry
    odometry.close()


def without_times(scan: Scan) -> Scan:
    return Scan(scan.points, scan.stamp)


def drive_poses(odometry: KissOdometry, scans: list[Scan]) -> FloatArray:
    return chain(np.eye(4), np.stack([odometry.estimate(scan).T_prev_curr for scan in scans])[1:])


def test_poses_are_the_librarys_own(kiss: KissOdometry, room_scans: list[Scan]) -> None:
    config = load_config(None)
    config.data.max_range, config.mapping.voxel_size = 30.0, 0.2
    library = KissICP(config)
    expected = []
    for scan in room_scans:
        library.register_frame(scan.points, np.empty(0))
        expected.append(library.last_pose)
    poses = drive_poses(kiss, [without_times(scan) for scan in room_scans])
    np.testing.assert_allclose(poses, np.stack(expected), atol=1e-9)


@pytest.mark.parametrize("stamp_at", [0.0, 0.5, 1.0])
def test_poses_belong_to_the_stamp_wherever_it_lies_in_the_sweep(
    kiss: KissOdometry, room: Any, drive: Callable[[FloatArray], FloatArray], stamp_at: float
) -> None:
    stamps = 0.1 * np.arange(1, 21)
    scans = [room.sweep(drive, float(stamp), stamp_at) for stamp in stamps]
    poses = drive_poses(kiss, scans)
    truth = drive(stamps)
    error = inverse(inverse(truth[0]) @ truth) @ poses
    # Half a sweep is 4 cm and 0.9 degrees here: expressing the pose at another instant would be seen.
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.035
    assert np.rad2deg(rotation_angle(error)).max() < 0.4


def test_equal_times_are_kept_from_the_library(kiss: KissOdometry, room_scans: list[Scan]) -> None:
    for scan in room_scans[:3]:
        motion = kiss.estimate(Scan(scan.points, scan.stamp, np.full(len(scan), 0.05)))
        assert motion.failure is None


def test_too_few_points_give_a_prediction_and_the_next_scan_catches_up(
    kiss: KissOdometry, room_scans: list[Scan], room_truth: Trajectory
) -> None:
    motions = []
    for index, scan in enumerate(room_scans):
        one_point = Scan(scan.points[:1], scan.stamp, np.zeros(1))
        motions.append(kiss.estimate(one_point if index == 10 else scan))
    assert motions[10].failure is not None
    assert "too few" in motions[10].failure
    assert motions[10].points_used == 0
    assert np.linalg.norm(motions[10].T_prev_curr[:3, 3]) > 0.05, "a prediction goes on moving"
    assert all(motion.failure is None for index, motion in enumerate(motions) if index != 10)
    poses = chain(np.eye(4), np.stack([motion.T_prev_curr for motion in motions])[1:])
    truth = inverse(room_truth.T_world_lidar[0]) @ room_truth.T_world_lidar
    assert np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3]) < 0.03


def test_an_abort_of_the_library_does_not_take_us_along(
    kiss: KissOdometry, room_scans: list[Scan], monkeypatch: pytest.MonkeyPatch
) -> None:
    for scan in room_scans[:5]:
        kiss.estimate(scan)
    # Let through what is otherwise kept from it: equal times divide zero by zero in the library.
    monkeypatch.setattr(KissOdometry, "_usable_offsets", lambda _, scan: np.zeros(len(scan)))
    motion = kiss.estimate(room_scans[5])
    assert motion.failure is not None
    assert f"status {-signal.SIGABRT}" in motion.failure
    assert np.linalg.norm(motion.T_prev_curr[:3, 3]) > 0.05, "a prediction goes on moving"


def test_after_a_crash_it_starts_again_and_says_so(kiss: KissOdometry, room_scans: list[Scan]) -> None:
    for scan in room_scans[:5]:
        kiss.estimate(scan)
    assert kiss._worker is not None
    os.kill(kiss._worker._process.pid, signal.SIGKILL)
    crashed, restarted, *after = [kiss.estimate(scan) for scan in room_scans[5:]]
    assert crashed.failure is not None
    assert "starts again" in crashed.failure
    assert restarted.failure is not None
    assert "prediction" in restarted.failure
    for motion in (crashed, restarted, *after):
        assert 0.05 < np.linalg.norm(motion.T_prev_curr[:3, 3]) < 0.11, "0.8 m/s at 10 Hz"
    assert all(motion.failure is None for motion in after)
