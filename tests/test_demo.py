"""The demonstration tells the story it promises."""

from pathlib import Path

import numpy as np

from lidarslam.core.geometry import exp, rotation_angle
from lidarslam.core.trajectory import Trajectory
from lidarslam.demo import drifting, format_demo, run_demo


def test_a_prior_survives_the_turns_that_lose_kiss_icp(tmp_path: Path) -> None:
    rows = run_demo(tmp_path, scans=110)
    kiss, wheels = (row.outcome for row in rows)
    assert kiss.metrics is not None
    assert wheels.metrics is not None
    assert wheels.summary.lost_scans == 0
    assert wheels.metrics.errors.ate_rmse_m < 0.02
    assert kiss.summary.lost_scans > 5
    assert kiss.metrics.errors.ate_rmse_m > 10.0 * wheels.metrics.errors.ate_rmse_m
    for name in ("recording", "kiss-icp", "wheel-odometry"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    text = format_demo(tmp_path, rows)
    assert f"{kiss.summary.lost_scans:>12}" in text
    assert str(tmp_path / "kiss-icp.png") in text


def test_wheels_drift_as_much_as_they_are_said_to() -> None:
    stamps = 0.1 * np.arange(2_001)
    truth = Trajectory(stamps, exp(np.multiply.outer(stamps, [0.0, 0.0, 0.1, 1.0, 0.0, 0.0])))
    report = drifting(truth, seed=3)
    steps = np.linalg.inv(truth.relative_motions()) @ report.relative_motions()
    slip_m, turn_deg = np.linalg.norm(steps[:, :3, 3], axis=1), np.rad2deg(rotation_angle(steps))
    # Three axes of 1 % of steps of 10 cm; a turn and two tilts of a fifth of it.
    assert abs(np.sqrt(np.mean(slip_m**2)) / (np.sqrt(3.0) * 0.001) - 1.0) < 0.05
    assert abs(np.sqrt(np.mean(turn_deg**2)) / (0.05 * np.sqrt(1.08)) - 1.0) < 0.05
