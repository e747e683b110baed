"""Gauss-Newton steps against LAPACK, and sums in any order."""

import numpy as np
import pytest

from lidarslam.core.compiled import compiled, compiled_sums
from lidarslam.odometry.alignment.steps import gauss_newton_step


def positive(rng: np.random.Generator, size: int, weakest: float = 1.0) -> np.ndarray:
    axes = np.linalg.qr(rng.normal(size=(size, size)))[0]
    return np.ascontiguousarray(axes @ np.diag(np.geomspace(weakest, 1e3, size)) @ axes.T)


@pytest.mark.parametrize("weakest", [1.0, 1e-6])
def test_a_step_solves_the_normal_equations_with_both_priors(weakest: float) -> None:
    rng = np.random.default_rng(0)
    H, g = positive(rng, 12, weakest), rng.normal(size=12)
    information, expected = positive(rng, 6), positive(rng, 6)
    away, innovation = rng.normal(size=6), rng.normal(size=6)
    whole = 55.0 * H + 1e-3 * np.eye(12)
    whole[:6, :6] += information
    whole[6:, 6:] += expected
    gradient = 55.0 * g + np.concatenate([information @ away, expected @ innovation])
    step = gauss_newton_step(H.copy(), g.copy(), 55.0, information, away, expected, innovation)
    np.testing.assert_allclose(step, -np.linalg.solve(whole, gradient), rtol=1e-8, atol=1e-10)


def test_what_is_no_number_gives_no_step() -> None:
    step = gauss_newton_step(np.full((12, 12), np.nan), np.zeros(12), 1.0, *[np.zeros((6, 6)), np.zeros(6)] * 2)
    assert np.isnan(step).all()


@compiled_sums
def _total(values: np.ndarray) -> float:
    total = 0.0
    for value in values:
        total += value
    return total


@compiled
def _total_of(values: np.ndarray) -> float:
    return _total(values)


def test_sums_in_any_order_are_the_same_sums() -> None:
    values = np.random.default_rng(0).normal(size=1000)
    assert _total_of(values) == pytest.approx(values.sum(), rel=1e-12)
