"""Shelves that look alike at every other height, as steps do: the odometry's motion tells which of them it is."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import MotionState, Prediction, Prior
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.budget import Budget
from lidarslam.mapping.tracking.mapped_scan import Attempt
from lidarslam.mapping.tracking.near_search import NearSearch
from lidarslam.mapping.tracking.scan_matcher import ScanMatcher
from lidarslam.mapping.tracking.tracking_state import TrackingState

CELL_M, SPACING_M = 0.05, 0.2
HERE = np.eye(4)
VARIANCES = np.array([0.01**2] * 3 + [0.04**2, 0.04**2, 0.25**2] + [0.1**2] * 6)


def shelves(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
    """Points (N, 3) on shelves along a wall, three walls and a floor, and elevations (N,) of no rings."""
    unit, kind = rng.uniform(-1.0, 1.0, (count, 3)), rng.random(count)
    points = 2.0 * unit
    on_shelf, on_floor = kind < 0.3, (kind > 0.3) & (kind < 0.33)
    behind, beside = (kind > 0.33) & (kind < 0.7), kind > 0.7
    points[on_shelf, 0] = 2.0 + 0.3 * unit[on_shelf, 0]
    points[on_shelf, 2] = SPACING_M * rng.integers(-9, 10, on_shelf.sum())
    points[on_floor, 2] = -2.3
    points[behind, 0], points[beside, 1] = -2.0, np.sign(unit[beside, 1]) * 2.0
    return points + rng.normal(0.0, 0.01, points.shape), rng.uniform(-0.2, 0.2, count)


@pytest.fixture(scope="module")
def matcher() -> ScanMatcher:
    """Of a scan at rest in a map of eight."""
    rng, surfel_map = np.random.default_rng(0), SurfelMap(CELL_M, 20.0)
    for _ in range(8):
        surfel_map.insert(*shelves(rng, 6000), np.zeros(3))
    points, elevations = shelves(rng, 2500)
    scan = SampledScan(1.1, CELL_M, 2.0, Sweep(points), elevations, Sweep(points))
    last = MotionState(1.0, HERE, np.zeros(6), 1e-6 * np.eye(12))
    return ScanMatcher(scan, last, surfel_map, MappingConfig(), Budget())


def from_odometry(matcher: ScanMatcher, near: Attempt, prior: Prior) -> Attempt:
    return NearSearch(matcher, TrackingState(), prior, near.prediction).from_odometry(near)


def test_the_odometrys_motion_is_tried_where_the_prediction_is_uncertain(matcher):
    predicted = HERE.copy()
    predicted[2, 3] = -1.5 * SPACING_M
    near = matcher.register(Prediction(1.1, predicted, np.zeros(6), np.diag(VARIANCES)), coarse_first=False)
    assert near.T_world_lidar[2, 3] == pytest.approx(-SPACING_M, abs=0.01)
    best = from_odometry(matcher, near, Prior(HERE))
    np.testing.assert_allclose(best.T_world_lidar[:3, 3], 0.0, atol=0.005)
    assert from_odometry(matcher, near, Prior()) is near


def test_the_odometrys_motion_is_not_taken_where_it_fits_no_better(matcher):
    right = matcher.register(Prediction(1.1, HERE, np.zeros(6), np.diag(VARIANCES)), coarse_first=False)
    lower = HERE.copy()
    lower[2, 3] = -1.5 * SPACING_M
    assert from_odometry(matcher, right, Prior(lower)) is right
