"""The figures of a trajectory beside evo, KISS-ICP and closed forms; unrelated trajectories are told."""

import json
import math

import numpy as np
import pytest
from evo.core.metrics import APE, RPE, PoseRelation, Unit
from evo.core.trajectory import PoseTrajectory3D
from kiss_icp.metrics import sequence_error

from lidarslam.core.geometry import FloatArray, exp, make_transform
from lidarslam.core.trajectory import Trajectory, chain, read_kitti_poses
from lidarslam.evaluation.trajectory.alignment import align
from lidarslam.evaluation.trajectory.association import associate
from lidarslam.evaluation.trajectory.metrics import (
    absolute_errors,
    disagreement,
    evaluate_trajectory,
    relative_errors,
)

ELSEWHERE = exp([0.3, -0.2, 2.0, 100.0, -40.0, 5.0])
EVO_WORLD = exp([0.3, -0.2, 2.0, 100.0, -40.0, 5.0])
SEEDS = range(3)


@pytest.mark.real_data
def test_published_figures_of_kiss_icp_on_kitti_00(real_data):
    folder = real_data / "trajectories" / "kiss_icp_kitti_00"
    if not folder.is_dir():
        pytest.skip(f"no {folder.name} in the real data")
    estimate, reference = (
        Trajectory(0.1 * np.arange(len(poses)), poses)
        for poses in (read_kitti_poses(folder / f"{name}_kitti.txt") for name in ("estimate", "ground_truth"))
    )
    metrics = evaluate_trajectory(estimate, reference)
    assert metrics.kitti.overall.translation_percent == pytest.approx(0.528, abs=5e-4)
    assert metrics.kitti.overall.rotation_deg_per_m == pytest.approx(0.00189, abs=5e-6)
    assert metrics.errors.ate_rmse_m == pytest.approx(3.501, abs=5e-4)
    assert np.deg2rad(metrics.errors.ate_rotation_rmse_deg) == pytest.approx(0.019, abs=5e-4)
    translation, rotation = sequence_error(reference.T_world_lidar, estimate.T_world_lidar)
    assert metrics.kitti.overall.translation_percent == pytest.approx(translation, rel=1e-6)
    assert metrics.kitti.overall.rotation_deg_per_m * math.pi / 3.14 == pytest.approx(rotation, rel=1e-6)


def test_another_world_is_no_error(random_drive):
    reference = random_drive(1)
    errors = evaluate_trajectory(reference.transformed(ELSEWHERE), reference).errors
    assert errors.length_m == pytest.approx(reference.length_m)
    for value in (errors.ate_rmse_m, errors.rpe_translation_rmse_m, errors.end_error_m):
        assert value == pytest.approx(0.0, abs=1e-9)
    for value in (errors.ate_rotation_rmse_deg, errors.rpe_rotation_rmse_deg):
        assert value == pytest.approx(0.0, abs=1e-6)


def test_a_constant_error_of_each_step_is_the_rpe(random_drive):
    reference = random_drive(2)
    error = exp([0.0, 0.0, np.deg2rad(0.2), 0.03, -0.04, 0.0])
    error[:3, 3] = [0.03, -0.04, 0.0]
    estimate = Trajectory(reference.stamps, chain(ELSEWHERE, reference.relative_motions() @ error))
    errors = evaluate_trajectory(estimate, reference).errors
    assert errors.rpe_translation_rmse_m == pytest.approx(0.05, rel=1e-9)
    assert errors.rpe_rotation_rmse_deg == pytest.approx(0.2, rel=1e-9)


def test_scale_error_on_a_straight_line(straight_drive):
    # Residuals run evenly from -0.5 to 0.5 % of the length after alignment, at the end 1 % without it.
    reference = straight_drive(1001, (0.0, 0.0, 0.0, 0.2, 0.0, 0.0))
    estimate = straight_drive(1001, (0.0, 0.0, 0.0, 0.202, 0.0, 0.0))
    errors = evaluate_trajectory(estimate, reference).errors
    assert errors.end_error_m == pytest.approx(2.0, rel=1e-9)
    assert errors.ate_rmse_m == pytest.approx(2.0 / math.sqrt(12.0), rel=2e-3)
    assert errors.rpe_translation_rmse_m == pytest.approx(0.002, rel=1e-9)
    assert errors.ate_rotation_rmse_deg == pytest.approx(0.0, abs=1e-6)


def test_steps_across_unmatched_scans_are_left_out_of_the_rpe(straight_drive):
    estimate = straight_drive(100, (0.0, 0.0, 0.0, 1.01, 0.0, 0.0))
    reference = straight_drive(100)
    kept = np.r_[0:40, 60:100]
    metrics = evaluate_trajectory(estimate, reference.select(kept))
    assert metrics.association.to_json() == {"matched": 80, "estimate": 100, "reference": 80}
    assert metrics.errors.rpe_translation_rmse_m == pytest.approx(0.01, rel=1e-9)


def test_without_successive_scans_there_is_no_rpe(straight_drive):
    estimate = straight_drive(100)
    metrics = evaluate_trajectory(estimate, estimate.select(slice(None, None, 10)))
    written = metrics.to_json()["trajectory"]
    assert written["rpe_translation_rmse_m"] is None
    assert written["rpe_rotation_rmse_deg"] is None
    assert written["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)


def test_json_has_the_promised_keys_and_no_nan(random_drive, noisy, straight_drive):
    drift = {"translation_percent", "rotation_deg_per_100m"}
    lengths = {str(m) for m in range(100, 900, 100)}
    reference = random_drive(4, scans=950)
    written = evaluate_trajectory(noisy(reference, 5), reference).to_json()
    assert set(written) == {"association", "trajectory", "kitti", "segments", "map"}
    assert set(written["association"]) == {"matched", "estimate", "reference"}
    assert set(written["trajectory"]) == {
        "length_m",
        "ate_rmse_m",
        "ate_rotation_rmse_deg",
        "rpe_translation_rmse_m",
        "rpe_rotation_rmse_deg",
        "end_error_m",
    }
    assert set(written["kitti"]) == drift | {"by_length", "by_speed"}
    assert set(written["kitti"]["by_length"]) == lengths
    assert all(set(part) == drift for part in written["kitti"]["by_length"].values())
    assert set(written["kitti"]["by_speed"]) == {str(mps) for mps in range(2, 26, 2)}
    assert [mps for mps, part in written["kitti"]["by_speed"].items() if part] == ["8", "10", "12"]
    assert set(written["segments"]) == {"5", "10", "25", "40", "60", "100"}
    assert all(set(p) == {"translation_percent", "rotation_deg_per_10m"} for p in written["segments"].values())
    assert written["map"] is None
    json.dumps(written, allow_nan=False)


@pytest.mark.parametrize("metres_a_scan", [0.0, 0.1])
def test_short_and_still_recordings_are_null_and_not_zero(metres_a_scan, straight_drive):
    drive = straight_drive(80, (0.0, 0.0, 0.0, metres_a_scan, 0.0, 0.0))
    written = evaluate_trajectory(drive, drive).to_json()
    assert written["kitti"] is None
    assert written["segments"]["10"] is None
    assert (written["segments"]["5"] is None) == (metres_a_scan == 0.0)
    json.dumps(written, allow_nan=False)


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.T_world_lidar), timestamps=trajectory.stamps)


@pytest.fixture(params=SEEDS)
def pair(request, random_drive, noisy) -> tuple[Trajectory, Trajectory]:
    """An estimate in another world, and the reference."""
    reference = random_drive(request.param)
    return noisy(reference, request.param + 50, sigma=0.02).transformed(EVO_WORLD), reference


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


def test_a_shift_in_the_lidars_frame_is_found_along_its_axes(random_drive):
    reference = random_drive(1)
    shift = make_transform(np.eye(3), [0.3, -0.2, 0.1])
    estimate = Trajectory(reference.stamps, reference.T_world_lidar @ shift)
    translation_m, rotation_deg = evaluate_trajectory(estimate, reference, alignment="none").deviations()
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
    _, rotation_deg = evaluate_trajectory(estimate, reference, alignment="none").deviations()
    expected = np.zeros((50, 3))
    expected[:, axis] = angle_deg
    np.testing.assert_allclose(rotation_deg, expected, atol=1e-6)


def test_yaw_is_turned_first_then_pitch_then_roll(random_drive):
    reference = random_drive(3, scans=50)
    yaw, pitch, roll = (exp(np.deg2rad(angle) * np.eye(6)[axis]) for angle, axis in ((40.0, 2), (20.0, 1), (-10.0, 0)))
    estimate = Trajectory(reference.stamps, reference.T_world_lidar @ yaw @ pitch @ roll)
    _, rotation_deg = evaluate_trajectory(estimate, reference, alignment="none").deviations()
    np.testing.assert_allclose(rotation_deg, np.tile([-10.0, 20.0, 40.0], (50, 1)), atol=1e-6)


def along(positions: FloatArray) -> Trajectory:
    return Trajectory(
        0.1 * np.arange(len(positions)), make_transform(np.tile(np.eye(3), (len(positions), 1, 1)), positions)
    )


@pytest.fixture
def bend() -> FloatArray:
    angle = np.linspace(0.0, 4.0, 60)
    return 10.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.1 * angle])


def test_of_one_drive(bend: FloatArray, rng: np.random.Generator) -> None:
    drift = np.linspace(0.0, 3.0, len(bend))[:, None] * [1.0, 0.0, 0.0]
    for estimate in (bend, bend + drift, bend + rng.normal(0.0, 0.1, bend.shape)):
        assert disagreement(evaluate_trajectory(along(estimate), along(bend))) is None
    standing = rng.normal(0.0, 0.01, bend.shape)
    assert disagreement(evaluate_trajectory(along(standing), along(0.0 * bend))) is None


@pytest.mark.parametrize("kind", ["elsewhere", "lost", "stood still"])
def test_of_two_drives(bend: FloatArray, rng: np.random.Generator, kind: str) -> None:
    other = {"elsewhere": bend[:, [1, 2, 0]] * [3, 1, -2] + 9 * np.sin(bend), "lost": rng.normal(0, 50, bend.shape)}
    estimate = other.get(kind, 0.001 * bend[::-1])
    said = disagreement(evaluate_trajectory(along(estimate), along(bend)))
    assert said is not None
    assert "does not follow its reference" in said


def test_millimetres(bend: FloatArray) -> None:
    said = disagreement(evaluate_trajectory(along(bend), along(1_000.0 * bend)))
    assert said is not None
    assert said.endswith("are both in metres?")
