"""Residuals of points on planes: their derivatives, their weights, and scenes that leave known ways of moving open."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, transform_points
from lidarslam.core.tracking import Degeneracy
from lidarslam.mapping.registration.gauss_newton import find_degeneracy, geman_mcclure, point_to_plane_jacobian

Scene = tuple[FloatArray, FloatArray]


def test_the_jacobian_is_the_derivative_with_a_motion_from_the_right(rng):
    points, normals = rng.normal(size=(2, 20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    J, step = point_to_plane_jacobian(points, normals), 1e-6
    for axis in range(6):
        ahead, behind = (transform_points(exp(sign * step * np.eye(6)[axis]), points) for sign in (1.0, -1.0))
        numeric = np.einsum("ij,ij->i", ahead - behind, normals) / (2.0 * step)
        np.testing.assert_allclose(J[:, axis], numeric, atol=1e-8)


def test_weights_are_the_information_nearby_and_vanish_far_away():
    weights = geman_mcclure(np.array([0.0, 0.1, 10.0]), 0.1**2, 0.02**2)
    assert weights[0] == pytest.approx(1.0 / 0.02**2)
    assert weights[1] == pytest.approx(0.25 / 0.02**2)
    assert weights[2] < 1e-6 * weights[0]


def wall(rng: np.random.Generator, axis: int, at: float, reach: tuple[float, float, float], count: int = 500) -> Scene:
    """Points (N, 3) on a wall across an axis, and their normals."""
    points = rng.uniform(-1.0, 1.0, (count, 3)) * reach
    points[:, axis] = at
    return points, np.tile(np.eye(3)[axis], (count, 1))


def joined(*scenes: Scene) -> Scene:
    return np.concatenate([points for points, _ in scenes]), np.concatenate([normals for _, normals in scenes])


def corridor(rng: np.random.Generator, count: int = 500) -> Scene:
    reach = (10.0, 1.2, 1.3)
    return joined(*[wall(rng, axis, sign * reach[axis], reach, count) for axis in (1, 2) for sign in (-1, 1)])


def closed_room(rng: np.random.Generator) -> Scene:
    reach = (5.0, 4.0, 1.5)
    return joined(*[wall(rng, axis, sign * reach[axis], reach) for axis in range(3) for sign in (-1, 1)])


def round_tunnel(rng: np.random.Generator) -> Scene:
    angle = rng.uniform(-np.pi, np.pi, 2_000)
    normals = np.column_stack([np.zeros(2_000), np.cos(angle), np.sin(angle)])
    return 3.0 * normals + np.column_stack([rng.uniform(-15, 15, 2_000), np.zeros((2_000, 2))]), normals


def find(scene: Scene, tilt: float = 0.0, weight: float = 1.0) -> Degeneracy:
    count = len(scene[0])
    lever_m = float(np.sqrt((scene[0] ** 2).sum(axis=1).mean()))
    return find_degeneracy(point_to_plane_jacobian(*scene), np.full(count, weight), np.full(count, tilt), lever_m)


def tilted(rng: np.random.Generator, scene: Scene, sigma: float) -> Scene:
    normals = scene[1] + rng.normal(0.0, sigma, scene[1].shape)
    return scene[0], normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("tilt", [0.0, 0.02, 0.05])
def test_a_corridor_leaves_its_own_direction_open_however_noisy(rng, tilt):
    found = find(tilted(rng, corridor(rng), tilt), tilt)
    assert found.names == ("x",)
    assert abs(found.directions[0, 3]) > 0.99
    closed = joined(corridor(rng), wall(rng, 0, 9.0, (9.0, 1.2, 1.3), 40))
    weights = np.ones(len(closed[0]))
    assert len(find(closed)) == 0
    weights[2_000:] = 0.0
    assert find_degeneracy(point_to_plane_jacobian(*closed), weights, np.zeros(len(weights)), 6.0).names == ("x",)


@pytest.mark.parametrize("tilt", [0.0, 0.02])
def test_a_closed_room_leaves_nothing_open(rng, tilt):
    assert len(find(tilted(rng, closed_room(rng), tilt), tilt)) == 0


def test_a_round_tunnel_leaves_x_and_roll_open(rng):
    assert sorted(find(round_tunnel(rng)).names) == ["roll", "x"]


@pytest.mark.parametrize("seed", range(3))
def test_a_plane_leaves_x_y_and_yaw_open(seed):
    field = wall(np.random.default_rng(seed), 2, -1.5, (20.0, 20.0, 0.0), 2_000)
    assert sorted(find(field).names) == ["x", "y", "yaw"]


def test_each_open_direction_has_a_name_of_its_own():
    """Any basis of the same directions may come out of the eigenvalue problem."""
    half = 0.5**0.5
    directions = np.zeros((2, 6))
    directions[0, [3, 4]] = half * np.array([1.0 + 1e-9, 1.0])
    directions[1, [3, 4]] = half * np.array([1.0 + 1e-9, -1.0])
    assert sorted(Degeneracy(directions, 5.0).names) == ["x", "y"]


@pytest.mark.parametrize("weight", [1e-6, 1e6])
def test_the_unit_of_the_weights_does_not_matter(rng, weight):
    scene = tilted(rng, corridor(rng), 0.02)
    np.testing.assert_allclose(find(scene, 0.02, weight).projector(), find(scene, 0.02).projector(), atol=1e-9)


@pytest.mark.parametrize("metres", [0.05, 30.0])
def test_the_size_of_the_scene_does_not_matter(rng, metres):
    for scene in (corridor(rng), closed_room(rng), round_tunnel(rng)):
        assert len(find((metres * scene[0], scene[1]))) == len(find(scene))


def test_without_any_match_everything_is_open():
    found = find_degeneracy(np.zeros((0, 6)), np.zeros(0), np.zeros(0), 5.0)
    assert set(found.names) == {"roll", "pitch", "yaw", "x", "y", "z"}


def test_the_projector_measures_a_motion_along_the_open_directions_in_metres(rng):
    found = find(round_tunnel(rng))
    P = found.projector()
    turn, shift, closed = np.zeros((3, 6))
    turn[0], shift[3], closed[[1, 2, 4, 5]] = 0.1, 0.2, 1.0
    assert turn @ P @ turn == pytest.approx((found.lever_m * 0.1) ** 2, rel=1e-3)
    assert shift @ P @ shift == pytest.approx(0.2**2, rel=1e-3)
    assert closed @ P @ closed == pytest.approx(0.0, abs=0.01 * found.lever_m**2)
