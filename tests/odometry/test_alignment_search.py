"""Motions that alignment does not find from the first guess, in a street that looks the same every three metres."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.odometry.alignment import alignment as search
from lidarslam.odometry.alignment.alignment import (
    DOUBTFUL,
    Alignment,
    Effort,
    InitialEstimate,
    align,
    align_best,
    try_instead,
)
from lidarslam.odometry.alignment.sweep_motion import SweepPair
from lidarslam.odometry.images.sweep_images import SweepImages

FINE = Effort(column_step=2)
TWIST = (0.0, 0.0, 0.0, 14.0, 0.0, 0.0)  # rad/s, m/s: 1.4 m from sweep to sweep
REST = np.eye(4)


@pytest.fixture(scope="module")
def street(box_room) -> list[SweepImages]:
    """Two sweeps between facades with a pilaster every 3 m; four poles tell where one is."""
    pilasters = [((x, y, -5.0), (x + 1.0, y + 1.2, 30.0)) for x in range(-36, 37, 3) for y in (-7.0, 5.8)]
    poles = [(3.1, 4.2), (-5.2, -4.0), (8.3, -4.4), (-9.6, 4.1)]
    boxes = [((x - 0.15, y - 0.15, -5.0), (x + 0.15, y + 0.15, 5.0)) for x, y in poles]
    scene = type(box_room)((-np.inf, -6.0, -1.8), (np.inf, 6.0, np.inf), (*pilasters, *boxes))
    return scene.sweeps(2, TWIST)


@pytest.fixture
def no_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "STEPS_M", ())


def moved(along_m: float) -> FloatArray:
    """(4, 4) ahead."""
    return exp([0.0, 0.0, 0.0, along_m, 0.0, 0.0])


def second_on_first(sweeps: list[SweepImages]) -> SweepPair:
    return SweepPair(sweeps[1], sweeps[0], 0.1)


def one_on_the_other(
    sweeps: list[SweepImages], *guesses: FloatArray, information: FloatArray | None = None
) -> Alignment:
    """The second of two sweeps on the first; the information is about the first guess."""
    first, *others = guesses
    hypotheses = [InitialEstimate(first, information), *(InitialEstimate(guess) for guess in others)]
    return align_best(hypotheses, second_on_first(sweeps), FINE)


def wrong_by_m(aligned: Alignment) -> float:
    return float(np.linalg.norm(log(aligned.T_prev_curr @ inverse(moved(1.4)))[3:]))


def test_alignment_from_rest_stays_there_and_knows_it(street):
    found = align(InitialEstimate(REST), second_on_first(street), FINE)
    assert wrong_by_m(found) == pytest.approx(1.4, abs=0.05)
    assert found.inlier_share > 0.3  # the ground and the walls go along
    assert found.explained < DOUBTFUL - 0.2
    np.testing.assert_allclose(np.abs(found.weakest), [1.0, 0.0, 0.0], atol=0.05)


def test_steps_along_the_direction_in_doubt_find_the_motion(street):
    found = one_on_the_other(street, REST)
    assert wrong_by_m(found) < 0.02
    assert found.explained > DOUBTFUL


def test_a_good_alignment_is_not_searched_around(street):
    found = one_on_the_other(street, moved(1.35))
    alone = align(InitialEstimate(moved(1.35)), second_on_first(street), FINE)
    assert np.array_equal(found.T_prev_curr, alone.T_prev_curr)


def test_a_later_guess_that_explains_more_is_taken(street, no_steps):
    found = one_on_the_other(street, REST, moved(1.3))
    assert wrong_by_m(found) < 0.02


def test_of_guesses_that_explain_as_much_the_first_is_taken(corridor):
    """Nothing tells how far ahead one is, and all guesses lie well."""
    sweeps = corridor.sweeps(2, (0.0,) * 6)
    for first, second in ((-0.2, 0.2), (0.2, -0.2)):
        found = one_on_the_other(sweeps, moved(first), moved(second))
        assert found.T_prev_curr[0, 3] == pytest.approx(first, abs=0.01)


@pytest.mark.parametrize(("sigma_m", "found"), [(0.7, True), (0.03, False)])
def test_a_search_does_not_go_where_the_guess_is_sure_not_to_be(street, sigma_m, found):
    """The motion is 1.4 m from the guess: two standard deviations, or fifty."""
    information = np.eye(6) / sigma_m**2
    searched = one_on_the_other(street, REST, information=information)
    assert (wrong_by_m(searched) < 0.02) == found


def test_the_best_of_many_guesses_is_found_roughly(street):
    guesses = [moved(0.1 * x) for x in (-20, -10, 0, 13, 25)]
    bad = align(InitialEstimate(REST), second_on_first(street), FINE)
    found = try_instead(bad, guesses, second_on_first(street), FINE)
    assert found is not None
    assert wrong_by_m(found) < 0.02


def test_the_less_likely_a_guess_the_more_it_must_explain(street, no_steps):
    """From rest hardly anything fits; what lies beside it is right, and taken unless it is held next to impossible."""
    rest, right = InitialEstimate(REST), moved(1.4)
    for odds, wrong in ((1.0, False), (30.0, True)):
        found = align_best([rest, InitialEstimate(right, sigmas=odds)], second_on_first(street), FINE)
        assert (wrong_by_m(found) > 0.5) == wrong
