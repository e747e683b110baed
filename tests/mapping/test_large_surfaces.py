"""Crowds that walk along: walls and floor contradict, where they suffice for a pose."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.registration.registration import inflation_of_small, register
from lidarslam.mapping.surfels.surfel_map import SurfelMap

from .shapes import on_sides, surfel_map_of

CELL_M = 0.1
HALL_M = np.array([8.0, 6.0, 2.5])  # half its length, width and height
PERSON_M = np.array([0.25, 0.2, 0.85])
WALKED = np.array([0.12, 0.02, 0.0])
ALL, ALONG = (0, 1, 2), (1, 2)  # the axes across which there are walls


def people(rng: np.random.Generator, count: int) -> FloatArray:
    """Points (N, 3) on a dozen people around the sensor, each turned otherwise."""
    parts = []
    for k in range(12):
        yaw, away_m = 2.1 * k, 1.5 + 0.15 * k
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        place = away_m * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.0]) - [0.0, 0.0, 1.6]
        parts.append(on_sides(rng, PERSON_M, count // 12, (0, 1)) @ turn.T + place)
    return np.concatenate(parts)


def scene(axes: tuple[int, ...], crowd: int) -> tuple[SurfelMap, Sweep]:
    """A map of a hall with people, and a sweep of it after the sensor and the people have walked."""
    rng = np.random.default_rng(7)
    before = np.concatenate([on_sides(rng, HALL_M, 400_000, axes), people(rng, 60_000)])
    after = np.concatenate([on_sides(rng, HALL_M, 1_500, axes) - WALKED, people(rng, crowd)])
    before, after = (points + rng.normal(0.0, 0.003, points.shape) for points in (before, after))
    return surfel_map_of(before, CELL_M), Sweep(after)


def inflation(surfel_map: SurfelMap, sweep: Sweep) -> FloatArray | None:
    """At the pose of the people, at rest."""
    matcher = surfel_map.matcher(sweep)
    matcher.match(transform_points(np.eye(4), sweep.points), np.eye(4))
    return inflation_of_small(sweep.points, np.eye(4), matcher.surfaces, surfel_map)


@pytest.mark.parametrize("crowd", [0, 5_000])
def test_a_crowd_that_walks_along_does_not_hold_the_sensor(crowd):
    surfel_map, sweep = scene(ALL, crowd)
    standstill = Prediction(0.0, np.eye(4), np.zeros(6), np.diag([0.1] * 3 + [0.3] * 3 + [1.0] * 6) ** 2)
    found = register(sweep, standstill, surfel_map, with_velocity=False)
    np.testing.assert_allclose(found.T_world_lidar[:3, 3], WALKED, atol=0.02)


def test_what_walls_do_not_measure_is_known_as_well_as_it_was_predicted():
    surfel_map, sweep = scene(ALL, 5_000)
    assert inflation(surfel_map, sweep) is not None
    predicted = np.diag([0.1] * 3 + [0.3] * 3 + [1.0] * 6) ** 2
    found = register(sweep, Prediction(0.0, np.eye(4), np.zeros(6), predicted), surfel_map, with_velocity=False)
    np.testing.assert_allclose(found.covariance[6:, 6:], predicted[6:, 6:])


def test_small_surfaces_are_less_certain_where_walls_contradict_the_pose():
    surfel_map, sweep = scene(ALL, 6_000)
    factors = inflation(surfel_map, sweep)
    assert (factors[:1_500] == 1.0).mean() > 0.6  # walls, floor, ceiling
    assert (factors[1_500:] > 1.0).mean() > 0.9  # people


def test_small_surfaces_count_in_full_along_a_bare_corridor():
    assert inflation(*scene(ALONG, 6_000)) is None


def test_small_surfaces_count_in_full_where_walls_agree():
    surfel_map, sweep = scene(ALL, 6_000)
    assert inflation(surfel_map, Sweep(np.concatenate([sweep.points[:1_500] + WALKED, sweep.points[1_500:]]))) is None
