"""The figures of a trajectory beside a published run, KISS-ICP's implementation and closed forms."""

import json
import math

import numpy as np
import pytest
from kiss_icp.metrics import absolute_trajectory_error, sequence_error

from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory, chain, read_kitti_poses
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory

ELSEWHERE = exp([0.3, -0.2, 2.0, 100.0, -40.0, 5.0])


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


@pytest.mark.parametrize("seed", range(4))
def test_ate_equals_that_of_kiss_icp(seed, random_drive, noisy):
    reference = random_drive(seed)
    estimate = noisy(reference, seed + 50, sigma=0.02).transformed(ELSEWHERE)
    rotation, translation = absolute_trajectory_error(reference.T_world_lidar, estimate.T_world_lidar)
    errors = evaluate_trajectory(estimate, reference).errors
    assert errors.ate_rmse_m == pytest.approx(translation, rel=1e-6)
    assert np.deg2rad(errors.ate_rotation_rmse_deg) == pytest.approx(rotation, rel=1e-6)


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


def test_the_end_error_trusts_the_start(random_drive):
    reference = random_drive(3)
    poses = reference.T_world_lidar.copy()
    poses[-1, :3, 3] += [0.0, 3.0, 4.0]
    estimate = Trajectory(reference.stamps, poses).transformed(ELSEWHERE)
    assert evaluate_trajectory(estimate, reference).errors.end_error_m == pytest.approx(5.0, rel=1e-9)


def test_a_time_shift_along_a_straight_line(straight_drive):
    # 0.02 s at 10 m/s is 0.2 m all along; the alignment takes it away, as it is one shift of the world.
    reference = straight_drive(300)
    estimate = Trajectory(reference.stamps[:-1] + 0.02, reference.T_world_lidar[:-1])
    metrics = evaluate_trajectory(estimate, reference)
    assert metrics.T_reference_estimate[:3, 3] == pytest.approx([0.2, 0.0, 0.0], abs=1e-6)
    assert metrics.errors.ate_rmse_m == pytest.approx(0.0, abs=1e-6)


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
