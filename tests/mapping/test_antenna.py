"""Trajectories aligned with GNSS tracks, and its positions in the graph of a drive whose edges drift."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map.georeference import GnssTrack, ProjectedTrack, align_to_track
from lidarslam.mapping.loops.closure import RelativePose
from lidarslam.mapping.pose_graph.optimizer import optimise

from .runs import assert_near

SCANS, EVERY, PERIOD_S = 600, 10, 0.1
ANTENNA = np.array([-0.5, 0.2, 1.0])
SIGMA_M = 0.05
T_MAP_WORLD = make_transform(exp([0.02, -0.03, 2.0, 0.0, 0.0, 0.0])[:3, :3], [691_000.0, 5_334_000.0, 520.0])
COVARIANCE = np.diag([np.deg2rad(0.3)] * 3 + [0.05] * 3) ** 2


def drive(yaw_drift: float) -> FloatArray:
    """Poses (N, 4, 4) of 600 m in bends and over hills, whose heading drifts."""
    poses = [np.eye(4)]
    for n in range(1, SCANS):
        turn = [0.0, 0.003 * np.cos(0.05 * n), 0.02 * np.cos(0.02 * n) + yaw_drift]
        poses.append(poses[-1] @ exp([*turn, 1.0, 0.0, 0.0]))
    return np.array(poses)


def test_positions_take_the_drift_away_and_outliers_are_rejected(rng):
    """Fixes are at 5 Hz; a stretch of a fifth of them is 20 to 40 m off."""
    poses = T_MAP_WORLD @ drive(0.0)[::2]
    antenna = poses[:, :3, :3] @ ANTENNA + poses[:, :3, 3] + rng.normal(0.0, SIGMA_M, (SCANS // 2, 3))
    antenna[100:160] += np.array([20.0, 20.0, 10.0]) + rng.normal(0.0, 5.0, (60, 3))
    stamps = PERIOD_S * np.arange(0, SCANS, 2)
    gnss = GnssTrack(stamps, np.zeros((len(stamps), 3)), np.full(len(stamps), SIGMA_M), ANTENNA)
    track = ProjectedTrack(gnss, antenna, 1.0)
    true, drifted = drive(0.0), drive(2e-4)
    scans = np.arange(0, SCANS, EVERY)
    nodes = drifted[scans]
    registered = Trajectory(PERIOD_S * np.arange(SCANS), drifted)
    edges = [RelativePose(n, n + 1, T, COVARIANCE) for n, T in enumerate(inverse(nodes[:-1]) @ nodes[1:])]
    T_map_world = track.aligned(registered)
    positions = track.positions(registered, scans.tolist())
    found = optimise(T_map_world @ nodes, edges, [], [], positions)
    placed = T_MAP_WORLD @ true[scans]
    errors = np.linalg.norm(found.poses[:, :3, 3] + track.projected[0] - placed[:, :3, 3], axis=1)
    drift = np.linalg.norm(nodes[:, :3, 3] - true[scans][:, :3, 3], axis=1)
    assert drift.max() > 20.0
    assert errors.max() < 0.3
    rejected = np.flatnonzero(~found.position_inliers)
    assert set(range(100, 160)) <= set(rejected.tolist())
    assert len(rejected) < 70


SCALE = 0.9996


@pytest.fixture
def loop() -> Trajectory:
    """Of 200 m, over a slope."""
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


def test_the_pose_of_the_world_is_found(loop, rng):
    track, projected = measured(loop, 0.0, rng)
    found = align_to_track(loop, track, projected, SCALE)
    assert_near(found.T_map_world, T_MAP_WORLD, 1e-3, np.rad2deg(1e-4))  # the prior of the tilt counts little
    assert (found.matched, found.rms_m) == (40, pytest.approx(0.0, abs=1e-3))
    expected = SCALE * loop.positions @ T_MAP_WORLD[:3, :3].T + T_MAP_WORLD[:3, 3]
    np.testing.assert_allclose(found.positions(loop.positions), expected, atol=1e-3)


def test_outliers_count_little(loop, rng):
    """A fifth of the positions are reflections, up to 30 m away to one side."""
    track, projected = measured(loop, 0.05, rng)
    projected[::5, 0] += rng.uniform(10.0, 30.0, len(projected[::5]))
    found = align_to_track(loop, track, projected, SCALE)
    assert_near(found.T_map_world, T_MAP_WORLD, 0.15, 0.3)
    assert found.median_m < 0.2
    assert found.rms_m > 5.0


def test_a_straight_line_leaves_the_roll_to_the_prior(rng):
    stamps = 0.1 * np.arange(300)
    straight = Trajectory(stamps, exp(np.multiply.outer(stamps, [0.0, 0.0, 0.0, 5.0, 0.0, 0.0])))
    found = align_to_track(straight, *measured(straight, 0.0, rng), SCALE)
    np.testing.assert_allclose(found.T_map_world[:3, 0], T_MAP_WORLD[:3, 0], atol=1e-3)
    assert found.T_map_world[2, 2] > 0.998


def test_a_short_track_leaves_the_heading_open(loop, rng):
    track, projected = measured(loop.select(slice(0, 100)), 1.0, rng)
    assert align_to_track(loop, track, projected, SCALE).heading_sigma_deg > 3.0
    with pytest.raises(ValueError, match="4 GNSS positions"):
        align_to_track(loop.select(slice(0, 40)), track, projected, SCALE)
