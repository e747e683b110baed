"""Matching in time: exact where stamps agree, interpolated between, refused over gaps."""

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.alignment import associate

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


def test_a_long_gap_of_the_reference_is_not_bridged():
    reference = moving(np.concatenate([np.arange(0.0, 2.05, 0.1), np.arange(5.0, 7.05, 0.1)]))
    estimate = moving(np.arange(0.0, 7.0, 0.25))
    found = associate(estimate, reference, max_gap_s=0.5)
    assert found.to_json() == {"matched": 17, "estimate": 28, "reference": 42}
    assert not ((found.estimate.stamps > 2.0) & (found.estimate.stamps < 5.0)).any()
    assert np.array_equal(estimate.stamps[found.rows], found.estimate.stamps)
    assert len(associate(estimate, reference, max_gap_s=3.0)) == 28


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
