"""Motions between sweeps that are exact, and what is said and searched where they cannot be found, or not in part."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.odometry.alignment import alignment
from lidarslam.odometry.alignment import alignment as module
from lidarslam.odometry.alignment.sweep_motion import SweepMotion, SweepPair
from lidarslam.odometry.images.sweep_images import SweepImages

from .motions import WRONG, assert_close, errors, moved

FINE, NO_STEP = alignment.Effort(column_step=2), alignment.Effort(iterations=0, column_step=2)
INTERVAL_S = 0.1
TWIST = (0.1, -0.05, 0.6, 1.0, 0.3, 0.1)  # rad/s, m/s
TURNING = (0.1, 0.1, math.radians(80.0), 1.0, 0.3, 0.1)


def second_on_first(sweeps: list[SweepImages], last: SweepMotion | None = None) -> SweepPair:
    return SweepPair(sweeps[-1], sweeps[-2], INTERVAL_S, last)


def one_on_the_other(sweeps: list[SweepImages], T: FloatArray, effort: alignment.Effort = FINE) -> alignment.Alignment:
    """The second of two sweeps on the first."""
    return alignment.align(alignment.InitialEstimate(T), second_on_first(sweeps), effort)


@pytest.mark.parametrize(("twist", "wrong", "rolling", "rotation_deg", "translation_m"), [
    (TWIST, WRONG, False, 0.01, 5e-4), (TWIST, WRONG, True, 0.01, 5e-4), (TURNING, WRONG, True, 0.03, 0.002),
    # Pitched by 20 degrees a third of the points fall above or below the other image, and take no part.
    ((0.0, math.radians(200.0), 0.0, 0.0, 0.0, 0.0), (0.0, 0.01, 0.0, 0.01, 0.0, 0.0), False, 0.01, 1e-3),
])  # fmt: skip
def test_a_known_motion_is_found_from_a_wrong_guess(box_room, twist, wrong, rolling, rotation_deg, translation_m):
    found = one_on_the_other(box_room.sweeps(2, twist, rolling=rolling), moved(twist, wrong))
    assert_close(found.T_prev_curr, moved(twist), rotation_deg, translation_m)


def test_turning_sweeps_are_compensated(box_room):
    sweeps, start = box_room.sweeps(2, TURNING), moved(TURNING, WRONG)
    as_if_at_once = [replace(sweep, offsets=np.zeros_like(sweep.offsets)) for sweep in sweeps]
    assert errors(one_on_the_other(as_if_at_once, start).T_prev_curr, moved(TURNING))[0] > 0.1


@pytest.mark.parametrize("certain", [True, False])
def test_a_guess_is_held_as_firmly_as_its_information_says(box_room, certain):
    close = moved(TWIST, (0.0, 0.0, 0.0, 0.02, 0.0, 0.0))
    start = alignment.InitialEstimate(close, (1e9 if certain else 1e-3) * np.eye(6))
    found = alignment.align(start, second_on_first(box_room.sweeps(2, TWIST)), FINE).T_prev_curr
    assert_close(found, close if certain else moved(TWIST), 0.01, 5e-4)


def test_the_information_of_a_guess_is_of_changes_from_the_left(box_room):
    """Turned by a right angle in between, the previous scan's x is the current one's y: the former is held."""
    twist = (0.0, 0.0, 0.5 * math.pi / 0.1, 0.5, 0.2, 0.0)
    sweeps = box_room.sweeps(2, twist, rolling=False)
    T = moved(twist, (0.0, 0.0, 0.0, 0.04, 0.03, 0.0))
    holds_x = np.zeros((6, 6))
    holds_x[3, 3] = 1e9
    found = alignment.align(alignment.InitialEstimate(T, holds_x), second_on_first(sweeps), FINE)
    away = found.T_prev_curr[:3, 3] - moved(twist)[:3, 3]
    # What is held wrongly pulls a little at the rest.
    assert away[0] - T[0, 3] + moved(twist)[0, 3] == pytest.approx(0.0, abs=1e-4)
    assert abs(away[1]) < 0.01


def test_in_a_corridor_the_guess_along_it_is_kept(corridor):
    """The walls say nothing of x; all else is found."""
    twist, wrong = (0.0, 0.0, 0.0, 1.0, 0.2, 0.0), (0.01, 0.01, 0.02, 0.10, 0.06, 0.05)
    sweeps = corridor.sweeps(2, twist)
    T = moved(twist, wrong)
    kept = alignment.align(alignment.InitialEstimate(T, np.eye(6)), second_on_first(sweeps), FINE)
    error = log(kept.T_prev_curr @ inverse(moved(twist)))
    # Turning it back about the origin moves it along x by less than a millimetre.
    assert kept.T_prev_curr[0, 3] == pytest.approx(T[0, 3], abs=1e-3)
    np.testing.assert_allclose(error[:3], 0.0, atol=1e-5)
    np.testing.assert_allclose(error[4:], 0.0, atol=1e-4)
    information = one_on_the_other(sweeps, moved(twist)).information
    assert information[3, 3] < 1e-6 * information[4, 4]
    # Every matched point says one metre of information along its normal: they sum up to their number.
    assert information[3:, 3:].trace() == pytest.approx(kept.inliers, rel=5e-3)


def test_little_is_explained_along_the_way_that_a_scan_is_off(box_room):
    sweeps = box_room.sweeps(2, TWIST)
    right = one_on_the_other(sweeps, moved(TWIST), NO_STEP)
    for axis in range(3):
        wrong = [0.0] * 6
        wrong[3 + axis] = 0.4
        shifted = one_on_the_other(sweeps, moved(TWIST, tuple(wrong)), NO_STEP)
        assert shifted.explained < 0.3
        assert abs(shifted.weakest[axis]) > 0.9
        assert shifted.inliers > 0.35 * right.inliers  # the other walls go along


@pytest.mark.parametrize("empty", ["current", "previous", "both"])
def test_empty_images_move_nothing(box_room, empty):
    full = box_room.sweeps(1, TWIST)[0]
    nothing = replace(full, **{name: 0.0 * getattr(full, name) for name in ("points", "normals", "offsets")})
    sweeps = [full if empty == "current" else nothing, full if empty == "previous" else nothing]
    found = one_on_the_other(sweeps, moved(TWIST, WRONG))
    np.testing.assert_allclose(found.T_prev_curr, moved(TWIST, WRONG))
    assert found.inliers == 0
    assert not found.information.any()


def speeding_up(times: FloatArray) -> FloatArray:
    """Poses on a turn and a way ahead that grow evenly, from rest at 0.1 s before the middle of the first sweep."""
    half = 0.5 * (times + 0.1) ** 2
    return exp(np.multiply.outer(half, np.array(ACCELERATION)))


ACCELERATION = (1.0, 0.5, 8.0, 2.0, 0.5, 0.0)  # rad/s^2, m/s^2: 4.6 degrees more from sweep to sweep


def even(monkeypatch: pytest.MonkeyPatch, sigma: float = 1e-4) -> None:
    """Hold the change of velocity at the expected one."""
    monkeypatch.setattr(module, "INNOVATION_RAD_S", sigma)
    monkeypatch.setattr(module, "INNOVATION_M_S", sigma)


def test_sweeps_that_a_change_of_motion_bends_are_seen_through(box_room, monkeypatch):
    sweeps = box_room.sweeps_along(3, speeding_up)
    T = speeding_up(np.array([0.0, 0.1, 0.2]))
    before, motion = inverse(T[0]) @ T[1], inverse(T[1]) @ T[2]
    velocity = log(before) / INTERVAL_S
    half_a_change = 0.05 * np.array(ACCELERATION)
    off = alignment.InitialEstimate(exp([0.02, 0.0, -0.02, 0.05, 0.03, 0.0]) @ motion)
    for last in (None, SweepMotion(velocity, np.zeros(6), INTERVAL_S)):
        found = alignment.align(off, second_on_first(sweeps, last), FINE)
        assert_close(found.T_prev_curr, motion, 0.06, 0.004)
        np.testing.assert_allclose(found.velocity_change, half_a_change, atol=0.06)
    # Held at none, the motion is off by more.
    even(monkeypatch)
    stiff = alignment.align(off, second_on_first(sweeps), FINE)
    assert np.abs(stiff.velocity_change).max() <= 1e-2
    assert errors(stiff.T_prev_curr, motion)[0] > 3.0 * errors(found.T_prev_curr, motion)[0]
    # Held at what the motion before tells, it is nearly as good.
    told = alignment.align(off, second_on_first(sweeps, SweepMotion(velocity, np.zeros(6), INTERVAL_S)), FINE)
    assert_close(told.T_prev_curr, motion, 0.06, 0.004)


def test_what_a_change_of_velocity_could_be_as_well_is_not_known(box_room, monkeypatch):
    """A wall that is seen for a moment tells where it is, not how fast it got there."""
    sweeps = box_room.sweeps(2, TWIST)
    part = [replace(sweep, normals=sweep.normals * (sweep.offsets < -0.04)) for sweep in sweeps]
    even(monkeypatch, 10.0)
    loose = one_on_the_other(part, moved(TWIST), NO_STEP).information
    even(monkeypatch)
    firm = one_on_the_other(part, moved(TWIST), NO_STEP).information
    assert np.linalg.eigvalsh(firm - loose).min() > -1e-3 * firm.trace()
    assert loose[5, 5] < 0.2 * firm[5, 5]


REST = np.eye(4)


@pytest.fixture(scope="module")
def street(box_room) -> list[SweepImages]:
    """Two sweeps between facades with a pilaster every 3 m; four poles tell where one is."""
    pilasters = [((x, y, -5.0), (x + 1.0, y + 1.2, 30.0)) for x in range(-36, 37, 3) for y in (-7.0, 5.8)]
    poles = [(3.1, 4.2), (-5.2, -4.0), (8.3, -4.4), (-9.6, 4.1)]
    boxes = [((x - 0.15, y - 0.15, -5.0), (x + 0.15, y + 0.15, 5.0)) for x, y in poles]
    scene = type(box_room)((-np.inf, -6.0, -1.8), (np.inf, 6.0, np.inf), (*pilasters, *boxes))
    return scene.sweeps(2, (0.0, 0.0, 0.0, 14.0, 0.0, 0.0))


def best_of(
    sweeps: list[SweepImages], *guesses: FloatArray, information: FloatArray | None = None
) -> alignment.Alignment:
    """The second of two sweeps on the first; the information is about the first guess."""
    first, *others = guesses
    starts = [alignment.InitialEstimate(first, information), *(alignment.InitialEstimate(guess) for guess in others)]
    return alignment.align_best(starts, second_on_first(sweeps), FINE)


def ahead(along_m: float) -> FloatArray:
    """(4, 4)."""
    return exp([0.0, 0.0, 0.0, along_m, 0.0, 0.0])


def wrong_by_m(aligned: alignment.Alignment) -> float:
    return float(errors(aligned.T_prev_curr, ahead(1.4))[1])


def test_of_guesses_that_explain_as_much_the_first_is_taken(corridor):
    """Nothing tells how far ahead one is, and all guesses lie well."""
    sweeps = corridor.sweeps(2, (0.0,) * 6)
    for first, second in ((-0.2, 0.2), (0.2, -0.2)):
        found = best_of(sweeps, ahead(first), ahead(second))
        assert found.T_prev_curr[0, 3] == pytest.approx(first, abs=0.01)


@pytest.mark.parametrize(("sigma_m", "found"), [(0.7, True), (0.03, False)])
def test_a_search_does_not_go_where_the_guess_is_sure_not_to_be(street, sigma_m, found):
    """The motion is 1.4 m from the guess: two standard deviations, or fifty."""
    information = np.eye(6) / sigma_m**2
    searched = best_of(street, REST, information=information)
    assert (wrong_by_m(searched) < 0.02) == (searched.explained > alignment.DOUBTFUL) == found


def test_the_less_likely_a_guess_the_more_it_must_explain(street, monkeypatch):
    """From rest hardly anything fits; what lies beside it is right, and taken unless it is held next to impossible."""
    monkeypatch.setattr(module, "STEPS_M", ())
    for odds, wrong in ((0.0, False), (1.0, False), (30.0, True)):
        starts = [alignment.InitialEstimate(REST), alignment.InitialEstimate(ahead(1.3), sigmas=odds)]
        found = alignment.align_best(starts, second_on_first(street), FINE)
        assert (wrong_by_m(found) > 0.5) == wrong


def information(normals: FloatArray, points: FloatArray) -> FloatArray:
    """(6, 6) of points on planes."""
    J = np.concatenate([np.cross(points, normals), normals], axis=1)
    return J.T @ J


def images(range_m: float = 4.0) -> Any:
    """All points have a normal, this far away; their median range is 4 m."""
    return SimpleNamespace(
        share_with_normal=lambda: 1.0, median_range_m=lambda: 4.0, mean_inverse_square_range=lambda: range_m**-2.0
    )


@pytest.fixture(scope="module")
def corridor_walls() -> FloatArray:
    """Information of points on walls, floor and ceiling along x."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (4000, 3)) * [8.0, 2.0, 1.5]
    axis, side = rng.integers(1, 3, 4000), rng.choice([-1.0, 1.0], 4000)
    points[np.arange(4000), axis] = side * np.array([0.0, 2.0, 1.5])[axis]
    return information(np.eye(3)[axis], points)


@pytest.mark.parametrize(
    ("share", "range_m", "count"), [(0.0005, 4.0, 1), (0.002, 4.0, 0), (0.004, 1.0, 1), (0.004, 5.0, 0)]
)
def test_a_wall_at_the_end_closes_it_when_enough_points_lie_on_it(corridor_walls, share, range_m, count):
    """More than the noise of near normals feigns."""
    end = share * 4000 * information(np.array([[1.0, 0.0, 0.0]]), np.array([[8.0, 0.0, 0.0]]))
    assert len(alignment.find_degeneracy(corridor_walls + end, 4000, images(range_m))) == count


@pytest.mark.parametrize(("bare_share", "count"), [(1.0, 1), (0.75, 1), (0.65, 0), (0.0, 0)])
def test_where_much_has_no_normal_nothing_is_left_open_for_all_one_knows(corridor_walls, box_room, bare_share, count):
    sweep = box_room.sweeps(1, [0.0] * 6)[0]
    sweep.normals[..., round(bare_share * sweep.normals.shape[-1]) :] = 0.0
    assert len(alignment.find_degeneracy(corridor_walls, 4000, sweep)) == count


def test_motion_and_covariance_are_the_expected_ones_along_open_directions_and_only_there(corridor_walls):
    degeneracy = alignment.find_degeneracy(corridor_walls, 4000, images())
    aligned, expected = exp([0.01, 0.0, 0.2, 0.02, -0.1, 0.05]), exp([0.0, 0.1, 0.19, 0.4, 0.3, 0.0])
    motion = alignment.replaced_along(aligned, expected, degeneracy)
    change = log(motion @ inverse(aligned))
    np.testing.assert_allclose(change[[0, 1, 2, 4, 5]], 0.0, atol=1e-9)
    assert log(expected @ inverse(motion))[3] == pytest.approx(0.0, abs=0.01)
    covariance = np.diag([0.02, 0.02, 0.02, 0.3, 0.3, 0.3]) ** 2
    joined = np.linalg.inv(alignment.joined_information(corridor_walls, covariance, degeneracy))
    assert np.sqrt(joined[3, 3]) == pytest.approx(0.3)
    free = np.ix_([0, 1, 2, 4, 5], [0, 1, 2, 4, 5])
    np.testing.assert_allclose(joined[free], np.linalg.inv(corridor_walls[free]), rtol=1e-3, atol=1e-9)
