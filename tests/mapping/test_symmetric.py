"""Closed-form eigenvalues and vectors against LAPACK's."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels.symmetric import SYMMETRIC, write_eigenvalues, write_eigenvector


def eigenvalues(M: FloatArray) -> FloatArray:
    values = np.full((len(M), 3), np.nan)
    for matrix, written in zip(M, values, strict=True):
        write_eigenvalues(matrix, written)
    return values


def eigenvectors(M: FloatArray, values: FloatArray) -> FloatArray:
    vectors = np.full((len(M), 3), np.nan)
    for matrix, value, written in zip(M, values, vectors, strict=True):
        write_eigenvector(matrix, value, written)
    return vectors


def entries(M: FloatArray) -> FloatArray:
    return np.stack([M[:, i, j] for i, j in SYMMETRIC], axis=1)


def with_spectrum(rng: np.random.Generator, values: list[float], count: int = 300) -> FloatArray:
    Q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    M = Q @ (np.array(values)[:, None] * np.swapaxes(Q, 1, 2))
    return np.asarray(0.5 * (M + np.swapaxes(M, 1, 2)))


@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1.0, 1e6])
def test_values_of_random_matrices_of_any_size(rng, scale):
    A = rng.normal(size=(1000, 3, 3))
    M = scale * (A + np.swapaxes(A, 1, 2))
    np.testing.assert_allclose(eigenvalues(entries(M)), np.linalg.eigvalsh(M), rtol=0.0, atol=1e-7 * scale)


@pytest.mark.parametrize(
    "spectrum",
    [[0, 0, 0], [1, 1, 1], [0, 1, 1], [0, 0, 1], [1, 1, 3], [-2, -2, 5], [0, 1e-9, 1]],
    ids=["zero", "ball", "disc", "needle", "long", "indefinite", "noisy needle"],
)
def test_values_of_special_spectra(rng, spectrum):
    values = eigenvalues(entries(with_spectrum(rng, spectrum)))
    np.testing.assert_allclose(values, np.tile(spectrum, (len(values), 1)), rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_vectors_are_lapacks_up_to_their_sign(rng, which, scale):
    M = scale * with_spectrum(rng, [0.2, 1.0, 3.0])
    vectors = eigenvectors(entries(M), eigenvalues(entries(M))[:, which])
    expected = np.linalg.eigh(M)[1][:, :, which]
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", vectors, expected)), 1.0, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("spectrum", "which"), [([0.0, 1.0, 1.0], 0), ([0.0, 0.0, 1.0], 2), ([0.0, 1e-4, 1.0], 0)])
def test_vectors_of_simple_values_beside_repeated_ones(rng, spectrum, which):
    """A disc's normal, a needle's direction, the normal of a narrow strip."""
    M = with_spectrum(rng, spectrum)
    vectors = eigenvectors(entries(M), eigenvalues(entries(M))[:, which])
    residual = np.einsum("nij,nj->ni", M, vectors) - spectrum[which] * vectors
    assert np.abs(residual).max() < 1e-7
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("value", [0.0, 2.0])
def test_where_every_direction_is_one_a_unit_vector_is_given(value):
    M = value * np.eye(3)[None]
    vectors = eigenvectors(entries(M), np.array([value]))
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=0.0, atol=1e-12)
