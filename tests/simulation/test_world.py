"""The vocabulary of worlds: what is refused, heights between grid points, things that move."""

import numpy as np
import pytest

from lidarslam.core.geometry import is_rigid
from lidarslam.simulation.world import Boxes, HeightField, Mover

UNIT_BOX = Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.eye(3)[None])


def test_a_plane_has_its_height_everywhere(rng):
    x, y = np.meshgrid(np.arange(6), np.arange(4), indexing="ij")
    field = HeightField(np.array([10.0, -2.0]), 0.5, 3.0 + 0.2 * x - 0.7 * y)
    xy = field.origin_xy + rng.uniform(0.0, [2.5, 1.5], (200, 2))
    expected = 3.0 + (0.2 * (xy[:, 0] - 10.0) - 0.7 * (xy[:, 1] + 2.0)) / 0.5
    np.testing.assert_allclose(field.height_at(xy), expected, atol=1e-12)


def test_outside_its_grid_a_field_goes_on_level():
    field = HeightField(np.zeros(2), 1.0, np.array([[0.0, 1.0], [2.0, 3.0]]))
    np.testing.assert_allclose(field.height_at(np.array([[-5.0, -5.0], [9.0, 9.0], [9.0, 0.0]])), [0.0, 3.0, 2.0])


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
