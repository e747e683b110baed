"""What is left of a scan, and how the cells follow the scene."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.registration.sampled_scan import SampledScan, Sampler, has_rings
from lidarslam.simulation.sensors import SENSORS


def shell(rng: np.random.Generator, radius_m: float, count: int = 20_000, stamp: float = 0.0) -> Scan:
    """Points at about one range all around; their times and rings tell which point it was."""
    points = rng.normal(size=(count, 3))
    points *= radius_m * rng.uniform(0.9, 1.1, (count, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    return Scan(points, stamp, 1e-6 * np.arange(count))


def sample(scan: Scan, **settings: object) -> SampledScan:
    return Sampler(MappingConfig(**settings)).sample(scan)


def cells(points: FloatArray, cell_m: float) -> FloatArray:
    return np.floor(points.astype(np.float32) * np.float32(1.0 / cell_m))


def test_at_most_one_point_goes_into_the_map_from_each_half_cell(rng):
    scan = shell(rng, 5.0, 50_000)
    sampled = sample(scan, cell_m=0.4)
    assert len(np.unique(cells(sampled.sweep.points, 0.2), axis=0)) == len(sampled)
    assert len(sampled) > 0.95 * len(np.unique(cells(scan.points, 0.2), axis=0))


def test_registered_points_are_spread_wider(rng):
    sampled = sample(shell(rng, 5.0, 50_000), cell_m=0.1, keypoints=100_000)
    keys = sampled.keypoints.points
    assert 100 < len(keys) < len(sampled)
    assert len(np.unique(cells(keys, 0.25), axis=0)) == len(keys)


@pytest.mark.parametrize("keypoints", [100, 2_000])
def test_no_more_points_are_registered_than_wanted_and_they_come_from_everywhere(rng, keypoints):
    sampled = sample(shell(rng, 5.0), cell_m=0.05, keypoints=keypoints)
    keys = sampled.keypoints.points
    assert len(keys) == keypoints
    assert len(np.unique(keys, axis=0)) == keypoints
    np.testing.assert_allclose((keys > 0.0).mean(axis=0), 0.5, atol=0.15)


def test_only_points_within_range_are_left(rng):
    points = rng.normal(size=(20_000, 3))
    points *= rng.uniform(0.1, 20.0, (20_000, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    sampled = sample(Scan(points, 0.0), cell_m=0.1, min_range_m=2.0, max_range_m=10.0)
    ranges = np.linalg.norm(sampled.sweep.points, axis=1)
    assert 2.0 < ranges.min() < 2.2
    assert 9.8 < ranges.max() < 10.0


def test_times_and_elevations_stay_with_their_points(rng):
    scan = shell(rng, 5.0)
    sampled = sample(scan, cell_m=0.3, min_range_m=4.7, keypoints=150)
    for sweep in (sampled.sweep, sampled.keypoints):
        np.testing.assert_array_equal(sweep.points, scan.points[np.round(1e6 * sweep.times).astype(int)])
    upward = np.hypot(sampled.sweep.points[:, 0], sampled.sweep.points[:, 1])
    np.testing.assert_allclose(sampled.elevations, np.arctan2(sampled.sweep.points[:, 2], upward), atol=1e-12)


def test_nothing_is_sampled_from_nothing(rng):
    sampler = Sampler(MappingConfig())
    sampled = sampler.sample(Scan(np.empty((0, 3)), 0.0, np.empty(0)))
    assert len(sampled) == len(sampled.keypoints) == 0
    assert sampled.is_sparse
    assert sampled.cell_m > 0.0
    assert sampler.sample(shell(rng, 12.0)).cell_m == pytest.approx(0.4, rel=0.02), "it decided on no cells"


@pytest.mark.parametrize(("radius_m", "cell_m"), [(6.0, 0.2), (24.0, 0.8), (0.6, 0.05), (60.0, 1.0)])
def test_cells_are_a_share_of_the_median_range_within_bounds(rng, radius_m, cell_m):
    assert sample(shell(rng, radius_m)).cell_m == pytest.approx(cell_m, rel=0.02)


@pytest.mark.parametrize(("spacing_deg", "rings", "per_range"), [
    (0.4, 64, 30.0), (2.0, 16, 30.0), (4.0, 8, 1.4 / np.deg2rad(4.0)), (5.6, 16, 19.0)
])  # fmt: skip
def test_cells_are_larger_where_rings_are_farther_apart(spacing_deg, rings, per_range):
    assert sample(ringed_shell(spacing_deg, rings, 12.0)).cell_m == pytest.approx(12.0 / per_range, rel=0.02)


def test_where_walls_are_close_there_are_larger_cells_for_sparse_rings():
    assert sample(ringed_shell(2.0, 16, 1.3)).cells_m == pytest.approx((0.05, 0.1, 0.2, 0.4))
    assert sample(ringed_shell(0.4, 64, 1.3)).cells_m == pytest.approx((0.05, 0.1, 0.2))
    assert sample(ringed_shell(2.0, 16, 6.0)).cells_m == pytest.approx((0.2, 0.4, 0.8), rel=0.02)


def ringed_shell(spacing_deg: float, rings: int, radius_m: float) -> Scan:
    elevation = np.deg2rad(spacing_deg * (np.arange(rings) - 0.5 * (rings - 1))).repeat(300)
    azimuth = np.tile(np.linspace(0.0, 2.0 * np.pi, 300, endpoint=False), rings)
    flat = np.cos(elevation)
    points = radius_m * np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    return Scan(points, 0.0)


def test_a_given_cell_stays_whatever_the_scene(rng):
    sampler = Sampler(MappingConfig(cell_m=0.33))
    assert {sampler.sample(shell(rng, radius_m, 500)).cell_m for radius_m in (1.0, 40.0, 5.0)} == {0.33}


def cell_sizes(rng: np.random.Generator, radii_m: list[float]) -> list[float]:
    sampler = Sampler(MappingConfig())
    return [sampler.sample(shell(rng, radius_m, 500)).cell_m for radius_m in radii_m]


def test_a_scene_that_changes_by_less_than_two_keeps_its_cells(rng):
    """Nor does one scan of another scale change them."""
    sizes = cell_sizes(rng, [6.0] * 10 + [60.0] + [10.5] * 100 + [3.6] * 100 + [10.5] * 100)
    assert len(set(sizes)) == 1


@pytest.mark.parametrize(("before_m", "after_m"), [(6.0, 14.0), (14.0, 6.0)])
def test_a_scene_that_has_changed_by_more_has_other_cells_in_the_end(rng, before_m, after_m):
    sizes = cell_sizes(rng, [before_m] + [after_m] * 120)
    assert len(set(sizes)) == 2, "it changes once"
    assert sizes[-1] == pytest.approx(after_m / 30.0, rel=0.25)


@pytest.mark.parametrize("numbered", [False, True])
@pytest.mark.parametrize("name", [name for name in SENSORS if name != "livox"])
def test_strokes_are_told_from_rings(name, numbered):
    """Livox's drivers number the lasers, too."""
    rays = SENSORS[name].pattern.rays(3)
    scan = Scan(10.0 * rays.directions, 0.3, 0.1 * rays.fractions, rays.rings if numbered else None)
    assert has_rings(scan) == (SENSORS[name].driver != "livox")


def test_points_of_strokes_have_no_elevations():
    rays = SENSORS["mid-360"].pattern.rays(0)
    sampled = sample(Scan(10.0 * rays.directions, 0.0, 0.1 * rays.fractions))
    assert not sampled.has_rings
    assert not sampled.elevations.any()
