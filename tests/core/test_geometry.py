"""One test a law of SE(3)."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lidarslam.core import geometry as g

# From below the switch to Taylor series to just short of pi, where the logarithm stops being unique.
ANGLES = [0.0, 1e-12, 1e-8, 0.99e-4, 1.01e-4, 1e-3, 0.5, 2.0, 3.0, np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9]

finite = st.floats(-3.0, 3.0, allow_nan=False, width=32)
tangents = arrays(np.float64, 6, elements=finite)
quick = settings(max_examples=60, deadline=None)


def turn(angle: float, seed: int = 0) -> np.ndarray:
    """A tangent vector which turns by the angle about some axis and moves by some metres."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return np.concatenate([angle * axis / np.linalg.norm(axis), rng.normal(0.0, 5.0, 3)])


@pytest.mark.parametrize("angle", [*ANGLES, np.pi, np.pi + 1e-6, 5.0, 100.0])
def test_exp_inverts_log_for_every_angle_and_log_inverts_exp_below_half_a_turn(angle):
    for seed in range(5):
        xi = turn(angle, seed)
        np.testing.assert_allclose(g.exp(g.log(g.exp(xi))), g.exp(xi), atol=1e-9)
        if angle < np.pi:
            np.testing.assert_allclose(g.log(g.exp(xi)), xi, atol=1e-8 if angle > 3.1 else 1e-12)


@pytest.mark.parametrize("angle", [*ANGLES, np.pi, 5.0])
def test_exp_is_the_matrix_exponential(angle):
    for seed in range(5):
        xi, tangent = turn(angle, seed), np.zeros((4, 4))
        tangent[:3, :3], tangent[:3, 3] = g.skew(xi[:3]), xi[3:]
        np.testing.assert_allclose(g.exp(xi), scipy.linalg.expm(tangent), atol=1e-12)


@given(tangents, tangents)
@quick
def test_inverse_is_the_inverse_and_conjugation_moves_the_tangent_vector_by_the_adjoint(xi, other):
    T = g.exp(other)
    np.testing.assert_allclose(g.inverse(T) @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(g.inverse(T), g.exp(-other), atol=1e-12)
    np.testing.assert_allclose(T @ g.exp(xi) @ g.inverse(T), g.exp(g.adjoint(T) @ xi), atol=1e-10)


@given(tangents, tangents)
@quick
def test_transform_points_composes_and_goes_from_b_to_a(xi, other):
    points_c = np.arange(12.0).reshape(4, 3)
    T_a_b, T_b_c = g.exp(xi), g.exp(other)
    in_steps = g.transform_points(T_a_b, g.transform_points(T_b_c, points_c))
    np.testing.assert_allclose(in_steps, g.transform_points(T_a_b @ T_b_c, points_c), atol=1e-11)
    homogeneous = np.column_stack([points_c, np.ones(4)]) @ (T_a_b @ T_b_c).T
    np.testing.assert_allclose(in_steps, homogeneous[:, :3], atol=1e-11)


def test_skew_is_the_cross_product(rng):
    v, w = rng.normal(size=(2, 5, 3))
    np.testing.assert_allclose((g.skew(v) @ w[..., None])[..., 0], np.cross(v, w))


@pytest.mark.parametrize("angle", [*ANGLES, np.pi])
def test_rotation_angle_keeps_its_digits_at_both_ends(angle):
    T = g.exp(turn(angle))
    assert g.rotation_angle(T) == pytest.approx(angle, rel=1e-6, abs=1e-15)
    assert g.rotation_angle(T[:3, :3]) == pytest.approx(angle, rel=1e-6, abs=1e-15)


@given(tangents, st.floats(-2.0, 3.0))
@quick
def test_interpolation_keeps_the_body_velocity(xi, fraction):
    """At 0 and 1 it therefore meets both ends."""
    xi = xi / 2.0  # below half a turn, so that the shorter way round is the one taken
    T_w_a = g.exp(turn(1.0))
    found = g.interpolate(T_w_a, T_w_a @ g.exp(xi), fraction)
    np.testing.assert_allclose(found, T_w_a @ g.exp(fraction * xi), atol=1e-9)


def test_every_function_broadcasts_over_leading_dimensions(rng):
    xi = rng.normal(size=(2, 3, 6))
    T = g.exp(xi)
    points = rng.normal(size=(7, 3))
    assert T.shape == (2, 3, 4, 4)
    assert g.inverse(T).shape == (2, 3, 4, 4)
    assert g.log(T).shape == (2, 3, 6)
    assert g.rotation_angle(T).shape == (2, 3)
    assert g.transform_points(T, points).shape == (2, 3, 7, 3)
    assert g.interpolate(T[0, 0], T, np.full((2, 3), 0.3)).shape == (2, 3, 4, 4)
    assert g.interpolate(T[0, 0], T[0, 1], [0.1, 0.2]).shape == (2, 4, 4)
    assert g.make_transform(np.eye(3), rng.normal(size=(5, 3))).shape == (5, 4, 4)
    assert g.log(np.zeros((0, 4, 4))).shape == (0, 6)
    one_by_one = [[g.transform_points(T[row, column], points) for column in range(3)] for row in range(2)]
    np.testing.assert_allclose(g.transform_points(T, points), one_by_one, atol=1e-14)


@pytest.mark.parametrize("angle", [*ANGLES, np.pi, 5.0])
def test_one_motion_is_as_one_of_many(angle):
    """A single motion goes through numbers, several through arrays."""
    for seed in range(5):
        xi = turn(angle, seed)
        T = g.exp(np.stack([xi, xi]))
        np.testing.assert_allclose(g.exp(xi), T[0], atol=1e-14 * max(1.0, np.abs(T).max()))
        one, several = g.log(T[0]), g.log(T)[1]
        # Half a turn is one to either side.
        np.testing.assert_allclose(g.exp(one), g.exp(several), atol=1e-9)
        if angle < 3.1:
            np.testing.assert_allclose(one, several, atol=1e-12)


@pytest.mark.parametrize(
    "broken",
    [np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.01, 1.0, 1.0, 1.0]), np.diag([1.0, 1.0, 1.0, 2.0]), np.eye(4) * np.nan],
    ids=["mirrored", "scaled", "bottom row", "not a number"],
)
def test_is_rigid_refuses(broken):
    assert g.is_rigid(np.eye(4))
    assert not g.is_rigid(np.stack([np.eye(4), broken]))


def test_orthonormalize_returns_the_nearest_rotation(rng):
    T = g.exp(rng.normal(size=(50, 6)))
    np.testing.assert_allclose(g.orthonormalize(T), T, atol=1e-14)
    rounded = np.round(T, 4)
    mended = g.orthonormalize(rounded)
    assert g.is_rigid(mended, 1e-12)
    np.testing.assert_allclose(mended, T, atol=2e-4)
    distance = np.linalg.norm(mended - rounded, axis=(1, 2))
    assert (distance <= np.linalg.norm(T - rounded, axis=(1, 2)) + 1e-12).all()


def test_displacement_bounds_how_far_points_move_and_is_reached(rng):
    xi = np.array([0.0, 0.0, 1e-4, 0.0, 0.02, 0.0])  # turning about z, moving the way the turn takes points on x
    directions = rng.normal(size=(200, 3))
    points = 7.0 * np.vstack([directions / np.linalg.norm(directions, axis=1)[:, None], [[1.0, 0.0, 0.0]]])
    moved_m = np.linalg.norm(g.transform_points(g.exp(xi), points) - points, axis=1)
    assert g.displacement_m(xi, 7.0) == pytest.approx(0.0207)
    assert moved_m.max() == pytest.approx(0.0207, rel=1e-6)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.48, -0.6, -0.64), (0.0, 0.0, -1.0)])
def test_levelling_turns_up_to_z(up):
    R = g.levelling(np.array(up))
    np.testing.assert_allclose(R @ np.array(up), [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert g.rotation_angle(R) == pytest.approx(np.arccos(up[2]), abs=1e-7)
