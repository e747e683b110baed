"""The elevation correction against KISS-ICP's own, and against what it means."""

import numpy as np
import pytest

from lidarslam.datasets.mounting import correct_elevation


def _cloud(rng: np.random.Generator, count: int = 20_000) -> np.ndarray:
    return rng.uniform([-80.0, -80.0, -5.0], [80.0, 80.0, 10.0], size=(count, 3))


def test_equals_kiss_icp(rng):
    pybind = pytest.importorskip("kiss_icp.pybind.kiss_icp_pybind")
    points = _cloud(rng)
    expected = np.asarray(pybind._correct_kitti_scan(pybind._Vector3dVector(points)))
    assert np.abs(expected - points).max() > 0.3  # the oracle does something
    np.testing.assert_allclose(correct_elevation(points, 0.205), expected, rtol=0.0, atol=1e-9)


def test_raises_elevation_and_keeps_range_azimuth_and_its_input(rng):
    given = _cloud(rng).astype(np.float32)
    points = given.astype(np.float64)
    raised = correct_elevation(given, 1.5)
    assert raised.dtype == np.float64
    np.testing.assert_array_equal(given, points)
    elevation = [np.rad2deg(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))) for p in (points, raised)]
    np.testing.assert_allclose(elevation[1] - elevation[0], 1.5, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(raised, axis=1), np.linalg.norm(points, axis=1), rtol=1e-12)
    azimuth = [np.arctan2(p[:, 1], p[:, 0]) for p in (points, raised)]
    np.testing.assert_allclose(azimuth[1], azimuth[0], atol=1e-12)


def test_invalid_points_stay_recognisable():
    raised = correct_elevation(np.array([[0.0, 0.0, 0.0], [np.nan, 1.0, 2.0], [np.inf, 1.0, np.inf]]), 0.205)
    np.testing.assert_array_equal(raised[0], 0.0)
    assert not np.isfinite(raised[1:]).all(axis=1).any()
