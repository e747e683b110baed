"""Motions are continuous, physical, on the ground, and come round."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import exp, is_rigid, make_transform
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.motion import CARRIERS, motion_along
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.world import Route, World

STEP_S = 0.005
# name: largest acceleration along, across and up (m/s^2), turn rate (deg/s) and angular acceleration (deg/s^2); the
# sway of what walks counts.
LIMITS = {
    "car": (3.0, 4.0, 3.0, 60.0, 120.0),
    "handheld": (2.5, 4.5, 6.0, 110.0, 400.0),
    "legged": (2.5, 4.5, 6.0, 100.0, 500.0),
    "tracked": (2.0, 2.0, 6.0, 121.0, 520.0),
    "tracked-harsh": (2.0, 2.0, 6.0, 181.0, 920.0),
    "drone": (3.0, 3.0, 4.0, 90.0, 300.0),
    "car-fast": (3.5, 5.0, 3.0, 60.0, 120.0),
    "drone-agile": (6.0, 6.0, 5.0, 170.0, 900.0),
}


@pytest.fixture(scope="module", params=list(CARRIERS))
def motion(request, yard):
    return motion_along_route(request.param, yard, seed=4)


@pytest.fixture(scope="module")
def T(motion):
    """Poses of a lap and a bit more."""
    return motion.pose_at(np.arange(0.0, motion.duration_s + 5.0, STEP_S))


def yaw_of(T):
    return np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0]))


def test_limits_are_physical(motion, T):
    acceleration = np.gradient(np.gradient(T[:, :3, 3], STEP_S, axis=0), STEP_S, axis=0)
    along, across, up, rate, angular = LIMITS[motion.name]
    assert is_rigid(T)
    assert np.abs((acceleration * T[:, :3, 0]).sum(axis=1)).max() < along
    assert np.abs((acceleration * T[:, :3, 1]).sum(axis=1)).max() < across
    assert np.abs(acceleration[:, 2]).max() < up
    turning = np.rad2deg(np.gradient(yaw_of(T), STEP_S))
    assert np.abs(turning).max() < rate
    assert np.abs(np.gradient(turning, STEP_S)).max() < angular


def test_laps_come_round_exactly(motion):
    if not motion.rests:  # the sway goes on as it likes
        motion = replace(motion, sway=())
    laps = motion.duration_s * np.arange(4)
    np.testing.assert_allclose(motion.pose_at(laps), motion.pose_at(np.zeros(4)), atol=1e-9)
    quarter = motion.pose_at(np.array([0.25, 1.25]) * motion.duration_s)
    assert np.linalg.norm(quarter[0, :3, 3] - motion.pose_at(np.zeros(1))[0, :3, 3]) > 5.0
    sway = 0.6 if CARRIERS[motion.name].banks else 0.3
    assert np.linalg.norm(quarter[0, :3, 3] - quarter[1, :3, 3]) < sway


def test_stays_within_the_free_side(motion, T, yard):
    a = yard.route.waypoints[:, :2]
    legs = np.roll(a, -1, axis=0) - a
    offsets = T[::20, None, :2, 3] - a
    along = np.clip((offsets * legs).sum(axis=-1) / (legs**2).sum(axis=-1), 0.0, 1.0)
    away = np.linalg.norm(offsets - along[..., None] * legs, axis=-1).min(axis=1)
    assert away.max() < yard.route.free_side_m - CARRIERS[motion.name].half_width_m + 0.15


def test_follows_the_ground(motion, T, yard):
    above = T[::20, 2, 3] - yard.ground_at(T[::20, :2, 3])
    if CARRIERS[motion.name].banks:
        assert 1.4 < above.min() < above.max() < 2.6
    else:
        assert np.abs(above).max() < 0.08


@pytest.mark.parametrize(("name", "rate"), [("tracked", 120.0), ("tracked-harsh", 180.0)])
def test_tracked_turns_on_the_spot(name, rate, yard):
    motion = motion_along_route(name, yard, seed=4)
    times = np.arange(0.0, motion.duration_s, STEP_S)
    T = motion.pose_at(times)
    turning = np.rad2deg(np.gradient(yaw_of(T), STEP_S))
    speed = np.linalg.norm(np.gradient(T[:, :2, 3], STEP_S, axis=0), axis=1)
    np.testing.assert_allclose(np.abs(turning).max(), rate, rtol=0.005)
    assert speed[np.abs(turning) > 10.0].max() < 1e-3
    assert np.abs(turning[speed > 0.05]).max() < 10.0
    if name == "tracked-harsh":
        np.testing.assert_allclose([turning.min(), turning.max()], [-rate, rate], rtol=0.005)


def test_what_keeps_going_never_halts(yard):
    motion = motion_along_route("car-fast", yard, seed=4)
    T = motion.pose_at(np.arange(0.0, 2.5 * motion.duration_s, STEP_S))
    velocity = np.gradient(T[:, :3, 3], STEP_S, axis=0)
    assert np.linalg.norm(velocity, axis=1).min() > 1.2
    seam = motion.duration_s + np.array([-1e-4, 1e-4])
    before, after = motion.pose_at(seam)
    assert np.abs(after - before).max() < 2.5e-4 * np.linalg.norm(velocity, axis=1).max()
    assert np.abs(np.diff(velocity, axis=0)).max() / STEP_S < 6.0


@pytest.mark.parametrize("speed_mps", [5.0, 30.0])
def test_a_speed_can_be_asked_for(speed_mps):
    """On a ring road of 400 m radius, on which 3.5 m/s^2 across allow 37 m/s."""
    angle = np.linspace(0.0, 2.0 * np.pi, 1257)[:-1]
    ring = 400.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    world = World("ring", 0, Route(ring, 4.0, 2.0, 4.0, speed_limit_mps=14.0))
    motion = motion_along_route("car-fast", world, seed=1, speed_mps=speed_mps)
    positions = motion.pose_at(np.arange(0.0, motion.duration_s, 0.1))[:, :3, 3]
    speeds = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1) / 0.1
    np.testing.assert_allclose(speeds, speed_mps, rtol=0.01)
    np.testing.assert_allclose(np.linalg.norm(positions[:, :2], axis=1), 400.0, atol=0.02)
    limited = motion_along_route("car-fast", world, seed=1)
    assert limited.duration_s == pytest.approx(2.0 * np.pi * 400.0 / 14.0, rel=0.01)


def test_a_given_trajectory_is_followed():
    steps = exp(np.tile([0.0, 0.0, 0.01, 0.4, 0.0, 0.0], (80, 1)))
    T = [make_transform(np.eye(3), [-10.0, -9.0, 50.0])]
    for step in steps[1:]:
        T.append(T[-1] @ step)
    trajectory = Trajectory(100.0 + 0.1 * np.arange(80), np.stack(T))
    motion = motion_along(trajectory)
    followed = motion.pose_at(trajectory.stamps - 100.0)
    np.testing.assert_allclose(followed, trajectory.T_world_lidar, atol=1e-9)
    np.testing.assert_allclose(motion.pose_at(np.array([20.0])), followed[-1:], atol=1e-12)
    assert motion.sensor_height_m == 0.0
