"""Drift over segments beside closed forms and KISS-ICP's implementation."""

import math

import numpy as np
import pytest
from kiss_icp.metrics import sequence_error

from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.association import associate
from lidarslam.evaluation.trajectory.drift import kitti_drift, segment_errors, short_drift

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
