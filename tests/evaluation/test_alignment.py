"""The alignment finds a known rigid motion, also where positions alone cannot tell it."""

import numpy as np
import pytest

from lidarslam.core.geometry import exp, inverse, is_rigid, rotation_angle
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.alignment import align, align_se3
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory

MOTIONS = [(0.0,) * 6, (0.3, -0.2, 2.5, 10.0, -4.0, 1.0), (3.1, 0.1, 0.2, -500.0, 20.0, 3.0)]


def rotation_error_deg(estimate: Trajectory, reference: Trajectory) -> float:
    return evaluate_trajectory(estimate, reference).errors.ate_rotation_rmse_deg


@pytest.mark.parametrize("xi", MOTIONS)
@pytest.mark.parametrize("shape", ["drive", "plane", "line", "line and turning", "still", "still and turning"])
def test_a_known_motion_is_found_for_every_shape_of_path(xi, shape, random_drive, straight_drive):
    steps = {
        "plane": (0.0, 0.0, 0.02, 1.0, 0.0, 0.0),
        "line": (0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
        "line and turning": (0.05, 0.0, 0.0, 1.0, 0.0, 0.0),
        "still": (0.0,) * 6,
        "still and turning": (0.0, 0.0, 0.05, 0.0, 0.0, 0.0),
    }
    estimate = straight_drive(120, steps[shape]) if shape in steps else random_drive(4, scans=120)
    reference = estimate.transformed(exp(xi))
    found = align(estimate, reference)
    assert is_rigid(found, 1e-9)
    np.testing.assert_allclose(found, exp(xi), atol=1e-6)
    assert rotation_error_deg(estimate, reference) < 1e-4


@pytest.mark.parametrize(("step_m", "sigma_m"), [(0.1, 0.01), (2.0, 0.2)], ids=["corridor", "motorway"])
def test_a_straight_noisy_path_does_not_roll(step_m, sigma_m, straight_drive, rng):
    drive = straight_drive(400, (0.0, 0.0, 0.0, step_m, 0.0, 0.0))
    poses = np.stack([drive.T_world_lidar] * 2)
    poses[..., :3, 3] += rng.normal(0.0, sigma_m, (2, 400, 3))
    found = align(*(Trajectory(drive.stamps, noisy_poses) for noisy_poses in poses))
    assert np.rad2deg(rotation_angle(found)) < 0.1


def test_a_nearly_straight_path_takes_the_rotation_about_it_from_the_orientations(straight_drive):
    """Thirty metres that bend by 3 % of them, the reference's heights off by half a metre as GNSS puts them."""
    drive = straight_drive(31, (0.0, 0.0, 0.008, 1.0, 0.0, 0.0))
    poses = drive.T_world_lidar.copy()
    poses[:, 2, 3] += 0.5 * np.linspace(-1.0, 1.0, 31) ** 2
    T_reference_estimate = exp(MOTIONS[1])
    found = align(drive, Trajectory(drive.stamps, poses).transformed(T_reference_estimate))
    assert np.rad2deg(rotation_angle(inverse(T_reference_estimate) @ found)) < 1.0


def test_a_path_that_spreads_sideways_is_fitted_by_its_positions_alone(straight_drive):
    drive = straight_drive(120, (0.0, 0.0, 0.01, 1.0, 0.0, 0.0))
    poses = drive.T_world_lidar @ exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(align(drive, Trajectory(drive.stamps, poses)), np.eye(4), atol=1e-6)


def test_a_mirrored_estimate_is_not_answered_with_a_reflection(random_drive):
    reference = random_drive(2)
    poses = reference.T_world_lidar.copy()
    poses[:, 1, 3] *= -1.0
    assert is_rigid(align_se3(poses, reference.T_world_lidar), 1e-9)


def test_first_pose_and_none(random_drive):
    estimate, reference = random_drive(7), random_drive(8).transformed(exp(MOTIONS[1]))
    T_reference_estimate = align(estimate, reference, "first_pose")
    moved = T_reference_estimate @ estimate.T_world_lidar[0]
    np.testing.assert_allclose(moved, reference.T_world_lidar[0], atol=1e-12)
    assert np.array_equal(align(estimate, reference, "none"), np.eye(4))


@pytest.mark.parametrize("bend", [0.0, 0.0005, 0.001], ids=["straight", "1 %", "2 %"])
def test_the_rotation_error_is_that_of_the_orientations_where_positions_leave_it_open(bend, straight_drive, rng):
    """Orientations off by 0.2 degrees about each axis, on a path whose reference is off by half a metre as GNSS is."""
    drive = straight_drive(400, (0.0, 0.0, bend, 0.2, 0.0, 0.0))
    turns = np.zeros((400, 6))
    turns[:, :3] = np.deg2rad(rng.normal(0.0, 0.2, (400, 3)))
    turns[:, :3] -= turns[:, :3].mean(axis=0)
    poses = drive.T_world_lidar.copy()
    poses[:, 2, 3] += 0.5 * np.sin(np.linspace(0.0, 3.0, 400))
    poses[:, 1, 3] += 0.5 * np.cos(np.linspace(0.0, 5.0, 400))
    estimate = Trajectory(drive.stamps, exp(MOTIONS[1]) @ drive.T_world_lidar @ exp(turns))
    known_deg = np.rad2deg(np.sqrt(np.mean(np.sum(turns[:, :3] ** 2, axis=1))))
    assert rotation_error_deg(estimate, Trajectory(drive.stamps, poses)) == pytest.approx(known_deg, rel=0.06)


@pytest.mark.parametrize("axis", range(3))
def test_a_sensor_that_is_mounted_askew_is_seen_where_positions_are_certain(axis, random_drive):
    """The orientations alone would align a constant error of the heading away."""
    reference = random_drive(11)
    skew = np.zeros(6)
    skew[axis] = np.deg2rad(3.0)
    estimate = Trajectory(reference.stamps, exp(MOTIONS[1]) @ reference.T_world_lidar @ exp(skew))
    assert rotation_error_deg(estimate, reference) == pytest.approx(3.0, abs=1e-3)


@pytest.mark.parametrize("method", ["first_pose", "none"])
def test_an_alignment_that_is_asked_for_holds_for_the_rotations_too(method, random_drive, noisy):
    reference = random_drive(15)
    metrics = evaluate_trajectory(noisy(reference, 16), reference, alignment=method)
    assert np.array_equal(metrics.T_reference_estimate, metrics.T_reference_estimate_joint)
