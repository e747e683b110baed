"""Stamps that repeat, run backwards or jump: which scans are kept, and what is counted."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarslam.core.errors import InputError
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.times.stamps import in_stamp_order

YEAR_S = 365 * 86400.0


def kept(stamps, **options):
    faults = Faults()
    taken = list(in_stamp_order(stamps, float, faults, **options))
    assert len(taken) + faults.left_out == len(stamps)
    return taken, faults


def clock(count, first=1000.0):
    return [first + 0.1 * i for i in range(count)]


@pytest.mark.parametrize("place", [0, 1, 5, 18])
@pytest.mark.parametrize("stray", [0.0, 5.0, 1000.0 + YEAR_S, 1000.0 - YEAR_S, 1000.0 + 3.5])
def test_one_stray_stamp_costs_no_other_scan(place, stray):
    stamps = clock(20)
    stamps[place] = stray
    taken, faults = kept(stamps)
    assert taken == stamps[:place] + stamps[place + 1 :]
    assert faults.left_out == 1
    assert f"number {place}, stamped {stray:.9f}" in faults.warnings()[0]


@pytest.mark.parametrize(
    "stamps",
    [
        *(clock(10) + clock(10, first=1000.0 + jump_s) for jump_s in (3.0, 3600.0, YEAR_S)),
        *([period_s * i for i in range(20)] for period_s in (0.01, 2.0, 600.0)),
    ],
    ids=["3 s", "an hour", "a year", "100 Hz", "every 2 s", "every 10 minutes"],
)
def test_a_clock_set_forward_for_good_is_followed_and_fast_and_slow_recordings_are_kept_whole(stamps):
    assert kept(stamps)[0] == stamps


def test_a_clock_set_back_for_good_ends_it_with_what_to_do():
    stamps = clock(15) + clock(15, first=500.0)
    faults, taken = Faults(), []
    with pytest.raises(InputError, match=r"backwards from scan number 15 on, by 501\.4 s.*--stop and --start"):
        taken.extend(itertools.islice(in_stamp_order(stamps, float, faults), 30))
    taken, _ = kept(stamps, may_be_set_back=True)
    assert taken == stamps[:15]


def test_a_clock_set_back_a_little_catches_up():
    stamps = clock(30) + clock(30, first=1002.0)
    taken, faults = kept(stamps)
    assert faults.left_out == len([stamp for stamp in stamps[30:] if stamp <= stamps[29]])
    assert taken[-1] == stamps[-1]


def test_no_more_is_read_ahead_than_tells_a_stray_stamp():
    read = []

    def source():
        for stamp in clock(50):
            read.append(stamp)
            yield stamp

    ordered = in_stamp_order(source(), float, Faults())
    for count in range(1, 40):
        next(ordered)
        assert len(read) <= max(6, count + 1)


def test_an_error_of_the_source_comes_after_the_scans_before_it():
    def source():
        yield from clock(3)
        raise InputError("the bag breaks off")

    ordered = in_stamp_order(source(), float, Faults())
    assert list(itertools.islice(ordered, 3)) == clock(3)
    with pytest.raises(InputError, match="breaks off"):
        next(ordered)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.floats(-1e10, 1e10), max_size=40))
def test_whatever_comes_what_is_taken_increases_and_the_rest_is_counted(stamps):
    taken, _ = kept(stamps, may_be_set_back=True)
    assert (np.diff(taken) > 0).all()
    assert bool(taken) == bool(stamps)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.sets(st.integers(0, 39), max_size=6), st.data())
def test_few_strays_far_off_cost_only_themselves(places, data):
    # No more than two strays among the six that are looked at: the others are in the majority everywhere.
    places = {place for place in places if len({other for other in places if abs(other - place) < 6}) <= 2}
    stamps = clock(40, first=1e9)
    for place in places:
        stamps[place] = data.draw(st.sampled_from([0.0, 1.0, 5e8, 1.5e9, 2e9]))
    taken, _ = kept(stamps)
    good = [stamp for place, stamp in enumerate(stamps) if place not in places]
    # The last ones may be strays that nothing after them gives away.
    assert [stamp for stamp in taken if stamp in good] == good
