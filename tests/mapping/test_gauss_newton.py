"""Jacobian and weights of point-to-plane residuals, against finite differences and their definitions."""

import numpy as np
import pytest

from lidarslam.core.geometry import exp, transform_points
from lidarslam.mapping.registration.gauss_newton import geman_mcclure, point_to_plane_jacobian


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
