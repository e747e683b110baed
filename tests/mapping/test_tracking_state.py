"""What makes tracking look around, and what makes it sure again."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from lidarslam.core.geometry import make_transform
from lidarslam.core.tracking import Status
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.tracking.mapped_scan import NO_FIT, Attempt
from lidarslam.mapping.tracking.tracking_state import TrackingState

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


def test_scans_that_saw_nothing_are_no_reason_to_give_the_map_up():
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
def test_a_place_is_reachable_within_the_uncertainty_of_the_motion_since(
    since_s: float, away_m: float, measured: bool, reachable: bool
) -> None:
    prediction = Prediction(10.0 + since_s, np.eye(4), np.zeros(6), np.eye(12))
    found = replace(prediction, T_world_lidar=make_transform(np.eye(3), np.array([0.0, 0.0, away_m])))
    attempt = Attempt(prediction, cast(Any, None), cast(Any, found), NO_FIT, Status.OK, relocalised=True)
    assert attempt.is_reachable(10.0, motion_is_measured=measured) == reachable
