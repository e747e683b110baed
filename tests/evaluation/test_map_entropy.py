"""Crispness of clouds whose covariance is known."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.map.entropy import map_entropy


def _slab(rng: np.random.Generator, sigma_m: float) -> FloatArray:
    points = rng.uniform(-2.0, 2.0, (40_000, 3))
    points[:, 2] = rng.normal(0.0, sigma_m, len(points))
    return points


def test_the_entropy_of_a_known_neighbourhood(rng: np.random.Generator) -> None:
    """In a filled ball of radius r, every coordinate has the variance r^2 / 5."""
    points = rng.uniform(-1.0, 1.0, (60_000, 3))
    inner = points[np.linalg.norm(points, axis=1) < 0.9]
    entropy = map_entropy(inner, radius_m=0.3, spacing_m=0.001, most_samples=2_000)
    assert entropy is not None
    # Some samples are at the border, where the neighbourhood is part of a ball and smaller.
    assert entropy.mean == pytest.approx(1.5 * np.log(2.0 * np.pi * np.e * 0.3**2 / 5.0), abs=0.3)


def test_a_thicker_wall_has_more(rng: np.random.Generator) -> None:
    crisp, thick = map_entropy(_slab(rng, 0.01)), map_entropy(_slab(rng, 0.04))
    assert crisp is not None
    assert thick is not None
    # Only the third axis differs; thinning lets through more of the thicker wall's outer points.
    assert thick.mean - crisp.mean == pytest.approx(np.log(4.0), abs=0.2)


def test_a_flawless_plane_is_finite_and_the_place_does_not_matter(rng: np.random.Generator) -> None:
    x, y = np.meshgrid(0.07 * np.arange(60), 0.07 * np.arange(60))
    plane = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    here, there = map_entropy(plane), map_entropy(plane + np.array([5e5, 5e6, 100.0]))
    assert here is not None
    assert there is not None
    assert np.isfinite(here.mean)
    assert there.mean == pytest.approx(here.mean, abs=1e-3)


def test_chunks_and_samples_change_little(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    points = _slab(rng, 0.02)
    whole, sampled = map_entropy(points), map_entropy(points, most_samples=500)
    monkeypatch.setattr("lidarslam.evaluation.map.entropy._CHUNK", 1_000)
    chunked = map_entropy(points)
    assert whole is not None
    assert sampled is not None
    assert chunked is not None
    assert chunked.mean == pytest.approx(whole.mean, abs=1e-12)
    assert sampled.mean == pytest.approx(whole.mean, abs=0.05)
    assert sampled.points <= 500


def test_sparse_points_have_none() -> None:
    assert map_entropy(10.0 * np.arange(60.0).reshape(-1, 3)) is None
    assert map_entropy(np.empty((0, 3))) is None
