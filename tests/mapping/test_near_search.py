"""Fins along a corridor and shelves along a wall, at equal distances: a scan fits at the next one as well."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, inverse, make_transform
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import LOST_MOTION, MotionState, OdometryNoise, Prediction, Prior
from lidarslam.mapping.registration.sampled_scan import SampledScan, sizes_of_cells
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.budget import Budget
from lidarslam.mapping.tracking.fit import NO_FIT
from lidarslam.mapping.tracking.mapped_scan import Attempt, judge
from lidarslam.mapping.tracking.near_search import NearSearch
from lidarslam.mapping.tracking.scan_matcher import ScanMatcher
from lidarslam.mapping.tracking.tracker import Tracker
from lidarslam.mapping.tracking.tracking_state import TrackingState

CELLS_M, FINS_M, SHELVES_M = sizes_of_cells(0.05), 0.6, 0.2
HERE, LOWER = np.eye(4), make_transform(np.eye(3), [0.0, 0.0, -1.5 * SHELVES_M])

Scene = Callable[[np.random.Generator, int], FloatArray]


def finned_corridor(rng: np.random.Generator, count: int, share: float = 0.4) -> FloatArray:
    """Points (N, 3) on walls, floor and, this share of them, fins."""
    points, kind = rng.uniform(-2.0, 2.0, (count, 3)), rng.random(count)
    on_fin, on_wall, on_floor = kind < share, (kind > share) & (kind < 0.8), kind > 0.8
    points[:, 0] *= 1.5
    points[on_fin, 0] = FINS_M * rng.integers(-5, 6, on_fin.sum())
    points[on_fin, 1] = np.sign(points[on_fin, 1]) * rng.uniform(1.6, 2.0, on_fin.sum())
    points[on_wall, 1] = 2.0 * np.sign(points[on_wall, 1])
    points[on_floor, 2] = -2.0
    return points + rng.normal(0.0, 0.01, points.shape)


def shelves(rng: np.random.Generator, count: int) -> FloatArray:
    """Points (N, 3) on shelves along a wall, which look alike at every other height; three walls and a floor."""
    unit, kind = rng.uniform(-1.0, 1.0, (count, 3)), rng.random(count)
    points = 2.0 * unit
    on_shelf, on_floor = kind < 0.3, (kind > 0.3) & (kind < 0.33)
    behind, beside = (kind > 0.33) & (kind < 0.7), kind > 0.7
    points[on_shelf, 0] = 2.0 + 0.3 * unit[on_shelf, 0]
    points[on_shelf, 2] = SHELVES_M * rng.integers(-9, 10, on_shelf.sum())
    points[on_floor, 2] = -2.3
    points[behind, 0], points[beside, 1] = -2.0, np.sign(unit[beside, 1]) * 2.0
    return points + rng.normal(0.0, 0.01, points.shape)


def matcher_of(scene: Scene, stamp: float) -> ScanMatcher:
    """Of a scan at rest, in a map of eight of which the last was taken at 1 s; its points are of no rings."""
    rng, surfel_map = np.random.default_rng(0), SurfelMap(CELLS_M, 20.0)
    for _ in range(8):
        surfel_map.insert(scene(rng, 6000), rng.uniform(-0.2, 0.2, 6000), np.zeros(3))
    points = scene(rng, 2500)
    scan = SampledScan(stamp, CELLS_M, 2.0, Sweep(points), rng.uniform(-0.2, 0.2, 2500), Sweep(points))
    last = MotionState(1.0, HERE, np.zeros(6), 1e-6 * np.eye(12))
    return ScanMatcher(scan, last, surfel_map, MappingConfig(), Budget())


@pytest.fixture(scope="module")
def in_corridor() -> ScanMatcher:
    """Half a second after the last scan."""
    return matcher_of(finned_corridor, 1.5)


@pytest.fixture(scope="module")
def at_shelves() -> ScanMatcher:
    return matcher_of(shelves, 1.1)


def registered(matcher: ScanMatcher, T_predicted: FloatArray, sigmas_m: tuple[float, float, float]) -> Attempt:
    variances = np.array([0.01] * 3 + [*sigmas_m] + [0.1] * 6) ** 2
    stamp = matcher.scan.stamp
    return matcher.register(Prediction(stamp, T_predicted, np.zeros(6), np.diag(variances)), coarse_first=False)


def at_any_speed(matcher: ScanMatcher, prior: Prior, sigma_m: float) -> Attempt:
    near = registered(matcher, HERE, (sigma_m, 0.04, 0.04))
    state = replace(TrackingState(), velocity_known=True)
    return NearSearch(matcher, state, prior, near.prediction).at_any_speed(near)


def test_without_a_measured_motion_the_next_fin_is_a_rival(in_corridor):
    found = at_any_speed(in_corridor, Prior(), 0.5)
    np.testing.assert_allclose(found.T_world_lidar[:3, 3], 0.0, atol=0.005)
    assert abs(found.rival[0]) == pytest.approx(FINS_M, abs=0.02)
    np.testing.assert_allclose(found.rival[1:], 0.0, atol=0.02)
    assert found.unconstrained == ("x",)
    status, message = judge(found, False, False, False, None, MappingConfig().tracking)
    assert status is Status.DEGRADED
    assert "repetitive" in message


@pytest.mark.parametrize(("prior", "sigma_m"), [(Prior(HERE), 0.5), (Prior(), 0.1)], ids=["measured", "predicted"])
def test_a_motion_that_is_known_has_no_rival(in_corridor, prior, sigma_m):
    found = at_any_speed(in_corridor, prior, sigma_m)
    assert found.rival is None
    assert found.unconstrained == ()


@pytest.mark.parametrize("is_inertial", [False, True])
def test_a_position_that_an_imu_predicts_is_not_looked_for_elsewhere(in_corridor, is_inertial):
    near = registered(in_corridor, HERE, (0.01, 0.01, 0.01))
    prediction = replace(near.prediction, is_inertial=is_inertial)
    found = NearSearch(in_corridor, TrackingState(), Prior(), prediction).at_any_speed(near)
    assert (found is near) == is_inertial


@pytest.mark.parametrize(("prior", "sigma_m"), [(Prior(HERE), 0.35), (Prior(HERE), 0.05), (Prior(), 0.35)])
def test_another_place_is_a_rival_where_an_odometry_leaves_the_motion_open(prior, sigma_m):
    matcher = matcher_of(partial(finned_corridor, share=0.1), 1.5)
    in_view = np.flatnonzero(np.abs(matcher.scan.keypoints.points[:, 0]) < 2.3)
    matcher = replace(matcher, scan=replace(matcher.scan, keypoints=matcher.scan.keypoints.take(in_view)))
    near = registered(matcher, HERE, (sigma_m, 0.04, 0.04))
    state = replace(TrackingState(), velocity_known=True)
    found = NearSearch(matcher, state, prior, near.prediction).against_rivals(near)
    assert found.T_world_lidar is near.T_world_lidar
    if prior.T_prev_curr is None or sigma_m < 0.1:
        assert found.rival is None
    else:
        assert 4.0 * CELLS_M[0] < abs(found.rival[0]) < 2.0 * sigma_m
        np.testing.assert_allclose(found.rival[1:], 0.0, atol=0.02)
        assert found.unconstrained == ("x",)


@pytest.mark.parametrize(
    ("is_inertial", "sigma_m", "uncertain"), [(True, 0.01, ()), (True, 0.1, ("x",)), (False, 0.01, ("x",))]
)
def test_along_a_bare_corridor_an_imu_that_is_certain_constrains_the_position(is_inertial, sigma_m, uncertain):
    matcher = matcher_of(partial(finned_corridor, share=0.0), 1.1)
    near = registered(matcher, HERE, (sigma_m, 0.04, 0.04))
    attempt = replace(near, prediction=replace(near.prediction, is_inertial=is_inertial))
    assert attempt.unconstrained == ("x",)
    assert attempt.uncertain == uncertain
    status, _ = judge(attempt, False, False, False, None, MappingConfig().tracking)
    assert status is (Status.DEGRADED if uncertain else Status.OK)


def from_odometry(matcher: ScanMatcher, near: Attempt, T_told: FloatArray | None) -> Attempt:
    return NearSearch(matcher, TrackingState(), Prior(T_told), near.prediction).from_odometry(near)


def test_the_odometrys_motion_is_tried_where_the_prediction_is_uncertain(at_shelves):
    near = registered(at_shelves, LOWER, (0.04, 0.04, 0.25))
    assert near.T_world_lidar[2, 3] == pytest.approx(-SHELVES_M, abs=0.01)
    np.testing.assert_allclose(from_odometry(at_shelves, near, HERE).T_world_lidar[:3, 3], 0.0, atol=0.005)
    assert from_odometry(at_shelves, near, None) is near


def test_the_odometrys_motion_is_not_taken_where_it_fits_no_better(at_shelves):
    right = registered(at_shelves, HERE, (0.04, 0.04, 0.25))
    assert from_odometry(at_shelves, right, LOWER) is right


@pytest.mark.parametrize(("moved_m", "height_m"), [(0.2, 0.0), (0.5, -2.0 * SHELVES_M)])
def test_where_few_points_constrain_the_height_the_odometry_decides_after_short_motions(at_shelves, moved_m, height_m):
    moved = make_transform(np.eye(3), [moved_m, 0.0, 0.0])
    matcher = replace(at_shelves, last=replace(at_shelves.last, T_world_lidar=inverse(moved)))
    near = registered(matcher, make_transform(np.eye(3), [0.0, 0.0, -2.0 * SHELVES_M]), (0.04, 0.04, 0.25))
    assert near.status is Status.OK
    prior = Prior(moved, covariance=np.diag([0.01] * 3 + [0.005] * 3) ** 2)
    held = NearSearch(matcher, TrackingState(), prior, near.prediction).held_by_odometry(near)
    assert held.T_world_lidar[2, 3] == pytest.approx(height_m, abs=0.01)


# Of an odometry that was consistent so far, here at rest.
PROVEN = replace(TrackingState(), is_measured=True, odometry_noise=OdometryNoise(agreed=20))
AT_REST = Prior(HERE, covariance=np.diag([0.01] * 3 + [0.02] * 3) ** 2)


def test_a_proven_odometry_continues_the_pose_of_a_lost_scan_with_its_own_covariance(at_shelves):
    predicted = registered(at_shelves, LOWER, (0.04, 0.04, 0.25)).prediction
    tracker = Tracker(MappingConfig())
    for state in (TrackingState(), PROVEN):
        tracker.tracking = state
        continued = NearSearch(at_shelves, state, AT_REST, predicted).continued(predicted)
        lost = tracker.lose(continued, "few points fit", NO_FIT).state
        if state is PROVEN:
            np.testing.assert_allclose(lost.T_world_lidar, HERE, atol=0.005)
            assert np.sqrt(np.diag(lost.covariance)[3:6].max()) < 0.03
        else:
            np.testing.assert_array_equal(lost.T_world_lidar, LOWER)
            np.testing.assert_array_equal(lost.covariance, LOST_MOTION)


@pytest.mark.parametrize("strategy", ["at_any_speed", "with_any_acceleration"])
@pytest.mark.parametrize(("status", "state", "moved_m"), [
    (Status.DEGRADED, PROVEN, 0.5 * FINS_M),
    (Status.DEGRADED, TrackingState(), 0.0),
    (Status.LOST, PROVEN, 0.0),
])  # fmt: skip
def test_a_better_place_that_contradicts_a_proven_odometry_counts_only_if_the_scan_is_lost(
    in_corridor, strategy, status, state, moved_m
):
    between = make_transform(np.eye(3), [0.5 * FINS_M, 0.0, 0.0])
    near = replace(registered(in_corridor, between, (0.005, 0.04, 0.04)), status=status)
    search = NearSearch(in_corridor, replace(state, velocity_known=True), replace(AT_REST, T_prev_curr=between),
                        near.prediction)  # fmt: skip
    found = getattr(search, strategy)(near)
    assert found.T_world_lidar[0, 3] == pytest.approx(moved_m, abs=0.005)
