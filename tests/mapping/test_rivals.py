"""Fins along a corridor, at equal distances: without a measured motion, a scan fits at the next fin as well."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import MotionState, Prediction, Prior
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.budget import Budget
from lidarslam.mapping.tracking.mapped_scan import Attempt, judge
from lidarslam.mapping.tracking.near_search import NearSearch
from lidarslam.mapping.tracking.scan_matcher import ScanMatcher
from lidarslam.mapping.tracking.tracking_state import TrackingState

CELL_M, SPACING_M = 0.05, 0.6
HERE = np.eye(4)


def corridor(rng: np.random.Generator, count: int) -> FloatArray:
    """Points (N, 3) on walls, floor and fins."""
    points, kind = rng.uniform(-2.0, 2.0, (count, 3)), rng.random(count)
    on_fin, on_wall, on_floor = kind < 0.4, (kind > 0.4) & (kind < 0.8), kind > 0.8
    points[:, 0] *= 1.5
    points[on_fin, 0] = SPACING_M * rng.integers(-5, 6, on_fin.sum())
    points[on_fin, 1] = np.sign(points[on_fin, 1]) * rng.uniform(1.6, 2.0, on_fin.sum())
    points[on_wall, 1] = 2.0 * np.sign(points[on_wall, 1])
    points[on_floor, 2] = -2.0
    return points + rng.normal(0.0, 0.01, points.shape)


@pytest.fixture(scope="module")
def matcher() -> ScanMatcher:
    """Of a scan at rest, half a second after the last, in a map of eight."""
    rng, surfel_map = np.random.default_rng(0), SurfelMap(CELL_M, 20.0)
    for _ in range(8):
        surfel_map.insert(corridor(rng, 6000), rng.uniform(-0.2, 0.2, 6000), np.zeros(3))
    points = corridor(rng, 2500)
    scan = SampledScan(1.5, CELL_M, 2.0, Sweep(points), rng.uniform(-0.2, 0.2, 2500), Sweep(points))
    return ScanMatcher(
        scan, MotionState(1.0, HERE, np.zeros(6), 1e-6 * np.eye(12)), surfel_map, MappingConfig(), Budget()
    )


def searched(matcher: ScanMatcher, prior: Prior, sigma_m: float) -> Attempt:
    variances = np.array([0.01**2] * 3 + [sigma_m**2, 0.04**2, 0.04**2] + [0.1**2] * 6)
    near = matcher.register(Prediction(1.5, HERE, np.zeros(6), np.diag(variances)), coarse_first=False)
    state = replace(TrackingState(), velocity_known=True)
    return NearSearch(matcher, state, prior, near.prediction).at_any_speed(near)


def test_the_next_fin_is_a_rival(matcher):
    found = searched(matcher, Prior(), 0.5)
    np.testing.assert_allclose(found.T_world_lidar[:3, 3], 0.0, atol=0.005)
    assert abs(found.rival[0]) == pytest.approx(SPACING_M, abs=0.02)
    np.testing.assert_allclose(found.rival[1:], 0.0, atol=0.02)
    assert found.unconstrained == ("x",)
    status, message = judge(found, False, False, False, None, MappingConfig().tracking)
    assert (status, message[:24]) == (Status.DEGRADED, "the scene is repetitive:")


@pytest.mark.parametrize(("prior", "sigma_m"), [(Prior(HERE), 0.5), (Prior(), 0.1)], ids=["measured", "predicted"])
def test_a_motion_that_is_known_has_no_rival(matcher, prior, sigma_m):
    found = searched(matcher, prior, sigma_m)
    assert found.rival is None
    assert found.unconstrained == ()
