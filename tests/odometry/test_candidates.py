"""Peaks of correlations, followed in NumPy."""

import math
from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import exp, log, make_transform, rotation_angle
from lidarslam.odometry.network.candidates import CorrelationSearch, _peaks
from lidarslam.odometry.network.checkpoint import load_checkpoint, network_of, torch_search
from lidarslam.odometry.network.networks import CorrelationNetwork
from lidarslam.odometry.registry import default_weights

TURN_DEG = 2.0


@pytest.fixture(scope="module")
def network() -> CorrelationNetwork:
    network = network_of(load_checkpoint(default_weights()))
    assert isinstance(network, CorrelationNetwork)
    return network


@pytest.fixture(scope="module")
def seen(box_room):
    """The room from a pose in the plane, as images of points and normals (3, 16, 720)."""
    scene = replace(box_room, columns=720)

    def look(x: float, y: float, heading: float) -> tuple[np.ndarray, np.ndarray]:
        start = make_transform(exp([0.0, 0.0, heading, 0.0, 0.0, 0.0])[:3, :3], [x, y, 0.0])
        (sweep,) = scene.sweeps(1, (0.0,) * 6, start, rolling=False)
        return sweep.points, sweep.normals

    return look


@pytest.mark.parametrize("heading", [0.0, 0.9, -2.4])
@pytest.mark.parametrize(
    ("x", "y", "turn_deg"), [(1.4, -0.6, 0.0), (-1.0, 1.2, 0.0), (0.0, 0.0, 90.0), (0.7, 0.5, 20.0), (-1.2, 0.0, -40.0)]
)
def test_motions_of_any_size_are_found_whatever_the_heading(network, seen, heading, x, y, turn_deg):
    search = torch_search(network)
    previous = search.describe(*seen(0.0, 0.0, 0.0), heading)
    candidates, current = search.compare(previous, *seen(x, y, math.radians(turn_deg)))
    best = candidates[0]
    assert math.degrees(rotation_angle(best.T_prev_curr)) == pytest.approx(abs(turn_deg), abs=2.0 * TURN_DEG)
    np.testing.assert_allclose(best.T_prev_curr[:3, 3], [x, y, 0.0], atol=0.8)
    assert abs(math.remainder(math.degrees(current.heading - heading) - turn_deg, 360.0)) <= TURN_DEG


def test_candidates_are_a_distribution(network, seen):
    search = torch_search(network)
    candidates, _ = search.compare(search.describe(*seen(0.0, 0.0, 0.0)), *seen(2.0, 1.0, 0.3))
    probabilities = np.exp([one.log_probability for one in candidates])
    assert (np.diff(probabilities) <= 0.0).all()
    assert 0.0 < probabilities.sum() <= 1.0 + 1e-6
    for one in candidates:
        assert np.isfinite(log(one.T_prev_curr)).all()
        assert (np.linalg.eigvalsh(one.covariance) > 0.0).all()


def known(turn_scores: np.ndarray) -> CorrelationSearch:
    """With parts that find one turn and one shift in any scan."""
    log_sigma = np.log(np.float32([[0.01, 0.02, 0.03, 0.1, 0.2, 0.3]]))
    return CorrelationSearch(
        columns=lambda *_: [np.zeros((1, 4, 4, 180), dtype=np.float32)],
        turns=lambda *_: [turn_scores],
        bird=lambda grid: [np.zeros((1, 8, *grid.shape[2:]), dtype=np.float32)],
        peaks=lambda *_: [np.float32([0.2]), np.float32([[2.0, 1.0]]), log_sigma],
    )


def test_what_was_seen_in_a_turned_grid_is_turned_back():
    nothing = np.zeros((3, 16, 720), dtype=np.float32)
    scores = np.full((1, 180), -20.0, dtype=np.float32)
    scores[0, 5] = 0.0
    search = known(scores)
    for heading, shift, sigmas in (
        (0.0, (2.0, 1.0), (0.01, 0.02, 0.03, 0.1, 0.2, 0.3)),
        (math.pi / 2, (1.0, -2.0), (0.02, 0.01, 0.03, 0.2, 0.1, 0.3)),
    ):
        candidates, current = search.compare(search.describe(nothing, nothing, heading), nothing, nothing)
        np.testing.assert_allclose(candidates[0].T_prev_curr[:3, 3], [*shift, 0.0], atol=1e-12)
        np.testing.assert_allclose(np.sqrt(np.diag(candidates[0].covariance)), sigmas, rtol=1e-5)
        assert log(candidates[0].T_prev_curr)[2] == pytest.approx(0.2)
        assert current.heading == pytest.approx(heading + math.radians(10.0))


def test_scores_that_are_no_numbers_give_no_motion():
    nothing = np.zeros((3, 16, 720), dtype=np.float32)
    search = known(np.full((1, 180), np.nan, dtype=np.float32))
    candidates, _ = search.compare(search.describe(nothing, nothing), nothing, nothing)
    assert [candidate.is_motion() for candidate in candidates] == [False]


def test_peaks_are_followed_down_to_the_least_probability():
    scores = np.zeros((1, 180), dtype=np.float32)
    scores[0, [10, 100, 140, 178, 2]] = [20.0, 19.0, 10.0, 18.0, 17.0]  # the last near the one across the seam
    assert [int(left[0].argmax()) for left in _peaks(scores, 5, 6)] == [10, 100, 178]
