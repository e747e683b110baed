"""Trajectories: what they are made of, what is measured along them, interpolation."""

import numpy as np
import pytest

from lidarslam.core.geometry import exp, inverse
from lidarslam.core.trajectory import Trajectory, chain

TWIST = np.array([0.1, -0.2, 0.3, 2.0, 0.5, -0.1])


def moving(stamps) -> Trajectory:
    """Constant body velocity, for which interpolation is exact."""
    stamps = np.asarray(stamps, dtype=np.float64)
    return Trajectory(stamps, exp(stamps[:, None] * TWIST))


@pytest.mark.parametrize(
    ("stamps", "poses", "words"),
    [
        ([[0.0], [1.0]], np.stack([np.eye(4)] * 2), r"\(N,\), got \(2, 1\)"),
        ([0.0, 1.0], np.eye(4)[None], r"\(2, 4, 4\), got \(1, 4, 4\)"),
        ([0.0, np.nan], np.stack([np.eye(4)] * 2), "finite"),
        ([0.0, 2.0, 1.0], np.stack([np.eye(4)] * 3), r"2\.0+ then 1\.0+ at rows 1 and 2"),
        ([0.0, 0.0], np.stack([np.eye(4)] * 2), "must increase.*rows 0 and 1"),
        ([0.0, 1.0], np.stack([np.eye(4), 2 * np.eye(4)]), "rigid"),
        ([0.0, 1.0], np.stack([np.eye(4), np.nan * np.eye(4)]), "rigid"),
    ],
)
def test_construction_is_checked(stamps, poses, words):
    with pytest.raises(ValueError, match=words):
        Trajectory(np.array(stamps), poses)


def test_lengths_of_a_known_path():
    positions = np.array([[0.0, 0, 0], [3, 4, 0], [3, 4, 12], [3, 4, 12]])
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, 3] = positions
    trajectory = Trajectory(np.array([10.0, 11.0, 12.0, 15.5]), T)
    np.testing.assert_array_equal(trajectory.positions, positions)
    np.testing.assert_array_equal(trajectory.distances, [0, 5, 17, 17])
    assert (trajectory.length_m, trajectory.duration_s, len(trajectory)) == (17.0, 5.5, 4)


@pytest.mark.parametrize("poses", [0, 1])
def test_a_trajectory_may_be_empty_or_a_single_pose(poses):
    trajectory = moving(np.arange(poses))
    assert (trajectory.length_m, trajectory.duration_s) == (0.0, 0.0)
    assert trajectory.distances.shape == (poses,)
    assert trajectory.relative_motions().shape == (0, 4, 4)
    with pytest.raises(ValueError, match=f"two poses or more, the trajectory has {poses}"):
        trajectory.at(np.array([0.0]))


def test_chain_inverts_relative_motions(random_trajectory):
    trajectory = random_trajectory()
    motions = trajectory.relative_motions()
    T_prev_curr = inverse(trajectory.T_world_lidar[4]) @ trajectory.T_world_lidar[5]
    np.testing.assert_allclose(motions[4], T_prev_curr, atol=1e-9)
    np.testing.assert_allclose(chain(trajectory.T_world_lidar[0], motions), trajectory.T_world_lidar, atol=1e-9)
    np.testing.assert_array_equal(chain(np.eye(4), np.zeros((0, 4, 4))), [np.eye(4)])


def test_another_world_changes_no_motion(random_trajectory):
    trajectory = random_trajectory()
    T_new_world = exp([0.5, -1.0, 2.0, 10.0, 20.0, 30.0])
    moved = trajectory.transformed(T_new_world)
    np.testing.assert_allclose(moved.relative_motions(), trajectory.relative_motions(), atol=1e-9)
    np.testing.assert_allclose(moved.T_world_lidar[3], T_new_world @ trajectory.T_world_lidar[3])
    assert moved.length_m == pytest.approx(trajectory.length_m)


def test_select_takes_masks_indices_and_slices(random_trajectory):
    trajectory = random_trajectory(6)
    mask = np.array([True, False, True, False, True, False])
    for chosen in (mask, np.array([0, 2, 4]), slice(None, None, 2)):
        part = trajectory.select(chosen)
        np.testing.assert_array_equal(part.stamps, trajectory.stamps[::2])
        np.testing.assert_array_equal(part.T_world_lidar, trajectory.T_world_lidar[::2])
    with pytest.raises(ValueError, match="must increase"):
        trajectory.select(np.array([2, 0]))


def test_interpolation_is_exact_for_constant_body_velocity():
    trajectory = moving([0.0, 0.1, 0.35, 0.4, 1.0])
    stamps = np.array([0.72, 0.0, 0.05, 1.0, 0.1, 0.39])
    np.testing.assert_allclose(
        trajectory.at(stamps), moving(np.sort(stamps)).T_world_lidar[[4, 0, 1, 5, 2, 3]], atol=1e-12
    )
    assert trajectory.at(np.zeros(0)).shape == (0, 4, 4)


def test_interpolation_at_own_stamps_returns_the_poses(random_trajectory):
    trajectory = random_trajectory()
    np.testing.assert_allclose(trajectory.at(trajectory.stamps), trajectory.T_world_lidar, atol=1e-9)


def test_extrapolation_goes_on_with_the_first_or_last_motion_as_far_as_allowed():
    trajectory = moving([0.0, 0.5, 1.0])
    stamps = np.array([-0.2, 1.2])
    found = trajectory.at(stamps, extrapolation_s=0.2)
    np.testing.assert_allclose(found, moving(stamps).T_world_lidar, atol=1e-12)
    for outside in (-0.21, 1.21):
        with pytest.raises(ValueError, match=r"outside the trajectory \(0\.0+ to 1\.0+\)"):
            trajectory.at(np.array([0.5, outside]), extrapolation_s=0.2)
