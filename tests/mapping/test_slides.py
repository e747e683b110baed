"""Slips along the way are found, and nothing else is taken for one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.mapping import consistency

# A street of 120 m with buildings, parked vans and posts, driven through at 8 m/s.
SCANS, STEP_M = 40, 0.8
ALONG = (-45.0, -38.5, -27.0, -22.0, -13.0, -6.5, 3.0, 7.5, 17.0, 28.5, 34.0, 46.0)
BESIDE = tuple((x + 2.0 * (side > 0), side * (4.5 + x % 3), 0.8) for x in ALONG for side in (-1, 1))
COLONNADE = tuple((x, side * 5.0, 0.8) for x in range(-45, 46, 5) for side in (-1, 1))


@pytest.fixture(scope="module")
def street(room):
    return replace(room, half_size=(60.0, 9.0, 2.0), pillars=BESIDE)


def poses(steps: Sequence[float]) -> FloatArray:
    """(N, 4, 4) along x, from -20 m on."""
    along = -20.0 + np.cumsum([0.0, *steps])
    return exp(np.stack([0.0 * along, 0.0 * along, 0.0 * along, along, 0.0 * along, 0.0 * along - 0.4], axis=-1))


TRUE = poses([STEP_M] * (SCANS - 1))


def record(place: object, ahead: float | None = None) -> list[FloatArray]:
    """Points (N, 3) of each scan, in its frame; a vehicle may drive so far ahead all the time."""
    scans = []
    for number, T in enumerate(TRUE):
        here = place
        if ahead is not None:
            here = replace(place, pillars=(*place.pillars, (T[0, 3] + ahead, 1.5, 1.0)))
        scans.append(here.sweep(lambda times, T=T: np.tile(T, (len(times), 1, 1)), 0.1 * number).points)
    return scans


@pytest.fixture(scope="module")
def scans(street: object) -> list[FloatArray]:
    return record(street)


def check(scans: Sequence[FloatArray], T_world_lidar: FloatArray) -> consistency.ConsistencyCheck:
    """All scans offered at these poses."""
    slides = consistency.ConsistencyCheck()
    for number, (points, T) in enumerate(zip(scans, T_world_lidar, strict=True)):
        slides.add(points, number, T)
    slides.finish()
    return slides


def found(scans: Sequence[FloatArray], T_world_lidar: FloatArray) -> tuple[consistency.Contradiction, ...]:
    """What contradicts these poses."""
    return consistency.find_contradictions(check(scans, T_world_lidar).tests, T_world_lidar)


def test_normals_are_those_of_the_walls(room):
    points = room.sweep(lambda times: np.tile(np.eye(4), (len(times), 1, 1)), 0.1).points
    surfels = consistency.Surfels.of(points)
    on_wall = np.abs(np.abs(surfels.points[:, 0]) - 7.0) < 0.01
    assert np.count_nonzero(on_wall) > 50
    assert np.quantile(-surfels.normals[on_wall, 0] * np.sign(surfels.points[on_wall, 0]), 0.1) > 0.99


def test_planes_that_contain_the_beams_are_no_surfels(rng):
    angles, ranges = rng.uniform(0.0, 2.0, 9000), rng.uniform(4.0, 4.6, 9000)
    fan = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), rng.normal(0.0, 0.003, 9000)], axis=1)
    assert not len(consistency.Surfels.of(fan).points)
    assert len(consistency.Surfels.of(fan - [0.0, 0.0, 1.5]).points) > 50


@pytest.mark.parametrize("shift_m", [0.0, -1.3, 20.0])
def test_the_profile_peaks_at_the_shift(scans, shift_m):
    first, second = consistency.Surfels.of(scans[0]), consistency.Surfels.of(scans[10])
    T = np.eye(4)
    T[0, 3] = 10 * STEP_M - shift_m
    profile = consistency.shift_profile(first, second, T, np.array([1.0, 0.0, 0.0]))
    assert 0.1 * (profile.argmax() - len(profile) // 2) == pytest.approx(shift_m, abs=0.11)


def test_true_poses_are_not_contradicted(scans):
    assert len(check(scans, TRUE).tests) >= 6
    assert found(scans, TRUE) == ()
    assert found([np.ones((3, 3))] * SCANS, TRUE) == (), "without surfaces"


@pytest.mark.parametrize("scale", [0.96, 0.05, 1.1])
def test_a_slide_of_the_whole_run_is_found(scans, scale):
    (stretch,) = found(scans, poses([scale * STEP_M] * (SCANS - 1)))
    assert np.sign(stretch.shift_m) == np.sign(1.0 - scale)
    assert stretch.pairs >= 4
    assert stretch.votes_at_pose < 0.5 * stretch.votes


def test_a_slide_at_one_place_is_found_there(scans):
    steps = [STEP_M] * (SCANS - 1)
    steps[20] = -0.2
    (stretch,) = found(scans, poses(steps))
    assert stretch.first <= 20 < stretch.last
    assert stretch.shift_m == pytest.approx(1.0, abs=0.15)


def test_neither_a_vehicle_that_drives_ahead_nor_a_colonnade_that_repeats_itself_contradicts(street):
    assert found(record(street, ahead=8.0), TRUE) == ()
    assert found(record(replace(street, pillars=COLONNADE)), TRUE) == ()


def test_a_bare_tunnel_says_nothing(street):
    bare = record(replace(street, half_size=(300.0, 9.0, 2.0), pillars=()))
    near = [points[np.linalg.norm(points, axis=1) < 60.0] for points in bare]
    assert len(check(near, poses([0.5 * STEP_M] * (SCANS - 1))).tests) == 0
    assert found(near, poses([0.5 * STEP_M] * (SCANS - 1))) == ()


def pair(first, second, shift_m, votes, votes_at_pose):
    near = np.zeros(41)
    near[20], near[20 + round(10 * shift_m)] = votes_at_pose, votes
    return consistency.PairTest(first, second, np.array([1.0, 0.0, 0.0]), np.zeros(3), shift_m, votes, near)


@pytest.mark.parametrize(("confirmed", "votes", "stretches"), [(True, 14.0, 1), (False, 14.0, 0), (True, 9.0, 0)])
def test_one_contradicting_pair_counts_where_another_confirms_it(confirmed, votes, stretches):
    shift_m, standing = 0.4, np.tile(np.eye(4), (31, 1, 1))
    contradicting, weaker = pair(0, 20, shift_m, votes, 4.0), pair(0, 10, shift_m, 16.0, 12.0)
    other = weaker if confirmed else pair(0, 10, 0.0, 12.0, 12.0)
    agreeing = [pair(10, 20, 0.0, 20.0, 20.0), pair(20, 30, 0.0, 20.0, 20.0)]
    found = consistency.find_contradictions([contradicting, other, *agreeing], standing)
    assert [one.shift_m for one in found] == [shift_m] * stretches


@pytest.mark.parametrize(
    ("votes", "votes_at_pose", "stretches"), [(9.0, 0.5, 0), (10.0, 0.5, 1), (10.0, 1.5, 0), (15.0, 7.0, 1)]
)
def test_the_only_pair_of_a_short_run_counts_where_it_is_clear(votes, votes_at_pose, stretches):
    standing = np.tile(np.eye(4), (11, 1, 1))
    assert len(consistency.find_contradictions([pair(0, 10, 0.4, votes, votes_at_pose)], standing)) == stretches


@pytest.mark.parametrize(("votes_at_pose", "stretches"), [(0.5, 1), (2.2, 0)])
def test_two_low_peaks_contradict_poses_only_where_next_to_nothing_fits_there(votes_at_pose, stretches):
    """A quarter of the votes at the pose, and nine at a peak, is chance among sparse strokes."""
    pairs = [pair(0, 20, -0.9, 8.3, votes_at_pose), pair(10, 20, -0.8, 9.0, votes_at_pose)]
    assert len(consistency.find_contradictions(pairs, np.tile(np.eye(4), (31, 1, 1)))) == stretches


def test_poses_that_were_corrected_are_judged_as_corrected(scans):
    slid = poses([0.9 * STEP_M] * (SCANS - 1))
    assert consistency.find_contradictions(check(scans, slid).tests, TRUE) == ()
    (stretch,) = consistency.find_contradictions(check(scans, TRUE).tests, slid)
    assert stretch.shift_m > 0.0


def test_it_goes_on_from_its_state(scans, through_disk):
    slid = poses([0.9 * STEP_M] * (SCANS - 1))
    begun, resumed = consistency.ConsistencyCheck(), consistency.ConsistencyCheck()
    for number in range(25):
        begun.add(scans[number], number, slid[number])
    resumed.restore(through_disk(begun.state()))
    for number in range(25, SCANS):
        resumed.add(scans[number], number, slid[number])
    resumed.finish()
    for test, other in zip(resumed.tests, check(scans, slid).tests, strict=True):
        assert (test.first, test.second, test.shift_m) == (other.first, other.second, other.shift_m)
        np.testing.assert_array_equal(test.near, other.near)


def test_long_runs_are_sampled(monkeypatch):
    looked_at: list[FloatArray] = []

    def empty(points: FloatArray) -> consistency.Surfels:
        looked_at.append(points)
        return consistency.Surfels(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))

    monkeypatch.setattr(consistency.Surfels, "of", empty)
    slides = consistency.ConsistencyCheck()
    for number in range(20_000):
        slides.add(np.empty((0, 3)), number, np.eye(4))
    assert 500 < len(looked_at) < 1200
