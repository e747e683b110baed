"""Alignment of a trajectory with a GNSS track."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, rotation_angle
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map.georeference import GnssTrack, align_to_track

SCALE = 0.9996
T_MAP_WORLD = make_transform(exp([0.02, -0.03, 2.0, 0.0, 0.0, 0.0])[:3, :3], [457_800.0, 5_428_860.0, 114.0])
ANTENNA = np.array([-0.8, 0.3, 0.9])


@pytest.fixture
def trajectory() -> Trajectory:
    """A loop of 200 m over a slope."""
    stamps = 0.1 * np.arange(400)
    angles = 2.0 * np.pi * stamps / stamps[-1]
    T = make_transform(
        exp(np.multiply.outer(angles, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))[:, :3, :3],
        np.column_stack([32.0 * np.sin(angles), 32.0 * (1.0 - np.cos(angles)), np.sin(angles)]),
    )
    return Trajectory(stamps, T)


def measured(trajectory: Trajectory, noise_m: float, rng: np.random.Generator) -> tuple[GnssTrack, FloatArray]:
    """One position in ten scans, between them, and the projected positions."""
    stamps = trajectory.stamps[:-1:10] + 0.037
    T = trajectory.at(stamps)
    antenna = T[:, :3, :3] @ ANTENNA + T[:, :3, 3]
    projected = SCALE * antenna @ T_MAP_WORLD[:3, :3].T + T_MAP_WORLD[:3, 3]
    projected += rng.normal(0.0, noise_m, projected.shape) if noise_m else 0.0
    track = GnssTrack(stamps, np.zeros((len(stamps), 3)), np.full(len(stamps), np.nan), ANTENNA)
    return track, projected


def test_the_pose_of_the_world_is_found(trajectory, rng):
    track, projected = measured(trajectory, 0.0, rng)
    found = align_to_track(trajectory, track, projected, SCALE)
    error = inverse(T_MAP_WORLD) @ found.T_map_world
    assert np.linalg.norm(error[:3, 3]) < 1e-3
    assert rotation_angle(error) < 1e-4  # the prior of the tilt counts little
    assert found.rms_m < 1e-3
    assert found.matched == 40
    expected = SCALE * trajectory.positions @ T_MAP_WORLD[:3, :3].T + T_MAP_WORLD[:3, 3]
    np.testing.assert_allclose(found.positions(trajectory.positions), expected, atol=1e-3)


def test_outliers_count_little(trajectory, rng):
    """A fifth of the positions are reflections, up to 30 m away to one side."""
    track, projected = measured(trajectory, 0.05, rng)
    projected[::5, 0] += rng.uniform(10.0, 30.0, len(projected[::5]))
    found = align_to_track(trajectory, track, projected, SCALE)
    error = inverse(T_MAP_WORLD) @ found.T_map_world
    assert np.linalg.norm(error[:3, 3]) < 0.15
    assert rotation_angle(error) < np.deg2rad(0.3)
    assert found.median_m < 0.2
    assert found.rms_m > 5.0


def test_a_straight_line_leaves_the_roll_to_the_prior(rng):
    stamps = 0.1 * np.arange(300)
    straight = Trajectory(stamps, exp(np.multiply.outer(stamps, [0.0, 0.0, 0.0, 5.0, 0.0, 0.0])))
    track, projected = measured(straight, 0.0, rng)
    found = align_to_track(straight, track, projected, SCALE)
    np.testing.assert_allclose(found.T_map_world[:3, 0], T_MAP_WORLD[:3, 0], atol=1e-3)
    assert found.T_map_world[2, 2] > 0.998


def test_a_short_track_leaves_the_heading_open(trajectory, rng):
    track, projected = measured(trajectory.select(slice(0, 100)), 1.0, rng)
    assert align_to_track(trajectory, track, projected, SCALE).heading_sigma_deg > 3.0
    with pytest.raises(ValueError, match="4 GNSS positions are within the time of the run"):
        align_to_track(trajectory.select(slice(0, 40)), track, projected, SCALE)
