"""Deviations along and about each axis of the reference's LiDAR, beside closed forms."""

import numpy as np
import pytest

from lidarslam.core.geometry import exp, make_transform
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.association import associate
from lidarslam.evaluation.trajectory.metrics import absolute_errors, deviations, evaluate_trajectory


def test_a_shift_in_the_lidars_frame_is_found_along_its_axes(random_drive):
    reference = random_drive(1)
    shift = make_transform(np.eye(3), [0.3, -0.2, 0.1])
    estimate = Trajectory(reference.stamps, reference.T_world_lidar @ shift)
    translation_m, rotation_deg = deviations(associate(estimate, reference), np.eye(4))
    np.testing.assert_allclose(translation_m, np.tile([0.3, -0.2, 0.1], (len(reference), 1)), atol=1e-9)
    np.testing.assert_allclose(rotation_deg, 0.0, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle_deg", [-120.0, 5.0])
def test_a_turn_about_one_axis_is_roll_pitch_or_yaw(axis, angle_deg, random_drive):
    angle_deg = np.clip(angle_deg, -80.0, 80.0) if axis == 1 else angle_deg
    xi = np.zeros(6)
    xi[axis] = np.deg2rad(angle_deg)
    reference = random_drive(2, scans=50)
    estimate = Trajectory(reference.stamps, reference.T_world_lidar @ exp(xi))
    _, rotation_deg = deviations(associate(estimate, reference), np.eye(4))
    expected = np.zeros((50, 3))
    expected[:, axis] = angle_deg
    np.testing.assert_allclose(rotation_deg, expected, atol=1e-6)


def test_yaw_is_turned_first_then_pitch_then_roll(random_drive):
    reference = random_drive(3, scans=50)
    yaw, pitch, roll = (exp(np.deg2rad(angle) * np.eye(6)[axis]) for angle, axis in ((40.0, 2), (20.0, 1), (-10.0, 0)))
    estimate = Trajectory(reference.stamps, reference.T_world_lidar @ yaw @ pitch @ roll)
    _, rotation_deg = deviations(associate(estimate, reference), np.eye(4))
    np.testing.assert_allclose(rotation_deg, np.tile([-10.0, 20.0, 40.0], (50, 1)), atol=1e-6)


def test_the_parts_make_up_the_absolute_error(random_drive, noisy):
    reference = random_drive(4)
    estimate = noisy(reference, 5).transformed(exp([0.1, 0.2, 2.0, 5.0, 6.0, 7.0]))
    metrics = evaluate_trajectory(estimate, reference)
    translation_m, _ = deviations(metrics.association, metrics.T_reference_estimate)
    distances_m, _ = absolute_errors(metrics.association, metrics.T_reference_estimate)
    np.testing.assert_allclose(np.linalg.norm(translation_m, axis=1), distances_m, atol=1e-9)


def test_looking_straight_up_is_answered_with_numbers(straight_drive):
    reference = straight_drive(5)
    up = exp([0.0, -np.pi / 2.0, 0.0, 0.0, 0.0, 0.0])
    estimate = Trajectory(reference.stamps, reference.T_world_lidar @ up)
    _, rotation_deg = deviations(associate(estimate, reference), np.eye(4))
    np.testing.assert_allclose(rotation_deg[:, 1], -90.0, atol=1e-4)
    assert np.isfinite(rotation_deg).all()
