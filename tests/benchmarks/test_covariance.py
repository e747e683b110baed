"""NEES of errors that were drawn from the covariance is chi-square."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from covariance import EXPECTED_SHARES, nees_of_poses, nees_of_registration, shares_within_sigmas

from lidarslam.core.geometry import FloatArray, exp

SCANS = 3000
SIGMAS = np.array([0.002, 0.004, 0.001, 0.05, 0.02, 0.01])


@pytest.fixture(name="truth", scope="module")
def _truth() -> FloatArray:
    rng = np.random.default_rng(1)
    return exp(np.concatenate([rng.normal(size=(SCANS, 3)), 10.0 * rng.normal(size=(SCANS, 3))], axis=1))


def _results(truth: FloatArray, sigmas: FloatArray) -> Any:
    errors = np.random.default_rng(2).normal(size=(SCANS, 6)) * sigmas
    errors[0] = 0.0  # the world begins at the first pose
    poses = truth @ exp(-errors)
    return [SimpleNamespace(T_world_lidar=pose, covariance=np.diag(SIGMAS**2)) for pose in poses]


@pytest.mark.parametrize("nees_of", [nees_of_poses, nees_of_registration])
def test_errors_drawn_from_the_covariance_lie_within_as_many_sigmas_as_they_should(nees_of: Any, truth: Any) -> None:
    shares = shares_within_sigmas(nees_of(_results(truth, SIGMAS), truth))
    np.testing.assert_allclose(shares, EXPECTED_SHARES, atol=0.03)


@pytest.mark.parametrize("nees_of", [nees_of_poses, nees_of_registration])
def test_errors_twice_as_large_show(nees_of: Any, truth: Any) -> None:
    assert np.median(nees_of(_results(truth, 2.0 * SIGMAS), truth)) / 6.0 == pytest.approx(4 * 0.891, rel=0.1)


def test_a_pose_without_covariance_has_no_nees(truth: Any) -> None:
    results = _results(truth, SIGMAS)
    results[5].covariance = None
    assert np.flatnonzero(np.isnan(nees_of_registration(results, truth))).tolist() == [4, 5]
