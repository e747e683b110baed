"""Whether two scans fit each other: true motions do, wrong ones do not."""

import numpy as np
import pytest
from numpy.typing import ArrayLike

from lidarslam.core.geometry import exp, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.motion.deskew import body_velocity, deskew
from lidarslam.odometry.methods.consistency import Consistency, ConsistencyCheck, plane_distances


@pytest.fixture
def check() -> ConsistencyCheck:
    return ConsistencyCheck()


def fit(check: ConsistencyCheck, scans: list[Scan], truth: Trajectory, error: ArrayLike) -> Consistency:
    """The fit of two true sweeps under the true motion followed by an error."""
    T_prev_curr = inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[1]
    velocity = body_velocity(T_prev_curr, 0.1)
    points = [deskew(s.points, s.time_offsets, velocity, velocity) for s in scans[:2] if s.time_offsets is not None]
    assert check.check(points[0], np.eye(4)).status is Status.OK
    return check.check(points[1], T_prev_curr @ exp(error))


def test_the_true_motion_fits(check, room_scans, room_truth):
    result = fit(check, room_scans, room_truth, [0.0] * 6)
    assert result.status is Status.OK
    assert result.inlier_ratio > 0.9
    assert result.residual_m < 0.01


@pytest.mark.parametrize("axis", [1, 2, 3, 4, 5], ids=["pitch", "yaw", "forwards", "sideways", "up"])
def test_a_motion_wrong_by_15_degrees_or_60_centimetres_is_found(check, room_scans, room_truth, axis):
    error = np.eye(6)[axis] * (np.deg2rad(15.0) if axis < 3 else 0.6)
    assert fit(check, room_scans, room_truth, error).status is Status.LOST


def test_after_an_empty_scan_the_one_before_it_is_held_against(check, room_scans, room_truth):
    motions = [np.eye(4), *room_truth.relative_motions()[:2]]
    points = [room_scans[0].points, np.empty((0, 3)), room_scans[2].points]
    results = [check.check(p, T) for p, T in zip(points, motions, strict=True)]
    assert [result.status for result in results] == [Status.OK, Status.LOST, Status.OK]
    assert results[1] == Consistency(None, None, Status.LOST)
    assert check.check(room_scans[3].points, exp([0.0, 0.0, 0.4, 0.0, 0.0, 0.0])).status is Status.LOST


def test_distances_to_planes_are_exact():
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 21), np.linspace(-1.0, 1.0, 21))
    plane = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    queries = np.array([[0.13, 0.21, 0.3], [0.5, -0.4, -0.05]])
    distances, facing = plane_distances(queries, plane)
    np.testing.assert_allclose(distances, [0.3, 0.05], atol=1e-12)
    np.testing.assert_array_equal(facing, [2, 2])


def test_a_cloud_without_planes_gives_no_distance(rng):
    distances, _ = plane_distances(rng.uniform(-1.0, 1.0, (50, 3)), rng.uniform(-1.0, 1.0, (500, 3)))
    assert np.isnan(distances).mean() > 0.5
