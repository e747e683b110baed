"""The trajectory metrics beside those of evo, on random trajectories."""

import numpy as np
import pytest
from evo.core.metrics import APE, RPE, PoseRelation, Unit
from evo.core.trajectory import PoseTrajectory3D

from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.alignment import align
from lidarslam.evaluation.trajectory.association import associate
from lidarslam.evaluation.trajectory.metrics import absolute_errors, evaluate_trajectory, relative_errors

ELSEWHERE = exp([0.3, -0.2, 2.0, 100.0, -40.0, 5.0])
SEEDS = range(3)


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.T_world_lidar), timestamps=trajectory.stamps)


@pytest.fixture(params=SEEDS)
def pair(request, random_drive, noisy) -> tuple[Trajectory, Trajectory]:
    """An estimate in another world, and the reference."""
    reference = random_drive(request.param)
    return noisy(reference, request.param + 50, sigma=0.02).transformed(ELSEWHERE), reference


def test_absolute_errors_equal_those_of_evo(pair):
    estimate, reference = pair
    aligned = as_evo(estimate)
    aligned.align(as_evo(reference), correct_scale=False)
    metrics = evaluate_trajectory(estimate, reference)
    distances_m, angles_rad = absolute_errors(metrics.association, metrics.T_reference_estimate)
    ape = {}
    for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg):
        ape[relation] = APE(relation)
        ape[relation].process_data((as_evo(reference), aligned))
    assert metrics.errors.ate_rmse_m == pytest.approx(rmse(ape[PoseRelation.translation_part]), rel=1e-9)
    assert metrics.errors.ate_rotation_rmse_deg == pytest.approx(rmse(ape[PoseRelation.rotation_angle_deg]), rel=1e-6)
    np.testing.assert_allclose(distances_m, ape[PoseRelation.translation_part].error, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(angles_rad), ape[PoseRelation.rotation_angle_deg].error, atol=1e-5)


def test_relative_errors_equal_those_of_evo(pair):
    estimate, reference = pair
    metrics = evaluate_trajectory(estimate, reference)
    translation, rotation = (
        RPE(relation, delta=1, delta_unit=Unit.frames, all_pairs=False)
        for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg)
    )
    for rpe in (translation, rotation):
        rpe.process_data((as_evo(reference), as_evo(estimate)))
    # evo's translation part is that of inverse(reference motion) @ estimated motion: as long as the difference.
    distances_m, angles_rad = relative_errors(metrics.association)
    np.testing.assert_allclose(distances_m, translation.error, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(angles_rad), rotation.error, atol=1e-5)
    assert metrics.errors.rpe_translation_rmse_m == pytest.approx(rmse(translation), rel=1e-9)
    assert metrics.errors.rpe_rotation_rmse_deg == pytest.approx(rmse(rotation), rel=1e-5)


def test_the_alignment_equals_that_of_evo(pair):
    estimate, reference = pair
    R, t, scale = as_evo(estimate).align(as_evo(reference), correct_scale=False)
    association = associate(estimate, reference)
    T_reference_estimate = align(association.estimate, association.reference)
    np.testing.assert_allclose(T_reference_estimate[:3, :3], R, atol=1e-9)
    np.testing.assert_allclose(T_reference_estimate[:3, 3], t, atol=1e-7)
    assert scale == 1.0


def test_the_end_error_equals_evos_after_the_origins_coincide(pair):
    estimate, reference = pair
    moved = as_evo(estimate)
    moved.align_origin(as_evo(reference))
    end_error_m = np.linalg.norm(moved.positions_xyz[-1] - reference.positions[-1])
    assert evaluate_trajectory(estimate, reference).errors.end_error_m == pytest.approx(end_error_m, rel=1e-9)


def rmse(metric: APE | RPE) -> float:
    return metric.get_all_statistics()["rmse"]
