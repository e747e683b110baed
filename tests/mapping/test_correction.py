"""A trajectory corrected at its keyframes, and the graph behind it as g2o text."""

import gtsam
import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.core.trajectory import chain
from lidarslam.mapping.loops.closure import RelativePose
from lidarslam.mapping.pose_graph.correction import corrected, format_g2o

FAR = exp([0.2, -0.3, 2.0, 5e5, -3e5, 100.0])


@pytest.fixture
def trajectory(rng: np.random.Generator) -> FloatArray:
    """Forty scans along a winding way."""
    steps = rng.normal(size=(39, 6)) * [0.02, 0.02, 0.2, 0.1, 0.1, 0.05] + [0.0, 0.0, 0.0, 0.5, 0.0, 0.0]
    return chain(exp([0.1, 0.2, 0.3, 4.0, 5.0, 6.0]), exp(steps))


def along_x(positions: list[float]) -> FloatArray:
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, 0, 3] = positions
    return T


def test_where_the_world_lies_does_not_matter(trajectory, rng):
    keyframes = np.array([5, 12, 33])
    poses = trajectory[keyframes] @ exp(rng.normal(size=(3, 6)) * 0.3)
    here = corrected(trajectory, keyframes, poses)
    there = corrected(FAR @ trajectory, keyframes, FAR @ poses)
    np.testing.assert_allclose(there, FAR @ here, atol=1e-8)


def test_a_rigid_move_of_all_keyframes_moves_everything(trajectory):
    keyframes = np.array([5, 12, 33])
    move = exp([0.4, -0.2, 1.5, 10.0, 20.0, -3.0])
    np.testing.assert_allclose(
        corrected(trajectory, keyframes, move @ trajectory[keyframes]), move @ trajectory, atol=1e-9
    )


def test_before_the_first_and_after_the_last_the_motion_to_them_is_kept(trajectory, rng):
    keyframes = np.array([5, 33])
    poses = trajectory[keyframes] @ exp(rng.normal(size=(2, 6)))
    moved = corrected(trajectory, keyframes, poses)
    for scans, key in ((slice(0, 5), 0), (slice(34, 40), 1)):
        kept = inverse(trajectory[keyframes[key]]) @ trajectory[scans]
        np.testing.assert_allclose(inverse(poses[key]) @ moved[scans], kept, atol=1e-12)


def test_what_is_missing_is_spread_by_the_path_or_standing_still_by_the_scans():
    """Still before the second keyframe, driving after it; a quarter of that way lies before the fourth scan."""
    moved = corrected(along_x([0.0, 0.0, 0.0, 1.0, 4.0]), np.array([0, 2, 4]), along_x([0.0, 1.0, 7.0]))
    np.testing.assert_allclose(moved, along_x([0.0, 0.5, 1.0, 2.5, 7.0]), atol=1e-12)


def test_a_turn_that_was_missed_is_made_up_for_evenly():
    """Half-way, a scan is as far from where the first keyframe has it as from where the second has it."""
    before = along_x([0.0, 2.0, 4.0, 8.0])
    poses = before[[0, 3]] @ exp([[0.0] * 6, [0.1, 0.0, 0.4, 0.0, 0.5, 0.0]])
    moved = corrected(before, np.array([0, 3]), poses)
    from_first = log(inverse(before) @ moved)
    to_second = log(inverse(moved) @ poses[1] @ inverse(before[3]) @ before)
    np.testing.assert_allclose(from_first[2], to_second[2], atol=1e-12)
    np.testing.assert_allclose(from_first[1], to_second[1] / 3.0, atol=1e-12)
    assert np.linalg.norm(from_first[2, :3]) == pytest.approx(0.5 * np.linalg.norm(log(poses[1])[:3]))


def test_gtsam_reads_the_g2o_text_that_is_written(rng, tmp_path):
    """Poses turned every way, kilometres from the origin, to the last digits."""
    poses = exp(rng.normal(size=(5, 6)) * [1.0, 1.0, 1.0, 2000.0, 2000.0, 100.0])
    motions = exp(rng.normal(size=(6, 6)) * [1.0, 1.0, 1.0, 5.0, 5.0, 5.0])
    ends = [(0, 1), (1, 2), (2, 3), (4, 3), (4, 0), (2, 0)]
    A = rng.normal(size=(6, 6, 6)) * np.array([0.01, 0.02, 0.03, 0.3, 0.2, 0.1])[:, None]
    covariances = A @ A.swapaxes(1, 2) + np.diag([1e-5] * 3 + [1e-3] * 3)
    edges = [RelativePose(*pair, T, P) for pair, T, P in zip(ends, motions, covariances, strict=True)]
    path = tmp_path / "graph.g2o"
    path.write_text(format_g2o(poses, edges), encoding="utf-8")
    factors, values = gtsam.readG2o(str(path), True)
    assert (factors.size(), values.size()) == (6, 5)
    for key, pose in enumerate(poses):
        np.testing.assert_allclose(values.atPose3(key).matrix(), pose, atol=1e-9)
    for row, edge in enumerate(edges):
        factor = factors.at(row)
        assert list(factor.keys()) == [edge.first, edge.second]
        np.testing.assert_allclose(factor.measured().matrix(), edge.T_first_second, atol=1e-9)
        np.testing.assert_allclose(factor.noiseModel().covariance(), edge.covariance, rtol=1e-7, atol=1e-12)
