"""Motions within compiled loops are those of `lidarslam.core.geometry`."""

import numpy as np
import pytest

from lidarslam.core.compiled import compiled
from lidarslam.core.compiled_motion import orthonormalize_nearly, write_exp, write_inverse, write_log, write_product
from lidarslam.core.geometry import FloatArray, exp, inverse, log


@compiled
def _all(
    xi: FloatArray, T: FloatArray, moved: FloatArray, product: FloatArray, inverted: FloatArray, back: FloatArray
) -> None:  # fmt: skip
    write_exp(xi, moved)
    write_product(T, moved, product)
    write_inverse(product, inverted)
    write_log(product, back)


@compiled
def _orthonormalized(T: FloatArray) -> FloatArray:
    rigid = T.copy()
    orthonormalize_nearly(rigid)
    return rigid


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 3.0])
def test_motions_equal_those_of_arrays(rng, size):
    xi, T = size * rng.uniform(-0.5, 0.5, 6), exp(rng.uniform(-1.0, 1.0, 6))
    moved, product, inverted, back = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4)), np.empty(6)
    _all(xi, T, moved, product, inverted, back)
    np.testing.assert_allclose(moved, exp(xi), atol=1e-14)
    np.testing.assert_allclose(product, T @ exp(xi), atol=1e-14)
    np.testing.assert_allclose(inverted, inverse(T @ exp(xi)), atol=1e-14)
    np.testing.assert_allclose(back, log(T @ exp(xi)), atol=1e-12)


def test_rounding_is_taken_off_a_rotation(rng):
    T = exp(rng.uniform(-1.0, 1.0, 6))
    rounded = T.copy()
    rounded[:3, :3] += rng.uniform(-1e-7, 1e-7, (3, 3))
    R = _orthonormalized(rounded)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R, T[:3, :3], atol=2e-7)
