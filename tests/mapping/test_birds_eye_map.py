"""A scan laid on a map from above: the right place, turn and height among the first."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, rotation_angle, transform_points
from lidarslam.mapping.tracking.birds_eye_map import BirdsEyeMap
from lidarslam.mapping.tracking.budget import complete

from .runs import assert_near

RoomPoints = Callable[[np.random.Generator, int], FloatArray]

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def points(rng: np.random.Generator, l_shaped_room: RoomPoints) -> FloatArray:
    return l_shaped_room(rng, 20_000)


@pytest.mark.parametrize(("place", "turned_deg"), [
    ((0.0, 0.0, 0.0), 180.0), ((-2.5, 3.0, -0.4), 77.0), ((4.0, -1.5, 0.5), -130.0),
])  # fmt: skip
def test_place_turn_and_height_are_found(rng, l_shaped_room, points, place, turned_deg):
    true = exp([0.0, 0.0, np.deg2rad(turned_deg), 0.0, 0.0, 0.0])
    true[:3, 3] = place
    scan = transform_points(inverse(true), l_shaped_room(rng, 4_000))
    best = complete(BirdsEyeMap.of(points, UP, 0.4).find(scan, np.eye(4), 12.0, 5))[0]
    assert np.linalg.norm(best[:2, 3] - true[:2, 3]) < 0.6
    assert abs(best[2, 3] - true[2, 3]) < 0.3
    assert np.rad2deg(rotation_angle(inverse(true) @ best)) < 6.0


def test_in_a_tilted_world_the_lean_is_kept(rng, l_shaped_room, points):
    tilt = exp([0.2, -0.1, 0.0, 1.0, 2.0, 3.0])
    true = tilt @ exp([0.0, 0.0, 1.0, 1.0, -1.0, 0.0])
    scan = transform_points(inverse(true), transform_points(tilt, l_shaped_room(rng, 4_000)))
    plan = BirdsEyeMap.of(transform_points(tilt, points), tilt[:3, 2], 0.4)
    best = complete(plan.find(scan, tilt @ exp([0.0, 0.0, -2.0, 0.0, 0.0, 0.0]), 12.0, 5))[0]
    assert_near(best, true, 0.7, 6.0)


def test_what_shows_nothing_upright_lies_nowhere(points):
    floor = np.column_stack([np.random.default_rng(0).uniform(-3.0, 3.0, (500, 2)), np.full(500, -1.0)])
    assert complete(BirdsEyeMap.of(points, UP, 0.4).find(floor, np.eye(4), 12.0, 5)).shape == (0, 4, 4)


def test_no_two_places_are_the_same(rng, l_shaped_room, points):
    poses = complete(BirdsEyeMap.of(points, UP, 0.4).find(l_shaped_room(rng, 4_000), np.eye(4), 12.0, 20))
    assert len(poses) == 20
    for one, other in pairwise(poses):
        apart = np.linalg.norm(one[:3, 3] - other[:3, 3])
        assert apart > 1.0 or rotation_angle(inverse(one) @ other) > np.deg2rad(11.0)
