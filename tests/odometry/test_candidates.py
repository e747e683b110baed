"""Peaks of correlations, followed in NumPy."""

import math

import numpy as np
import pytest
import torch

from lidarslam.core.geometry import log, rotation_angle
from odometry.checkpoint import default_weights, load_checkpoint, network_of
from odometry.correlation import CorrelationNetwork
from odometry.candidates import CorrelationSearch, _peaks, _shift_scores
from odometry.torch_graphs import TorchGraphs

TURN_DEG = 2.0


@pytest.fixture(scope="module")
def network() -> CorrelationNetwork:
    """The one that comes along."""
    network = network_of(load_checkpoint(default_weights()))
    assert isinstance(network, CorrelationNetwork)
    return network


@pytest.fixture(scope="module")
def search(network) -> CorrelationSearch:
    return CorrelationSearch(TorchGraphs(network))


@pytest.fixture(scope="module")
def seen():
    """A scan of scattered posts, as images of points and normals (3, 16, 720), from a pose in the plane."""
    rng = np.random.default_rng(3)
    posts = np.stack([rng.uniform(-15.0, 15.0, 60), rng.uniform(-15.0, 15.0, 60)])

    def look(x: float, y: float, heading: float) -> tuple[np.ndarray, np.ndarray]:
        c, s = math.cos(heading), math.sin(heading)
        px, py = c * (posts[0] - x) + s * (posts[1] - y), -s * (posts[0] - x) + c * (posts[1] - y)
        points, normals = np.zeros((2, 3, 16, 720), dtype=np.float32)
        column = (np.degrees(np.arctan2(py, px)) % 360.0 * 2.0).astype(int)
        distance = np.hypot(px, py)
        for post in np.argsort(-distance):
            points[:, :, column[post]] = np.stack(
                [np.full(16, px[post]), np.full(16, py[post]), np.linspace(-1.0, 2.0, 16)]
            )
            normals[:2, :, column[post]] = (-np.array([px[post], py[post]]) / distance[post])[:, None]
        return points, normals

    return look


def test_the_shift_scores_are_those_of_training(network, rng):
    features = rng.normal(size=(2, 1, 8, 96, 96)).astype(np.float32)
    spectra = np.fft.rfft2(features[:, 0]).astype(np.complex64)
    given = _shift_scores(spectra[0], spectra[1])
    expected = network.shift_scores(*torch.from_numpy(features)).numpy()
    np.testing.assert_allclose(given, expected, atol=2e-4 * np.abs(expected).max())


@pytest.mark.parametrize("heading", [0.0, 0.9, -2.4])
@pytest.mark.parametrize(
    ("x", "y", "turn_deg"), [(3.0, -1.5, 0.0), (-6.0, 4.0, 0.0), (0.0, 0.0, 90.0), (1.0, 0.5, 20.0)]
)
def test_motions_of_any_size_are_found_whatever_the_heading(search, seen, heading, x, y, turn_deg):
    previous = search.describe(*seen(0.0, 0.0, 0.0), heading)
    candidates, current = search.compare(previous, *seen(x, y, math.radians(turn_deg)))
    best = candidates[0]
    assert math.degrees(rotation_angle(best.T_prev_curr)) == pytest.approx(turn_deg, abs=2.0 * TURN_DEG)
    np.testing.assert_allclose(best.T_prev_curr[:3, 3], [x, y, 0.0], atol=0.6)
    assert math.remainder(current.heading - heading - math.radians(turn_deg), 2.0 * math.pi) == pytest.approx(
        0.0, abs=math.radians(TURN_DEG)
    )


def test_candidates_are_a_distribution(search, seen):
    candidates, _ = search.compare(search.describe(*seen(0.0, 0.0, 0.0)), *seen(2.0, 1.0, 0.3))
    probabilities = np.exp([one.log_probability for one in candidates])
    assert (np.diff(probabilities) <= 0.0).all()
    assert 0.0 < probabilities.sum() <= 1.0 + 1e-6
    for one in candidates:
        assert np.isfinite(log(one.T_prev_curr)).all()
        assert (np.linalg.eigvalsh(one.covariance) > 0.0).all()


def test_the_covariance_is_turned_with_the_grid(search, seen):
    """What was seen in a grid that is turned by a right angle has its axes exchanged."""
    straight = search.compare(search.describe(*seen(0.0, 0.0, 0.0)), *seen(2.0, 0.0, 0.0))[0][0].covariance
    turned = search.compare(search.describe(*seen(0.0, 0.0, 0.0), math.pi / 2), *seen(2.0, 0.0, 0.0))[0][0].covariance
    assert straight[3, 3] == pytest.approx(turned[4, 4], rel=0.5) or straight[4, 4] == pytest.approx(
        turned[3, 3], rel=0.5
    )
    np.testing.assert_allclose(turned, turned.T, atol=1e-12)


def test_peaks_are_followed_down_to_the_least_probability():
    scores = np.zeros((1, 180), dtype=np.float32)
    scores[0, [10, 100, 140]] = [20.0, 19.0, 10.0]
    found = [int(left[0].argmax()) for left in _peaks(scores, 3, 6)]
    assert found == [10, 100]
    scores[0, 178] = 18.0
    scores[0, 2] = 17.0  # near the one across the seam
    assert [int(left[0].argmax()) for left in _peaks(scores, 4, 6)] == [10, 100, 178]


def test_peaks_on_the_border_of_shifts():
    scores = np.zeros((1, 37, 37), dtype=np.float32)
    scores[0, 0, 36], scores[0, 30, 3] = 8.0, 7.0
    assert [divmod(int(left[0].argmax()), 37) for left in _peaks(scores, 3, 4)] == [(0, 36), (30, 3)]


def test_empty_scans_give_finite_candidates(search):
    nothing = np.zeros((3, 16, 720), dtype=np.float32)
    candidates, _ = search.compare(search.describe(nothing, nothing), nothing, nothing)
    assert all(np.isfinite(one.T_prev_curr).all() and np.isfinite(one.covariance).all() for one in candidates)
