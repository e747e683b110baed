"""Closed lines: lengths, offsets and arcs with known answers; the free space cut out of what grows."""

import numpy as np
import pytest

from lidarslam.simulation.world import Route
from lidarslam.simulation.worlds import paths
from lidarslam.simulation.worlds.building import Builder

RECTANGLE = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 10.0], [0.0, 10.0]])


def test_resampled_points_are_evenly_spaced_and_subdividing_keeps_the_corners_and_the_line():
    points = paths.resample_loop(RECTANGLE, 0.5)
    np.testing.assert_allclose(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1), 0.5)
    assert paths.loop_length(RECTANGLE) == 60.0
    points = paths.subdivide_loop(RECTANGLE, 3.0)
    assert np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).max() <= 3.0
    assert paths.loop_length(points) == pytest.approx(60.0)
    assert all((points == corner).all(axis=1).any() for corner in RECTANGLE)


def test_the_right_of_a_counter_clockwise_line_is_outside_and_distance_is_to_the_line_not_to_its_corners():
    np.testing.assert_allclose(paths.offset_loop(RECTANGLE, 2.0), [[-2, -2], [22, -2], [22, 12], [-2, 12]])
    np.testing.assert_allclose(paths.offset_loop(RECTANGLE[::-1], 2.0)[0], [2.0, 8.0])
    distance = paths.distance_to_loop(np.array([[10.0, 5.0], [10.03, -3.0], [25.0, 5.0]]), RECTANGLE)
    np.testing.assert_allclose(distance, [5.0, 3.0, 5.0], atol=0.01)


def test_rounded_corners_are_arcs_of_their_radii():
    radii = np.array([1.0, 2.0, 3.0, 4.0])
    points = paths.round_corners(RECTANGLE, radii, 0.05)
    assert paths.loop_length(points) == pytest.approx(60.0 - (2.0 - 0.5 * np.pi) * radii.sum(), abs=0.01)
    near = points[(points[:, 0] > 17.0) & (points[:, 1] > 7.0)]
    np.testing.assert_allclose(np.linalg.norm(near - [17.0, 7.0], axis=1), 3.0)


@pytest.mark.parametrize("seed", range(2))
def test_winding_loops_have_their_length_and_no_tight_bend(seed):
    loop = paths.winding_loop(np.random.default_rng(seed), 200.0, 6, 0.6, 4.0)
    assert paths.loop_length(loop) == pytest.approx(200.0, rel=0.01)
    ahead = np.roll(loop, -1, axis=0) - loop
    turn = np.angle(np.exp(1j * np.diff(np.arctan2(ahead[:, 1], ahead[:, 0]))))
    assert np.abs(turn).max() < 1.1 * 0.5 / 4.0
    assert np.abs(turn).std() > 0.01  # not a circle


def test_pruning_cuts_what_hangs_into_the_way_and_nothing_else():
    route = Route(np.column_stack([RECTANGLE, np.zeros(4)]), 1.0, 1.0, 2.5, 1.0)
    part = Builder()
    for x, y, z in ((10.0, 0.5, 1.0), (10.0, 0.5, 4.0), (10.0, 3.0, 1.0)):
        part.box((x, y, z), (0.4, 0.4, 0.4))
    part.cylinder(np.array([10.0, 4.0, 1.0]), np.array([10.0, 0.5, 2.0]), 0.05)
    part.cylinder(np.array([10.0, 4.0, 3.0]), np.array([10.0, 0.5, 4.0]), 0.05)
    kept = paths.prune(part, route)
    np.testing.assert_allclose(kept.boxes.centres[:, 1:], [[0.5, 4.0], [3.0, 1.0]])
    np.testing.assert_allclose(kept.solids[1].starts[:, 2], [3.0])
    assert len(paths.prune(Builder(), route).boxes) == 0
