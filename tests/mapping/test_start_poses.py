"""Starts all around, or where a scan lies on the map seen from above, and the right one among them."""

from itertools import pairwise

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, is_rigid, rotation_angle, transform_points
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.birds_eye_map import BirdsEyeMap
from lidarslam.mapping.tracking.budget import complete
from lidarslam.mapping.tracking.scan_matcher import best_starts, best_velocity, turned_poses

from .runs import assert_near
from .shapes import l_shaped_room, surfel_map_of

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
def points(rng: np.random.Generator) -> FloatArray:
    return l_shaped_room(rng, 20_000)


@pytest.fixture
def l_map(points: FloatArray) -> SurfelMap:
    return surfel_map_of(points, 0.2)


@pytest.mark.parametrize("turned_deg", [0.0, 180.0, -97.0])
def test_the_right_yaw_is_found_in_an_l_shaped_room(rng, l_map, turned_deg):
    """The sensor was turned on the spot by some angle that nobody knows."""
    before = exp([0.0, 0.0, 0.2, 0.5, -0.5, 0.1])
    after = before @ exp([0.0, 0.0, np.deg2rad(turned_deg), 0.0, 0.0, 0.0])
    scan = transform_points(inverse(after), l_shaped_room(rng, 3_000))
    best = complete(best_starts(scan, turned_poses(before, UP, 15.0), l_map))
    # Of steps of 15; -97 lies 7 from one and 8 from the next.
    assert np.rad2deg(rotation_angle(inverse(best[0]) @ after)) < 9.0
    assert 1 < len(best) < 6


@pytest.mark.parametrize("true_deg", [-250.0, 0.0, 400.0])
def test_the_rate_of_turning_that_bent_a_sweep_is_found(rng, l_map, true_deg):
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


@pytest.mark.parametrize(("place", "turned_deg"), [
    ((0.0, 0.0, 0.0), 180.0), ((-2.5, 3.0, -0.4), 77.0), ((4.0, -1.5, 0.5), -130.0),
])  # fmt: skip
def test_place_turn_and_height_are_found_from_above(rng, points, place, turned_deg):
    true = exp([0.0, 0.0, np.deg2rad(turned_deg), 0.0, 0.0, 0.0])
    true[:3, 3] = place
    scan = transform_points(inverse(true), l_shaped_room(rng, 4_000))
    best = complete(BirdsEyeMap.of(points, UP, 0.4).find(scan, np.eye(4), 12.0, 5))[0]
    assert np.linalg.norm(best[:2, 3] - true[:2, 3]) < 0.6
    assert abs(best[2, 3] - true[2, 3]) < 0.3
    assert np.rad2deg(rotation_angle(inverse(true) @ best)) < 6.0


def test_in_a_tilted_world_the_lean_is_kept(rng, points):
    tilt = exp([0.2, -0.1, 0.0, 1.0, 2.0, 3.0])
    true = tilt @ exp([0.0, 0.0, 1.0, 1.0, -1.0, 0.0])
    scan = transform_points(inverse(true), transform_points(tilt, l_shaped_room(rng, 4_000)))
    plan = BirdsEyeMap.of(transform_points(tilt, points), tilt[:3, 2], 0.4)
    best = complete(plan.find(scan, tilt @ exp([0.0, 0.0, -2.0, 0.0, 0.0, 0.0]), 12.0, 5))[0]
    assert_near(best, true, 0.7, 6.0)


def test_what_shows_nothing_upright_lies_nowhere(rng, points):
    floor = np.column_stack([rng.uniform(-3.0, 3.0, (500, 2)), np.full(500, -1.0)])
    assert complete(BirdsEyeMap.of(points, UP, 0.4).find(floor, np.eye(4), 12.0, 5)).shape == (0, 4, 4)


def test_no_two_places_are_the_same(rng, points):
    poses = complete(BirdsEyeMap.of(points, UP, 0.4).find(l_shaped_room(rng, 4_000), np.eye(4), 12.0, 20))
    assert len(poses) == 20
    for one, other in pairwise(poses):
        apart = np.linalg.norm(one[:3, 3] - other[:3, 3])
        assert apart > 1.0 or rotation_angle(inverse(one) @ other) > np.deg2rad(11.0)
