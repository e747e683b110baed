"""Gauss-Newton steps against LAPACK, and sums in any order."""

import numpy as np
import pytest

from lidarslam.core.geometry import exp, inverse, log
from lidarslam.odometry.alignment.steps import take_step, write_velocities


def positive(rng: np.random.Generator, size: int, weakest: float = 1.0) -> np.ndarray:
    axes = np.linalg.qr(rng.normal(size=(size, size)))[0]
    return np.ascontiguousarray(axes @ np.diag(np.geomspace(weakest, 1e3, size)) @ axes.T)


@pytest.mark.parametrize("weakest", [1.0, 1e-6])
@pytest.mark.parametrize("size", [0.01, 30.0])
def test_a_step_solves_the_normal_equations_with_both_priors(weakest: float, size: float) -> None:
    rng = np.random.default_rng(0)
    H, g = positive(rng, 12, weakest), size * rng.normal(size=12)
    information, expected = positive(rng, 6), positive(rng, 6)
    T, T_prior, innovation = exp(0.3 * rng.normal(size=6)), exp(0.3 * rng.normal(size=6)), size * rng.normal(size=6)
    whole = H + 1e-3 * np.eye(12)
    whole[:6, :6] += information
    whole[6:, 6:] += expected
    away = log(T @ inverse(T_prior))
    delta = -np.linalg.solve(whole, g + np.concatenate([information @ away, expected @ innovation]))
    step = delta[:6] * min(1.0, 0.3 / np.abs(delta[:6]).max())
    moved, changed = T.copy(), innovation.copy()
    largest = take_step(moved, changed, H, g, inverse(T_prior), information, expected)
    np.testing.assert_allclose(moved, exp(step) @ T, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(changed, innovation + delta[6:], rtol=1e-8, atol=1e-10)
    assert largest == pytest.approx(np.abs(step).max(), rel=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 2.0, 3.14])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (0.6, 0.0, 0.8)])
def test_velocities_are_the_logarithm_and_a_change(angle: float, axis: tuple[float, float, float]) -> None:
    xi = np.array([*(angle * np.array(axis)), 1.0, -2.0, 0.5])
    innovation, last = np.arange(6.0), np.ones(6)
    early, late = np.empty(6), np.empty(6)
    write_velocities(exp(xi), innovation, 0.1, 0.5, last, early, late)
    change = innovation + 0.5 * (10.0 * xi - last)
    np.testing.assert_allclose(early, 10.0 * xi - change, atol=1e-7)
    np.testing.assert_allclose(late, 10.0 * xi + change, atol=1e-7)
