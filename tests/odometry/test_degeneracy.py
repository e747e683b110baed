"""Degenerate directions, and the expected motion along them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.odometry.alignment.alignment import find_degeneracy, joined_information, replaced_along


def information(normals: FloatArray, points: FloatArray) -> FloatArray:
    """(6, 6) of points on planes."""
    J = np.concatenate([np.cross(points, normals), normals], axis=1)
    return J.T @ J


def images(range_m: float = 4.0) -> Any:
    """All points have a normal, this far away; their median range is 4 m."""
    return SimpleNamespace(
        share_with_normal=lambda: 1.0, median_range_m=lambda: 4.0, mean_inverse_square_range=lambda: range_m**-2.0
    )


@pytest.fixture(scope="module")
def corridor() -> FloatArray:
    """Information of points on walls, floor and ceiling along x."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (4000, 3)) * [8.0, 2.0, 1.5]
    axis, side = rng.integers(1, 3, 4000), rng.choice([-1.0, 1.0], 4000)
    points[np.arange(4000), axis] = side * np.array([0.0, 2.0, 1.5])[axis]
    return information(np.eye(3)[axis], points)


def test_a_corridor_is_open_along_it(corridor):
    found = find_degeneracy(corridor, 4000, images())
    assert found.names == ("x",)
    np.testing.assert_allclose(np.abs(found.directions), [[0, 0, 0, 1, 0, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("share", "range_m", "count"), [(0.0005, 4.0, 1), (0.002, 4.0, 0), (0.004, 1.0, 1), (0.004, 5.0, 0)]
)
def test_a_wall_at_the_end_closes_it_when_enough_points_lie_on_it(corridor, share, range_m, count):
    """More than the noise of near normals feigns."""
    end = share * 4000 * information(np.array([[1.0, 0.0, 0.0]]), np.array([[8.0, 0.0, 0.0]]))
    assert len(find_degeneracy(corridor + end, 4000, images(range_m))) == count


@pytest.mark.parametrize(("bare_share", "count"), [(1.0, 1), (0.75, 1), (0.65, 0), (0.0, 0)])
def test_where_much_has_no_normal_nothing_is_left_open_for_all_one_knows(corridor, box_room, bare_share, count):
    sweep = box_room.sweeps(1, [0.0] * 6)[0]
    sweep.normals[..., round(bare_share * sweep.normals.shape[-1]) :] = 0.0
    assert len(find_degeneracy(corridor, 4000, sweep)) == count


def test_a_motion_goes_on_along_open_directions_and_only_there(corridor):
    degeneracy = find_degeneracy(corridor, 4000, images())
    aligned, expected = exp([0.01, 0.0, 0.2, 0.02, -0.1, 0.05]), exp([0.0, 0.1, 0.19, 0.4, 0.3, 0.0])
    motion = replaced_along(aligned, expected, degeneracy)
    change = log(motion @ inverse(aligned))
    np.testing.assert_allclose(change[[0, 1, 2, 4, 5]], 0.0, atol=1e-9)
    assert log(expected @ inverse(motion))[3] == pytest.approx(0.0, abs=0.01)


def test_the_covariance_is_the_expected_one_along_and_the_seen_one_across(corridor):
    expected = np.diag([0.02, 0.02, 0.02, 0.3, 0.3, 0.3]) ** 2
    joined = np.linalg.inv(joined_information(corridor, expected, find_degeneracy(corridor, 4000, images())))
    assert np.sqrt(joined[3, 3]) == pytest.approx(0.3)
    free = [0, 1, 2, 4, 5]
    np.testing.assert_allclose(
        joined[np.ix_(free, free)], np.linalg.inv(corridor[np.ix_(free, free)]), rtol=1e-3, atol=1e-9
    )
