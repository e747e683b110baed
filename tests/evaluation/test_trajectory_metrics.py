"""Trajectories matched in time, their figures beside evo, KISS-ICP and closed forms; unrelated ones are told."""

import json
import math

import numpy as np
import pytest
from evo.core.metrics import APE, RPE, PoseRelation
from evo.core.trajectory import PoseTrajectory3D
from kiss_icp.metrics import sequence_error
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, make_transform
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.alignment import associate
from lidarslam.evaluation.trajectory.metrics import (
    absolute_errors,
    disagreement,
    evaluate_trajectory,
    kitti_drift,
    relative_errors,
    segment_errors,
    short_drift,
)

METRES, DEGREES = PoseRelation.translation_part, PoseRelation.rotation_angle_deg
ELSEWHERE = exp([0.3, -0.2, 2.0, 100.0, -40.0, 5.0])


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


def test_json_has_the_promised_keys_and_no_nan(random_drive, noisy):
    drift, short = {"translation_percent", "rotation_deg_per_100m"}, {"translation_percent", "rotation_deg_per_10m"}
    reference = random_drive(4, scans=950)
    written = evaluate_trajectory(noisy(reference, 5), reference).to_json()
    rpe = {"rpe_translation_rmse_m", "rpe_rotation_rmse_deg"}
    assert set(written) == {"association", "trajectory", "kitti", "segments", "map"}
    assert set(written["association"]) == {"matched", "estimate", "reference"}
    assert set(written["trajectory"]) == {"length_m", "ate_rmse_m", "ate_rotation_rmse_deg", *rpe, "end_error_m"}
    kitti, segments = written["kitti"], written["segments"]
    assert set(kitti) == drift | {"by_length", "by_speed"}
    assert {m: set(part) for m, part in kitti["by_length"].items()} == {str(m): drift for m in range(100, 900, 100)}
    assert list(kitti["by_speed"]) == [str(mps) for mps in range(2, 26, 2)]
    assert [mps for mps, part in kitti["by_speed"].items() if part] == ["8", "10", "12"]
    assert {m: set(part) for m, part in segments.items()} == {str(m): short for m in (5, 10, 25, 40, 60, 100)}
    assert written["map"] is None
    json.dumps(written, allow_nan=False)


@pytest.mark.parametrize("metres_a_scan", [0.0, 0.1])
def test_short_and_still_recordings_are_null_and_not_zero(metres_a_scan, straight_drive):
    drive = straight_drive(80, (0.0, 0.0, 0.0, metres_a_scan, 0.0, 0.0))
    written = evaluate_trajectory(drive, drive).to_json()
    assert written["kitti"] is None
    assert [length for length, part in written["segments"].items() if part] == ["5"] * (metres_a_scan > 0.0)
    json.dumps(written, allow_nan=False)


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.T_world_lidar), timestamps=trajectory.stamps)


@pytest.fixture(params=range(3))
def pair(request, random_drive, noisy) -> tuple[Trajectory, Trajectory]:
    """An estimate in another world, and the reference."""
    reference = random_drive(request.param)
    return noisy(reference, request.param + 50, sigma=0.02).transformed(ELSEWHERE), reference


def assert_as_evo(
    metric: APE | RPE, pair: tuple[PoseTrajectory3D, PoseTrajectory3D], each: FloatArray, rmse: float, rel: float
) -> None:
    metric.process_data(pair)
    np.testing.assert_allclose(each, metric.error, atol=1e-5)
    assert rmse == pytest.approx(metric.get_all_statistics()["rmse"], rel=rel)


def test_errors_and_alignment_equal_those_of_evo(pair):
    estimate, reference = pair
    truth, aligned, moved = as_evo(reference), as_evo(estimate), as_evo(estimate)
    R, t, scale = aligned.align(truth, correct_scale=False)
    metrics = evaluate_trajectory(estimate, reference)
    np.testing.assert_allclose(metrics.T_reference_estimate, make_transform(R, t), atol=1e-7)
    assert scale == 1.0
    errors = metrics.errors
    away_m, turned_rad = absolute_errors(metrics.association, metrics.T_reference_estimate)
    assert_as_evo(APE(METRES), (truth, aligned), away_m, errors.ate_rmse_m, 1e-6)
    assert_as_evo(APE(DEGREES), (truth, aligned), np.rad2deg(turned_rad), errors.ate_rotation_rmse_deg, 1e-6)
    # evo's translation part is that of inverse(reference motion) @ estimated motion: as long as the difference.
    away_m, turned_rad = relative_errors(metrics.association)
    assert_as_evo(RPE(METRES), (truth, as_evo(estimate)), away_m, errors.rpe_translation_rmse_m, 1e-5)
    assert_as_evo(RPE(DEGREES), (truth, as_evo(estimate)), np.rad2deg(turned_rad), errors.rpe_rotation_rmse_deg, 1e-5)
    moved.align_origin(truth)
    end_error_m = np.linalg.norm(moved.positions_xyz[-1] - reference.positions[-1])
    assert errors.end_error_m == pytest.approx(end_error_m, rel=1e-9)


def test_a_shift_in_the_lidars_frame_is_found_along_its_axes(random_drive):
    reference = random_drive(1)
    shift = make_transform(np.eye(3), [0.3, -0.2, 0.1])
    estimate = Trajectory(reference.stamps, reference.T_world_lidar @ shift)
    translation_m, rotation_deg = evaluate_trajectory(estimate, reference, alignment="none").deviations()
    np.testing.assert_allclose(translation_m, np.tile([0.3, -0.2, 0.1], (len(reference), 1)), atol=1e-9)
    np.testing.assert_allclose(rotation_deg, 0.0, atol=1e-6)


@pytest.mark.parametrize("turns", [(-120.0, 0.0, 0.0), (0.0, 80.0, 0.0), (0.0, 0.0, -120.0), (-10.0, 20.0, 40.0)])
def test_yaw_is_turned_first_then_pitch_then_roll(turns, random_drive):
    reference = random_drive(3, scans=50)
    roll, pitch, yaw = (exp(np.deg2rad(angle) * axis) for angle, axis in zip(turns, np.eye(6)[:3], strict=True))
    estimate = Trajectory(reference.stamps, reference.T_world_lidar @ yaw @ pitch @ roll)
    _, rotation_deg = evaluate_trajectory(estimate, reference, alignment="none").deviations()
    np.testing.assert_allclose(rotation_deg, np.tile(turns, (50, 1)), atol=1e-6)


def along(positions: FloatArray) -> Trajectory:
    count = len(positions)
    return Trajectory(0.1 * np.arange(count), make_transform(np.tile(np.eye(3), (count, 1, 1)), positions))


@pytest.fixture
def bend() -> FloatArray:
    angle = np.linspace(0.0, 4.0, 60)
    return 10.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.1 * angle])


def test_of_one_drive(bend, rng):
    drift = np.linspace(0.0, 3.0, len(bend))[:, None] * [1.0, 0.0, 0.0]
    for estimate in (bend, bend + drift, bend + rng.normal(0.0, 0.1, bend.shape)):
        assert disagreement(evaluate_trajectory(along(estimate), along(bend))) is None
    standing = rng.normal(0.0, 0.01, bend.shape)
    assert disagreement(evaluate_trajectory(along(standing), along(0.0 * bend))) is None


def test_of_two_drives(bend, rng):
    elsewhere, lost = bend[:, [1, 2, 0]] * [3, 1, -2] + 9 * np.sin(bend), rng.normal(0, 50, bend.shape)
    for estimate in (elsewhere, lost, 0.001 * bend[::-1], 1_000.0 * bend):
        said = disagreement(evaluate_trajectory(along(estimate), along(bend)))
        assert "does not follow its reference" in said


def test_quaternions_in_another_order_and_orientations_of_a_camera(random_drive):
    reference = random_drive(3)
    quaternions = Rotation.from_matrix(reference.T_world_lidar[:, :3, :3]).as_quat()
    forward, other = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), reference.T_world_lidar.copy()
    for R in (Rotation.from_quat(quaternions[:, [3, 0, 1, 2]]).as_matrix(), other[:, :3, :3] @ forward.T):
        other[:, :3, :3] = R
        said = disagreement(evaluate_trajectory(reference, Trajectory(reference.stamps, other)))
        assert "begin with qw" in said
    assert disagreement(evaluate_trajectory(reference, reference)) is None


# Constant body velocity, so that interpolation and extrapolation are exact.
TWIST = np.array([0.1, -0.2, 0.3, 2.0, 0.5, -0.1])


def moving(stamps: np.ndarray) -> Trajectory:
    return Trajectory(stamps, exp(stamps[:, None] * TWIST))


def test_equal_stamps_give_the_reference_to_the_last_bit(random_drive):
    reference = random_drive(1, scans=50)
    estimate = reference.select(slice(3, None, 2))
    found = associate(estimate, reference)
    assert np.array_equal(found.reference.T_world_lidar, estimate.T_world_lidar)
    assert np.array_equal(found.rows, np.arange(len(estimate)))
    assert found.to_json() == {"matched": 24, "estimate": 24, "reference": 50}


@pytest.mark.parametrize(
    ("reference_s", "estimate_s", "rows"),
    [
        (np.arange(0.0, 5.0, 0.2), np.linspace(0.03, 4.7, 31), list(range(31))),
        (np.arange(0.0, 10.0, 2.0), np.array([0.01, 1.0, 2.015, 3.99, 5.0]), [0, 2, 3]),
        (np.arange(1.0, 2.05, 0.1), np.array([0.97, 0.985, 1.5, 2.015, 2.03]), [1, 2, 3]),
    ],
    ids=["between poses", "in a gap only close to a pose", "beyond the ends only within the tolerance"],
)
def test_the_reference_is_interpolated_at_the_stamps_of_the_estimate(reference_s, estimate_s, rows):
    found = associate(moving(estimate_s), moving(reference_s), tolerance_s=0.02, max_gap_s=0.5)
    assert found.rows.tolist() == rows
    np.testing.assert_allclose(found.reference.T_world_lidar, moving(estimate_s[rows]).T_world_lidar, atol=1e-12)


def test_extrapolation_does_not_trust_two_poses_a_microsecond_apart():
    stamps = np.array([0.0, 0.1, 0.2, 0.200001])
    poses = exp(stamps[:, None] * TWIST)
    poses[3, 0, 3] += 0.01
    estimate = moving(np.array([0.0, 0.1, 0.215]))
    found = associate(estimate, Trajectory(stamps, poses), tolerance_s=0.02)
    assert np.linalg.norm(found.reference.positions[2] - poses[3, :3, 3]) < 0.02


@pytest.mark.parametrize(
    ("estimate_s", "reference_s", "words"),
    [
        (np.arange(10.0), 100.0 + np.arange(10.0), "found 0.*10 poses from 0.000 to 9.000 s.*100.000.*the clock"),
        (np.arange(10.0) + 0.5, np.arange(11.0), "found 0.*not bridged"),
        (np.arange(10.0), np.arange(1.0), "found 1.*1 pose .*too short"),
        (np.arange(0.0), np.arange(10.0), "0 poses.*too short"),
    ],
)
def test_too_few_matches_are_refused_with_a_likely_cause(estimate_s, reference_s, words):
    still = [Trajectory(s, np.broadcast_to(np.eye(4), (len(s), 4, 4))) for s in (estimate_s, reference_s)]
    with pytest.raises(InputError, match=words):
        associate(*still)


# KISS-ICP, like the development kit's first version, takes pi for 3.14 and returns single precision.
KISS_ICP_PI = 3.14


@pytest.mark.parametrize("seed", range(4))
def test_kitti_drift_equals_that_of_kiss_icp(seed, random_drive, noisy):
    reference = random_drive(seed, scans=1000)
    estimate = noisy(reference, seed + 50).transformed(exp([0.1, 0.2, 2.0, 5.0, 6.0, 7.0]))
    translation, rotation = sequence_error(reference.T_world_lidar, estimate.T_world_lidar)
    drift = kitti_drift(associate(estimate, reference))
    assert drift.overall.translation_percent == pytest.approx(translation, rel=1e-6)
    assert drift.overall.rotation_deg_per_m * math.pi / KISS_ICP_PI == pytest.approx(rotation, rel=1e-6)
    assert drift.by_length[800] is not None


def test_a_segment_ends_beyond_its_length_and_not_at_it(straight_drive):
    drive = straight_drive(30)  # poses at 0, 1, ... 29 m exactly
    drift = segment_errors(associate(drive, drive), [5.0], step=1).mean()
    assert drift.segments == 24


@pytest.mark.parametrize("direction", [0.99, 1.01])
def test_one_percent_of_scale_is_one_percent_of_drift(direction, straight_drive):
    # 0.998 m a scan: segments overshoot by little, and no length is a multiple of the step.
    reference = straight_drive(1000, (0.0, 0.0, 0.0, 0.998, 0.0, 0.0))
    estimate = straight_drive(1000, (0.0, 0.0, 0.0, 0.998 * direction, 0.0, 0.0))
    for part in short_drift(associate(estimate, reference)).values():
        assert part.translation_percent == pytest.approx(1.0, rel=1e-9)


def test_a_constant_yaw_rate_is_found_per_metre(straight_drive):
    step_m, yaw_per_step = 0.5, np.deg2rad(0.005)
    reference = straight_drive(2000, (0.0, 0.0, 0.0, step_m, 0.0, 0.0))
    estimate = straight_drive(2000, (0.0, 0.0, yaw_per_step, step_m, 0.0, 0.0))
    for length_m, part in short_drift(associate(estimate, reference)).items():
        assert part.rotation_deg_per_m == pytest.approx(0.01, rel=1e-6)
        # The chord leaves the tangent by length^2 * curvature / 2.
        deviation_percent = 100.0 * length_m * np.deg2rad(0.01) / 2.0
        assert part.translation_percent == pytest.approx(deviation_percent, rel=0.11)


def test_speed_is_taken_from_the_stamps(straight_drive):
    reference = straight_drive(400, (0.0, 0.0, 0.0, 1.01, 0.0, 0.0))
    drift = kitti_drift(associate(reference, reference))
    assert {speed for speed, part in drift.by_speed.items() if part} == {10, 12}
    slower = Trajectory(2.0 * reference.stamps, reference.T_world_lidar)
    drift = kitti_drift(associate(slower, slower))
    assert {speed for speed, part in drift.by_speed.items() if part} == {4, 6}
