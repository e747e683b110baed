"""Errors of maps that are known, and the crispness of clouds whose covariance is known."""

import json

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.core.thinning import first_per_cell
from lidarslam.evaluation.map.entropy import map_entropy
from lidarslam.evaluation.map.metrics import compare_maps
from lidarslam.evaluation.report.drawing import error_colours

UTM = np.array([5e5, 5e6, 300.0])


@pytest.fixture
def plane() -> FloatArray:
    """A plane of 10 x 10 m, a point every 10 cm."""
    x, y = np.meshgrid(0.1 * np.arange(100), 0.1 * np.arange(100), indexing="ij")
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("origin", [np.zeros(3), UTM])
@pytest.mark.parametrize(("shift", "hits"), [(0.05, (100, 100, 100)), (0.15, (0, 100, 100)), (0.3, (0, 0, 100))])
def test_a_shifted_plane(plane, origin, shift, hits):
    metrics = compare_maps(plane + origin + [0.0, 0.0, shift], plane + origin).metrics
    assert metrics.accuracy_mean_m == pytest.approx(shift, abs=1e-7)
    assert metrics.completeness_mean_m == pytest.approx(shift, abs=1e-7)
    assert metrics.chamfer_m == pytest.approx(shift, abs=1e-7)
    assert tuple(metrics.f_score_percent.values()) == pytest.approx(hits)


def test_a_missing_half(plane):
    """The missing columns are 0.1 to 5.0 m from the map."""
    metrics = compare_maps(plane[plane[:, 0] < 4.95], plane).metrics
    assert metrics.accuracy_mean_m == 0.0
    assert metrics.completeness_mean_m == pytest.approx(0.1 * sum(range(1, 51)) / 100)
    assert metrics.coverage_percent[1.0] == pytest.approx(60.0, abs=1.01)  # 1.0 m itself is a matter of rounding
    assert metrics.deviation_percent[1.0] == 0.0
    recall = 0.5 + 0.05  # half of it and columns up to 0.5 m, of which the last is a matter of rounding
    assert metrics.f_score_percent[0.5] == pytest.approx(200.0 * recall / (1.0 + recall), abs=1.0)


def test_outliers_deviate_though_they_are_outside_the_box(plane):
    far = np.array([20.0, 0.0, 50.0]) + np.arange(2_500)[:, None] * [0.2, 0.0, 0.0]
    metrics = compare_maps(np.concatenate([plane, far]), plane).metrics
    assert metrics.deviation_percent[1.0] == pytest.approx(100.0 * 2_500 / 12_500)
    assert metrics.accuracy_mean_m == 0.0


def test_points_inside_the_box_count_for_accuracy(plane):
    above = plane[::4] + np.array([0.0, 0.0, 0.9])
    metrics = compare_maps(np.concatenate([plane, above]), plane).metrics
    assert metrics.accuracy_mean_m == pytest.approx(0.9 * 2_500 / 12_500)


def test_what_no_sensor_could_see_is_not_missing(plane):
    position = np.array([[0.0, 4.95, 0.0]])
    mapped = plane[plane[:, 0] < 5.5]
    compared = compare_maps(mapped, plane, position, max_range_m=5.0)
    assert compared.metrics.completeness_mean_m == 0.0
    assert compared.metrics.coverage_percent[1.0] < 70.0  # of all points, whoever could see them
    assert compare_maps(mapped, plane).metrics.completeness_mean_m > 0.5


def test_density_changes_nothing(plane):
    shifted = plane + np.array([0.0, 0.0, 0.2])
    crowded = np.concatenate([shifted, *[plane[:50] + 1e-4 * k for k in range(200)]])
    once, often = compare_maps(np.concatenate([shifted, plane[:50]]), plane), compare_maps(crowded, plane)
    assert often.metrics.accuracy_mean_m == pytest.approx(once.metrics.accuracy_mean_m, rel=0.01)
    assert once.metrics.accuracy_mean_m == pytest.approx(0.2, rel=0.01)


@pytest.mark.parametrize("empty", ["map", "reference"])
def test_without_points_nothing_is_computed(plane, empty):
    nothing = np.empty((0, 3))
    metrics = compare_maps(*((nothing, plane) if empty == "map" else (plane, nothing))).metrics
    values = [metrics.accuracy_mean_m, metrics.completeness_mean_m, metrics.chamfer_m, metrics.coverage_percent[1.0]]
    assert [*values, metrics.deviation_percent[1.0], metrics.f_score_percent[0.1]] == [None] * 6
    json.dumps(metrics.to_json(), allow_nan=False)


def test_distances_belong_to_their_points(plane):
    compared = compare_maps(np.concatenate([plane, [[5.0, 5.0, 0.7]]]) + UTM, plane + UTM)
    worst = int(compared.map_errors.distances_m.argmax())
    np.testing.assert_allclose(compared.map_errors.points[worst], UTM + np.array([5.0, 5.0, 0.7]), atol=1e-6)
    assert compared.map_errors.distances_m[worst] == pytest.approx(0.7, abs=1e-6)
    assert compared.map_gap_m == pytest.approx(0.1, abs=1e-6)


def test_thinning_keeps_one_actual_point_a_cell(rng):
    points = rng.uniform(-3.0, 3.0, (5_000, 3))
    thinned = first_per_cell(points, 0.5)
    cells = {tuple(cell) for cell in np.floor((points - points.min(axis=0)) / 0.5).astype(int)}
    assert len(thinned) == len(cells)
    assert {tuple(p) for p in thinned} <= {tuple(p) for p in points}


def test_colours_run_from_dark_to_bright_and_stay_there():
    colours = error_colours(np.array([0.0, 0.25, 0.5, 3.0, np.inf])).astype(int)
    np.testing.assert_array_equal(colours[0], [68, 1, 84])
    np.testing.assert_array_equal(colours[2:], [[253, 231, 37]] * 3)
    lightness = error_colours(np.linspace(0.0, 0.5, 50)) @ [0.299, 0.587, 0.114]
    assert (np.diff(lightness) > 0.0).all()


def _slab(rng: np.random.Generator, sigma_m: float) -> FloatArray:
    points = rng.uniform(-2.0, 2.0, (40_000, 3))
    points[:, 2] = rng.normal(0.0, sigma_m, len(points))
    return points


def test_the_entropy_of_a_known_neighbourhood(rng, monkeypatch):
    """In a filled ball of radius r, every coordinate has the variance r^2 / 5."""
    points = rng.uniform(-1.0, 1.0, (60_000, 3))
    inner = points[np.linalg.norm(points, axis=1) < 0.9]
    monkeypatch.setattr("lidarslam.evaluation.map.entropy.SPACING_M", 0.001)
    entropy = map_entropy(inner, most_samples=2_000)
    # Some samples are at the border, where the neighbourhood is part of a ball and smaller.
    assert entropy.mean == pytest.approx(1.5 * np.log(2.0 * np.pi * np.e * 0.3**2 / 5.0), abs=0.3)


def test_a_thicker_wall_has_more(rng):
    crisp, thick = map_entropy(_slab(rng, 0.01)), map_entropy(_slab(rng, 0.04))
    # Only the third axis differs; thinning lets through more of the thicker wall's outer points.
    assert thick.mean - crisp.mean == pytest.approx(np.log(4.0), abs=0.2)


def test_a_flawless_plane_is_finite_and_the_place_does_not_matter(rng):
    x, y = np.meshgrid(0.07 * np.arange(60), 0.07 * np.arange(60))
    plane = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    here, there = map_entropy(plane), map_entropy(plane + np.array([5e5, 5e6, 100.0]))
    assert np.isfinite(here.mean)
    assert there.mean == pytest.approx(here.mean, abs=1e-3)


def test_sparse_points_have_none():
    assert map_entropy(10.0 * np.arange(60.0).reshape(-1, 3)) is None
    assert map_entropy(np.empty((0, 3))) is None
