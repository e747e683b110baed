"""How well scans at known poses lie on a box, and what tracking makes of it."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, transform_points
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import TrackingConfig
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.fit import NO_FIT, Fit, directional_support, measure_fit, translation_information
from lidarslam.mapping.tracking.mapped_scan import Attempt
from lidarslam.mapping.tracking.tracking_state import GIVE_UP_AFTER, TrackingState

from .shapes import across_x, on_sides, surfel_map_of

CONFIG = TrackingConfig()
HALF = np.array([7.0, 5.0, 2.0])
T_WORLD_LIDAR = exp([0.0, 0.0, 0.4, 1.0, -0.5, 0.2])


@pytest.fixture
def box_map(rng: np.random.Generator) -> SurfelMap:
    return surfel_map_of(on_sides(rng, HALF, 60_000), 0.2)


@pytest.fixture
def scan_points(rng: np.random.Generator) -> FloatArray:
    """Seen from `T_WORLD_LIDAR`, away from the box's edges."""
    return transform_points(inverse(T_WORLD_LIDAR), on_sides(rng, HALF, 3_000, margin_m=0.5))


def test_a_scan_in_its_place_fits_entirely(box_map, scan_points):
    fit = measure_fit(scan_points, T_WORLD_LIDAR, box_map)
    assert fit.matched == len(scan_points)
    assert fit.overlap == 1.0
    assert fit.inlier_ratio == 1.0
    assert fit.residual_m < 1e-5
    assert fit.status(CONFIG) is Status.OK
    assert fit.explain(CONFIG) == ""


def test_of_points_half_of_which_see_nothing_known_half_overlap(box_map, scan_points):
    elsewhere = scan_points + np.array([0.0, 0.0, 50.0])
    fit = measure_fit(np.concatenate([scan_points, elsewhere]), T_WORLD_LIDAR, box_map)
    assert fit.overlap == pytest.approx(0.5)
    assert fit.inlier_ratio == 1.0
    assert fit.inlier_share == pytest.approx(0.5)


def test_points_at_corners_count_once_each(box_map, rng):
    """Whatever a point there is held against, planes or bodies."""
    points = transform_points(inverse(T_WORLD_LIDAR), on_sides(rng, HALF, 4_000))
    fit = measure_fit(points, T_WORLD_LIDAR, box_map)
    assert fit.matched <= len(points)
    assert 0.8 < fit.overlap <= 1.0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_worst_axis_decides(box_map, scan_points, axis):
    """A shift by a little more than the gate along one axis of the world: the others' walls all fit."""
    shift = np.eye(4)
    shift[axis, 3] = 0.35
    fit = measure_fit(scan_points, shift @ T_WORLD_LIDAR, box_map)
    assert fit.inlier_ratio < 0.05
    assert fit.status(CONFIG) is Status.LOST
    assert "fits the map" in fit.explain(CONFIG)


def test_a_scan_far_from_everything_does_not_meet_the_map(box_map, scan_points):
    far = np.eye(4)
    far[:3, 3] = 500.0
    fit = measure_fit(scan_points, far, box_map)
    assert fit == Fit(0, 0.0, None, None)
    assert fit.status(CONFIG) is Status.LOST
    assert fit.inlier_share == 0.0
    assert "0 % of the scan overlaps the map" in fit.explain(CONFIG)


HELD_IN_YOUNG_MAP = {"is_young": True, "is_held": True}


@pytest.mark.parametrize(("fit", "circumstances", "status", "told"), [
    (Fit(1_000, 0.9, 0.01, 1.0), {}, Status.OK, ""),
    (Fit(1_000, 0.9, 0.01, 0.6), {}, Status.OK, ""),
    (Fit(1_000, 0.9, 0.01, 0.59), {}, Status.DEGRADED, "fits the map"),
    (Fit(1_000, 0.9, 0.01, 0.45), {}, Status.DEGRADED, "fits the map"),
    (Fit(1_000, 0.9, 0.01, 0.44), {}, Status.LOST, "fits the map"),
    (Fit(1_000, 0.9, 0.01, 0.95, 0.7), {}, Status.OK, ""),
    (Fit(1_000, 0.9, 0.01, 0.95, 0.45), {}, Status.DEGRADED, "slide"),
    (Fit(1_000, 0.9, 0.01, 0.95, 0.2), {}, Status.LOST, "slide"),
    (Fit(50, 0.05, 0.001, 1.0), {}, Status.LOST, "5 %"),
    (Fit(50, 0.05, 0.001, 1.0), HELD_IN_YOUNG_MAP, Status.LOST, "5 %"),
    (Fit(1_000, 0.9, 0.01, 0.3, 0.2), HELD_IN_YOUNG_MAP, Status.DEGRADED, ""),
    (Fit(1_000, 0.9, 0.01, 0.3, 0.2), {"is_young": True}, Status.LOST, ""),
    (Fit(1_000, 0.9, 0.01, 0.3, 0.2), {"is_held": True}, Status.LOST, ""),
])  # fmt: skip
def test_overlap_inliers_and_support_decide_on_the_status(fit, circumstances, status, told):
    config = TrackingConfig(degraded_below=0.6, lost_below=0.45)
    assert fit.status(config, **circumstances) is status
    assert told in fit.explain(config)
    assert (fit.explain(config) == "") == (fit.status(config) is Status.OK)


def test_far_points_may_lie_farther_from_their_surface(rng):
    """At 40 m two per cent of the range are 0.8 m; the same offset nearby is none of an inlier."""
    for distance, expected in ((40.0, 1.0), (5.0, 0.0)):
        local_map = surfel_map_of(across_x(rng, distance, 3.0, 20_000), 0.5)
        fit = measure_fit(across_x(rng, distance - 0.4, 2.0, 500), np.eye(4), local_map)
        assert fit.inlier_ratio == expected


def street_normals(rng: np.random.Generator, along: int) -> FloatArray:
    """(N, 3) of ground and facades along x, somewhat rough, and of so many surfaces that face along it."""
    normals = np.zeros((2_000 + 1_000 + along, 3))
    normals[:2_000, 2] = normals[2_000:3_000, 1] = normals[3_000:, 0] = 1.0
    normals += rng.normal(scale=0.03, size=normals.shape)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def support_of(normals: FloatArray, distances: FloatArray) -> tuple[float, FloatArray]:
    return directional_support(*translation_information(normals, distances, np.ones(len(distances))))


def test_of_a_scan_that_slides_along_a_street_what_constrains_it_is_not_supported(rng):
    """One point in twelve shows the slide: the inlier ratio of all hardly changes, the support does.

    In an even tunnel nothing shows a slide; that is a matter of degeneracy, not of the fit.
    """
    normals = street_normals(rng, along=270)
    held, slid = (np.abs(normals @ [distance, 0.0, 0.0]) for distance in (0.05, 3.0))
    assert support_of(normals, held)[0] > 0.99
    assert support_of(normals, slid)[0] < 0.2
    assert np.mean(slid < 1.0) > 0.9
    _, direction = support_of(normals, slid)
    assert abs(direction[0]) > 0.99
    tunnel = street_normals(rng, along=0)
    assert support_of(tunnel, np.full(len(tunnel), 0.1))[0] > 0.98


FOUND = TrackingState().registered(Status.OK, True, 0.8, 5.0)


def registered(state: TrackingState, scans: int, status: Status, quality: float = 0.8, every_s: float = 0.0) -> Any:
    """The state after so many scans more, from 5 s on."""
    for number in range(1, scans + 1):
        state = state.registered(status, False, quality, 5.0 + number * every_s)
    return state


def test_the_pose_is_uncertain_after_a_gap_and_after_a_lost_scan_until_one_is_registered():
    assert not TrackingState().is_uncertain(0.1)
    assert TrackingState().is_uncertain(1.5)
    lost = TrackingState().lost(has_points=True)
    assert lost.is_uncertain(0.1)
    assert not registered(lost, 1, Status.OK).is_uncertain(0.1)


def test_the_map_is_given_up_after_so_many_lost_scans_unless_they_saw_nothing():
    state = TrackingState()
    for _ in range(GIVE_UP_AFTER):
        assert not state.gives_up
        state = state.lost(has_points=True)
    assert state.gives_up
    state = TrackingState()
    for _ in range(50):
        state = state.lost(has_points=False)
    assert not state.gives_up
    assert state.is_uncertain(0.1)


def test_searches_of_the_whole_map_become_rare():
    state, searches = TrackingState(), []
    for _ in range(100):
        searches.append(state.searches_map)
        state = state.lost(has_points=True)
    assert searches[0]
    assert sum(searches[:20]) == 6
    assert sum(searches[20:]) == 4


@pytest.mark.parametrize(("interval_s", "scans"), [(0.1, 10), (0.5, 3)], ids=["a second at 10 Hz", "three at 2 Hz"])
def test_a_relocalisation_is_confirmed_by_the_next_second_and_three_scans(interval_s, scans):
    assert registered(FOUND, scans - 1, Status.OK, every_s=interval_s).is_unconfirmed
    assert not registered(FOUND, scans, Status.OK, every_s=interval_s).is_unconfirmed
    assert registered(FOUND, 20, Status.DEGRADED, every_s=0.1).is_unconfirmed
    lost = FOUND.lost(has_points=True)
    assert lost.is_lost
    assert not lost.is_unconfirmed


def test_a_scan_fits_poorly_beside_what_is_usual():
    """Which follows a scene that is harder, but not scans that are not believed."""
    settled = registered(TrackingState(), 30, Status.OK)
    assert not settled.fits_poorly(Status.OK, 0.75)
    assert settled.fits_poorly(Status.OK, 0.7)
    assert settled.fits_poorly(Status.DEGRADED, 0.8)
    assert registered(settled, 30, Status.DEGRADED, 0.3).fits_poorly(Status.OK, 0.7)
    assert not registered(settled, 30, Status.OK, 0.6).fits_poorly(Status.OK, 0.6)
    for new in (TrackingState(), settled.in_new_map()):
        assert not new.fits_poorly(Status.OK, 0.2)


@pytest.mark.parametrize(("since_s", "away_m", "measured", "reachable"), [
    (0.5, 1.5, False, True), (0.5, 3.0, False, False), (1.5, 30.0, False, True),
    (0.5, 0.6, True, True), (0.5, 1.5, True, False), (1.5, 1.5, True, False), (3.5, 30.0, True, True),
])  # fmt: skip
def test_a_place_is_reachable_within_the_uncertainty_of_the_motion_since(since_s, away_m, measured, reachable):
    prediction = Prediction(10.0 + since_s, np.eye(4), np.zeros(6), np.eye(12))
    found = replace(prediction, T_world_lidar=make_transform(np.eye(3), np.array([0.0, 0.0, away_m])))
    attempt = Attempt(prediction, cast(Any, None), cast(Any, found), NO_FIT, Status.OK, relocalised=True)
    assert attempt.is_reachable(10.0, motion_is_measured=measured) == reachable


@pytest.mark.parametrize(("sigma_m", "away_m", "unexpected", "jumped"), [
    (0.01, 0.09, False, False), (0.01, 0.2, True, False), (0.05, 0.2, False, False), (0.01, 0.6, True, True),
])  # fmt: skip
def test_a_correction_beyond_the_uncertainty_of_the_prediction_is_unexpected(sigma_m, away_m, unexpected, jumped):
    prediction = Prediction(0.1, np.eye(4), np.zeros(6), sigma_m**2 * np.eye(12))
    found = replace(prediction, T_world_lidar=make_transform(np.eye(3), np.array([0.0, away_m, 0.0])))
    attempt = Attempt(prediction, cast(Any, None), cast(Any, found), NO_FIT, Status.OK)
    assert (attempt.is_unexpected, attempt.has_jumped) == (unexpected, jumped)
