"""The vocabulary of worlds: what is refused, heights between grid points, things that move."""

import numpy as np
import pytest

from lidarslam.core.geometry import is_rigid
from lidarslam.simulation.world import Boxes, Cylinders, HeightField, Mover, Route, World

UNIT_BOX = Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.eye(3)[None])


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Boxes(np.zeros((2, 3)), np.ones((1, 3)), np.eye(3)[None]), r"half_sizes must be \(2, 3\)"),
        (lambda: Boxes(np.zeros((1, 3)), np.zeros((1, 3)), np.eye(3)[None]), "must be positive"),
        (lambda: Cylinders(np.zeros((1, 3)), np.ones((1, 3)), np.ones(2)), r"radii must be \(1,\)"),
        (lambda: Cylinders(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1)), "positive radii and lengths"),
        (lambda: HeightField(np.zeros(2), 1.0, np.full((2, 2), np.nan)), "finite grid"),
        (lambda: HeightField(np.zeros(2), 0.0, np.zeros((2, 2))), "cell_m must be positive"),
        (lambda: Mover(UNIT_BOX, np.zeros((4, 2)), 1.0, 0.0), r"waypoints must be \(4, 3\)"),
        (lambda: Route(np.zeros((2, 3)), 1.0, 1.0, 2.0, 1.0), "three corners or more, got 2"),
    ],
)
def test_what_cannot_be_is_refused(make, told):
    with pytest.raises(ValueError, match=told):
        make()


def test_a_plane_has_its_height_everywhere(rng):
    x, y = np.meshgrid(np.arange(6), np.arange(4), indexing="ij")
    field = HeightField(np.array([10.0, -2.0]), 0.5, 3.0 + 0.2 * x - 0.7 * y)
    xy = field.origin_xy + rng.uniform(0.0, [2.5, 1.5], (200, 2))
    expected = 3.0 + (0.2 * (xy[:, 0] - 10.0) - 0.7 * (xy[:, 1] + 2.0)) / 0.5
    np.testing.assert_allclose(field.height_at(xy), expected, atol=1e-12)


def test_cells_are_split_from_the_lowest_to_the_highest_corner():
    field = HeightField(np.zeros(2), 1.0, np.array([[0.0, 0.0], [1.0, 0.0]]))
    np.testing.assert_allclose(field.height_at(np.array([[0.5, 0.5], [0.75, 0.25], [0.25, 0.75]])), [0.0, 0.5, 0.0])


def test_outside_its_grid_a_field_goes_on_level():
    field = HeightField(np.zeros(2), 1.0, np.array([[0.0, 1.0], [2.0, 3.0]]))
    np.testing.assert_allclose(field.height_at(np.array([[-5.0, -5.0], [9.0, 9.0], [9.0, 0.0]])), [0.0, 3.0, 2.0])


def test_ground_is_the_first_field_or_zero():
    route = Route(np.eye(3), 1.0, 1.0, 2.0, 1.0)
    low, high = (HeightField(np.zeros(2), 1.0, np.full((2, 2), z)) for z in (4.0, 9.0))
    at = np.array([[0.3, 0.4]])
    assert World("bare", 0, route).ground_at(at) == [0.0]
    assert World("tunnel", 0, route, height_fields=(low, high)).ground_at(at) == [4.0]


@pytest.fixture
def mover() -> Mover:
    """Round a rectangle of 10 m by 5 m on a slope, counter-clockwise."""
    corners = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 1.0], [10.0, 5.0, 1.0], [0.0, 5.0, 0.0]])
    return Mover(UNIT_BOX, corners, 2.0, 3.0)


def test_a_mover_comes_back_after_a_round(mover):
    steps = np.diff(np.concatenate([mover.waypoints, mover.waypoints[:1]]), axis=0)
    period = np.linalg.norm(steps, axis=1).sum() / mover.speed_mps
    times = np.linspace(0.0, period, 50)
    np.testing.assert_allclose(mover.pose_at(times + 3.0 * period), mover.pose_at(times), atol=1e-9)


def test_a_mover_is_never_in_two_places(mover):
    times = np.linspace(0.0, 40.0, 40001)
    poses = mover.pose_at(times)
    assert is_rigid(poses)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() <= mover.speed_mps * 0.001 * (1.0 + 1e-6)
    np.testing.assert_allclose(np.median(steps), mover.speed_mps * 0.001)


def test_a_mover_looks_where_it_goes(mover):
    poses = mover.pose_at(np.array([0.0, 4.5, 7.5]))
    np.testing.assert_allclose(poses[0, :3, 3], 3.0 / np.sqrt(101.0) * np.array([10.0, 0.0, 1.0]))
    np.testing.assert_allclose(poses[:, :2, 0], [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, 2], np.broadcast_to([0.0, 0.0, 1.0], (3, 3)))


def test_a_mover_with_one_point_stands():
    poses = Mover(UNIT_BOX, np.array([[1.0, 2.0, 3.0]]), 5.0, 7.0).pose_at(np.array([0.0, 11.0]))
    np.testing.assert_array_equal(poses[:, :3, 3], [[1.0, 2.0, 3.0]] * 2)
    np.testing.assert_array_equal(poses[:, :3, :3], [np.eye(3)] * 2)
