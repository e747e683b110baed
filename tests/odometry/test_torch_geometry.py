"""Logarithm, inverse and quaternions in torch: those of the core, and their gradients."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lidarslam.core import geometry
from lidarslam.odometry.network import torch_geometry as tg

from .motions import torch_exp as exp

HALF_TURN = math.pi - 1e-7
ANGLES = (0.0, 1e-9, 1e-5, 1e-3, 0.0999, 0.1001, 0.4999, 0.5001, 1.0, 2.0, 3.0, 3.1415, HALF_TURN)


def _tangents(angle: float, count: int = 8) -> np.ndarray:
    rng = np.random.default_rng(3)
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.concatenate([angle * axes, rng.normal(size=(count, 3))], axis=1)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_agrees_with_core(angle):
    xi = np.concatenate([_tangents(angle), np.c_[angle * np.eye(3), np.ones((3, 3))]])
    T = exp(torch.tensor(xi))
    tolerance = 1e-8 if angle == HALF_TURN else 1e-11
    np.testing.assert_allclose(tg.log(T).numpy(), xi, rtol=0, atol=tolerance)
    np.testing.assert_allclose(tg.log(T).numpy(), geometry.log(T.numpy()), rtol=0, atol=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 0.6, 2.5])
def test_gradients_are_right(angle):
    xi = torch.tensor(_tangents(angle, 2), requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: tg.turn_about_z(x[:, 2]), (xi,))
    assert torch.autograd.gradcheck(lambda x: tg.log(exp(x)), (xi,))
    T = exp(xi.detach()).requires_grad_()
    assert torch.autograd.gradcheck(tg.inverse, (T,))


def test_inverse_points_and_turns_agree_with_core():
    xi = np.concatenate([_tangents(angle, 1) for angle in ANGLES])
    T, points = geometry.exp(xi), np.random.default_rng(0).normal(size=(len(xi), 5, 3))
    np.testing.assert_allclose(tg.inverse(torch.tensor(T)).numpy(), geometry.inverse(T), atol=1e-14)
    turns = geometry.exp(xi * [0.0, 0.0, 1.0, 0.0, 0.0, 0.0])[:, :3, :3]
    np.testing.assert_allclose(tg.turn_about_z(torch.tensor(xi[:, 2])).numpy(), turns, atol=1e-14)
    moved = tg.transform_points(torch.tensor(T), torch.tensor(points)).numpy()
    np.testing.assert_allclose(moved, geometry.transform_points(T, points), atol=1e-14)
    turned = tg.rotate(torch.tensor(T), torch.tensor(points)).numpy()
    np.testing.assert_allclose(turned, moved - T[:, None, :3, 3], atol=1e-14)


def test_quaternions_agree_with_scipy_and_are_normalised_each_on_its_own():
    q = np.random.default_rng(1).normal(size=(50, 4)) * np.arange(1, 51)[:, None]
    R = tg.rotation_from_quaternion(torch.tensor(q))
    np.testing.assert_allclose(R.numpy(), Rotation.from_quat(q, scalar_first=True).as_matrix(), atol=1e-14)
    back = tg.quaternion_from_rotation(R).numpy()
    unit = q * np.sign(q[:, :1]) / np.linalg.norm(q, axis=1, keepdims=True)
    np.testing.assert_allclose(back, unit, atol=1e-14)


def test_quaternion_of_length_zero_is_the_identity_with_a_finite_gradient():
    q = torch.zeros(1, 4, requires_grad=True)
    R = tg.rotation_from_quaternion(q)
    torch.testing.assert_close(R[0], torch.eye(3))
    (grad,) = torch.autograd.grad(R.sum(), q)
    assert grad.isfinite().all()
