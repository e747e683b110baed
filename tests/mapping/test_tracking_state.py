"""What makes tracking look around, and what makes it sure again."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from lidarslam.core.geometry import make_transform
from lidarslam.core.tracking import Status
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.tracking.attempt import Attempt
from lidarslam.mapping.tracking.fit import NO_FIT
from lidarslam.mapping.tracking.tracking_state import TrackingState


def test_it_is_not_surprised_by_the_next_scan_but_by_one_after_a_gap():
    assert not TrackingState().is_uncertain(0.1)
    assert TrackingState().is_uncertain(1.5)


def test_after_a_lost_scan_it_is_uncertain_until_one_is_laid():
    state = TrackingState()
    state.lost(has_points=True)
    assert state.is_uncertain(0.1)
    state.registered(Status.OK, False, 0.8, 5.0)
    assert not state.is_uncertain(0.1)


def test_scans_that_saw_nothing_are_no_reason_to_give_the_map_up():
    state = TrackingState()
    for _ in range(50):
        state.lost(has_points=False)
    assert state.lost_in_a_row == 0
    assert state.is_uncertain(0.1)


def test_looking_everywhere_becomes_rare():
    state = TrackingState()
    looks = []
    for _ in range(100):
        looks.append(state.searches_map)
        state.lost(has_points=True)
    assert looks[0]
    assert sum(looks[:20]) == 6
    assert sum(looks[20:]) == 4


@pytest.mark.parametrize(("interval_s", "scans"), [(0.1, 10), (0.5, 3)], ids=["a second at 10 Hz", "three at 2 Hz"])
def test_found_again_is_confirmed_by_the_next_second_and_three_scans(interval_s, scans):
    state = TrackingState()
    state.registered(Status.OK, True, 0.8, 5.0)
    for number in range(1, scans + 1):
        assert state.is_unconfirmed
        state.registered(Status.OK, False, 0.8, 5.0 + number * interval_s)
    assert not state.is_unconfirmed


def test_a_lost_scan_takes_back_that_the_sensor_was_found():
    state = TrackingState()
    state.registered(Status.OK, True, 0.8, 5.0)
    state.lost(has_points=True)
    assert state.is_lost
    assert not state.is_unconfirmed


def test_scans_that_lie_badly_confirm_nothing():
    state = TrackingState()
    state.registered(Status.OK, True, 0.8, 5.0)
    for number in range(20):
        state.registered(Status.DEGRADED, False, 0.8, 5.1 + 0.1 * number)
    assert state.is_unconfirmed


def test_the_second_degraded_scan_is_reason_to_look_around():
    state = TrackingState()
    assert not state.searches_nearby
    state.registered(Status.DEGRADED, False, 0.8, 5.0)
    assert state.searches_nearby


def settled() -> TrackingState:
    state = TrackingState()
    for _ in range(30):
        state.registered(Status.OK, False, 0.8, 5.0)
    return state


def test_a_scan_fits_poorly_beside_what_is_usual():
    assert not settled().fits_poorly(Status.OK, 0.75)
    assert settled().fits_poorly(Status.OK, 0.7)
    assert settled().fits_poorly(Status.DEGRADED, 0.8)
    assert not TrackingState().fits_poorly(Status.OK, 0.1), "nothing is usual yet"


def test_what_is_usual_follows_a_scene_that_is_harder_but_not_scans_that_are_not_believed():
    state = settled()
    for _ in range(30):
        state.registered(Status.DEGRADED, False, 0.3, 5.0)
    assert state.fits_poorly(Status.OK, 0.7)
    for _ in range(30):
        state.registered(Status.OK, False, 0.6, 5.0)
    assert not state.fits_poorly(Status.OK, 0.6)


def test_in_a_map_begun_anew_nothing_is_usual_yet():
    state = settled()
    state.map_restarted()
    assert not state.fits_poorly(Status.OK, 0.2)


@pytest.mark.parametrize(("since_s", "away_m", "measured", "reachable"), [
    (0.5, 1.5, False, True), (0.5, 3.0, False, False), (1.5, 30.0, False, True),
    (0.5, 0.6, True, True), (0.5, 1.5, True, False), (1.5, 1.5, True, False), (3.5, 30.0, True, True),
])  # fmt: skip
def test_a_place_is_reachable_within_the_uncertainty_of_the_motion_since(
    since_s: float, away_m: float, measured: bool, reachable: bool
) -> None:
    prediction = Prediction(10.0 + since_s, np.eye(4), np.zeros(6), np.eye(12))
    found = replace(prediction, T_world_lidar=make_transform(np.eye(3), np.array([0.0, 0.0, away_m])))
    attempt = Attempt(prediction, cast(Any, None), cast(Any, found), NO_FIT, Status.OK, relocalised=True)
    assert attempt.is_reachable(10.0, turn_is_measured=False, motion_is_measured=measured) == reachable
