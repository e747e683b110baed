"""Starts all around, and the right one among them."""

from collections.abc import Callable

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, is_rigid, rotation_angle, transform_points
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.budget import complete
from lidarslam.mapping.tracking.start_poses import best_starts, best_velocity, turned_poses

from .shapes import surfel_map_of

RoomPoints = Callable[[np.random.Generator, int], FloatArray]

UP = np.array([0.0, 0.0, 1.0])
T_GIVEN = exp([0.1, -0.2, 0.7, 3.0, -2.0, 0.5])


@pytest.mark.parametrize(("step_deg", "count"), [(15.0, 24), (90.0, 4), (50.0, 7), (400.0, 1)])
def test_turns_are_even_and_go_all_around(step_deg, count):
    starts = turned_poses(T_GIVEN, UP, step_deg)
    assert len(starts) == count
    turns = starts[:, :3, :3] @ T_GIVEN[:3, :3].T
    yaw_deg = np.sort(np.rad2deg(np.arctan2(turns[:, 1, 0], turns[:, 0, 0])) % 360.0)
    np.testing.assert_allclose(np.diff(yaw_deg), 360.0 / count, atol=1e-9)
    angles = rotation_angle(inverse(T_GIVEN) @ starts)
    assert angles[0] == pytest.approx(0.0, abs=1e-9)
    assert (np.diff(angles) > -1e-9).all(), "small turns first"
    assert is_rigid(starts, 1e-12)
    np.testing.assert_array_equal(starts[:, :3, 3], np.tile(T_GIVEN[:3, 3], (count, 1)))


def test_turns_are_about_the_given_vertical():
    """In a world that is tilted, as the first scan was, the sensor keeps its lean against the true vertical."""
    up = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    starts = turned_poses(T_GIVEN, up, 15.0)
    np.testing.assert_allclose(up @ starts[:, :3, 2].T, up @ T_GIVEN[:3, 2], atol=1e-12)


@pytest.fixture
def l_map(rng: np.random.Generator, l_shaped_room: RoomPoints) -> SurfelMap:
    return surfel_map_of(l_shaped_room(rng, 20_000), 0.2)


@pytest.mark.parametrize("turned_deg", [0.0, 180.0, -97.0])
def test_the_right_yaw_is_found_in_an_l_shaped_room(rng, l_shaped_room, l_map, turned_deg):
    """The sensor was turned on the spot by some angle that nobody knows."""
    before = exp([0.0, 0.0, 0.2, 0.5, -0.5, 0.1])
    after = before @ exp([0.0, 0.0, np.deg2rad(turned_deg), 0.0, 0.0, 0.0])
    points = transform_points(inverse(after), l_shaped_room(rng, 3_000))
    best = complete(best_starts(points, turned_poses(before, UP, 15.0), l_map))
    # Of steps of 15; -97 lies 7 from one and 8 from the next.
    assert np.rad2deg(rotation_angle(inverse(best[0]) @ after)) < 9.0
    assert 1 < len(best) < 6


@pytest.mark.parametrize("true_deg", [-250.0, 0.0, 400.0])
def test_the_rate_of_turning_that_bent_a_sweep_is_found(rng, l_shaped_room, l_map, true_deg):
    """Points of the room as a sweep of 0.1 s sees them that turns so fast; the best of steps of 50 deg/s."""
    velocities = np.zeros((17, 6))
    velocities[:, 2] = np.deg2rad(np.arange(-400.0, 401.0, 50.0))
    true = np.zeros(6)
    true[2] = np.deg2rad(true_deg)
    points = l_shaped_room(rng, 3_000)
    times = rng.uniform(0.0, 0.1, len(points))
    T_lidar_moment = exp(true * times[:, None])
    seen = np.einsum("nji,nj->ni", T_lidar_moment[:, :3, :3], points - T_lidar_moment[:, :3, 3])
    np.testing.assert_allclose(best_velocity(Sweep(seen, times), velocities, np.eye(4), l_map), true, atol=1e-12)
