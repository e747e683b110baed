"""What makes tracking look around, and what makes it sure again."""

import pytest

from lidarslam.core.tracking import Status
from mapping.tracking.tracking_state import Doubt


def test_it_is_not_surprised_by_the_next_scan_but_by_one_after_a_gap() -> None:
    assert not Doubt().is_surprised(0.1)
    assert Doubt().is_surprised(1.5)


def test_after_a_lost_scan_it_is_surprised_until_one_is_laid() -> None:
    doubt = Doubt()
    doubt.missed()
    assert doubt.is_surprised(0.1)
    doubt.laid(Status.OK, False, 0.8, 5.0)
    assert not doubt.is_surprised(0.1)


def test_scans_that_saw_nothing_are_no_reason_to_give_the_map_up() -> None:
    doubt = Doubt()
    for _ in range(50):
        doubt.saw_nothing()
    assert doubt.lost_in_a_row == 0
    assert doubt.is_surprised(0.1)


def test_looking_everywhere_becomes_rare() -> None:
    doubt = Doubt()
    looks = []
    for _ in range(100):
        looks.append(doubt.looks_everywhere)
        doubt.missed()
    assert looks[0]
    assert sum(looks[:20]) == 6
    assert sum(looks[20:]) == 4


@pytest.mark.parametrize(("interval_s", "scans"), [(0.1, 10), (0.5, 3)], ids=["a second at 10 Hz", "three at 2 Hz"])
def test_found_again_is_confirmed_by_the_next_second_and_three_scans(interval_s: float, scans: int) -> None:
    doubt = Doubt()
    doubt.laid(Status.OK, True, 0.8, 5.0)
    for number in range(1, scans + 1):
        assert doubt.is_unconfirmed
        doubt.laid(Status.OK, False, 0.8, 5.0 + number * interval_s)
    assert not doubt.is_unconfirmed


def test_a_lost_scan_takes_back_that_the_sensor_was_found() -> None:
    doubt = Doubt()
    doubt.laid(Status.OK, True, 0.8, 5.0)
    doubt.missed()
    assert doubt.is_astray
    assert not doubt.is_unconfirmed


def test_scans_that_lie_badly_confirm_nothing() -> None:
    doubt = Doubt()
    doubt.laid(Status.OK, True, 0.8, 5.0)
    for number in range(20):
        doubt.laid(Status.DEGRADED, False, 0.8, 5.1 + 0.1 * number)
    assert doubt.is_unconfirmed


def test_the_second_degraded_scan_is_reason_to_look_around() -> None:
    doubt = Doubt()
    assert not doubt.looks_around
    doubt.laid(Status.DEGRADED, False, 0.8, 5.0)
    assert doubt.looks_around


def settled() -> Doubt:
    doubt = Doubt()
    for _ in range(30):
        doubt.laid(Status.OK, False, 0.8, 5.0)
    return doubt


def test_a_scan_lies_badly_beside_what_is_usual() -> None:
    assert not settled().lies_badly(Status.OK, 0.75)
    assert settled().lies_badly(Status.OK, 0.7)
    assert settled().lies_badly(Status.DEGRADED, 0.8)
    assert not Doubt().lies_badly(Status.OK, 0.1), "nothing is usual yet"


def test_what_is_usual_follows_a_scene_that_is_harder_but_not_scans_that_are_not_believed() -> None:
    doubt = settled()
    for _ in range(30):
        doubt.laid(Status.DEGRADED, False, 0.3, 5.0)
    assert doubt.lies_badly(Status.OK, 0.7)
    for _ in range(30):
        doubt.laid(Status.OK, False, 0.6, 5.0)
    assert not doubt.lies_badly(Status.OK, 0.6)


def test_in_a_map_begun_anew_nothing_is_usual_yet() -> None:
    doubt = settled()
    doubt.began_anew()
    assert not doubt.lies_badly(Status.OK, 0.2)
