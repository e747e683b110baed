"""Scans put back by the true poses lie on the world's surfaces or above them in grass; a seed gives the same bytes."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import transform_points
from lidarslam.simulation.motion import mount_pose
from lidarslam.simulation.noise import bloom, measure, range_sigma, ranges_in_grass
from lidarslam.simulation.reference_map import reference_map
from lidarslam.simulation.sensors import RangeModel, find_sensor
from lidarslam.simulation.world import Grass, HeightField

from .conftest import EXACT, in_world, simulation_in

NOISY = RangeModel(0.3, 100.0, 0.01, 0.0003, 0.003, 0.002)


@pytest.fixture(scope="module")
def simulation(yard):
    return simulation_in(yard, "tracked-harsh", 0.6, 300)


def same_bytes(a, b):
    arrays = [(s.scan.points, s.scan.time_offsets, s.scan.rings, s.intensities) for s in (a, b)]
    return all(x.tobytes() == y.tobytes() for x, y in zip(*arrays, strict=True))


@pytest.mark.parametrize("sensor", ["vlp-16", "os1-64", "livox"])
@pytest.mark.parametrize("mount", ["upright", "tilted"])
def test_exact_scans_lie_on_the_surfaces(sensor, mount, simulation, distance_to_yard):
    model = replace(find_sensor(sensor), ranging=EXACT)
    simulated = replace(simulation, sensor=model, T_body_lidar=mount_pose(mount, 0.6))
    for index in (0, 120):
        sweep = simulated.scan(index)
        points = in_world(simulated, sweep.scan)[~sweep.moving]
        assert len(points) > 3000
        assert distance_to_yard(points).max() < 1e-3


def test_the_sweep_rolls(simulation, distance_to_yard):
    """With one pose for the whole sweep the points are far off when the sensor turns, here fastest."""
    yaw = np.unwrap(np.arctan2(*simulation.ground_truth.T_world_lidar[:, [1, 0], 0].T))
    turning = int(np.abs(np.diff(yaw)).argmax())
    simulated = replace(simulation, sensor=replace(simulation.sensor, ranging=EXACT))
    sweep = simulated.scan(turning)
    still = transform_points(simulated.ground_truth.T_world_lidar[turning], sweep.scan.points)
    assert np.quantile(distance_to_yard(still[~sweep.moving]), 0.75) > 0.2
    assert distance_to_yard(in_world(simulated, sweep.scan)[~sweep.moving]).max() < 1e-3


def test_noise_stays_within_five_sigma(simulation):
    model = replace(NOISY, beam_divergence=0.0)
    noisy = replace(simulation, sensor=replace(simulation.sensor, ranging=model))
    sweep = noisy.scan(50)
    errors = np.linalg.norm(sweep.scan.points, axis=1) - sweep.true_ranges
    sigma = range_sigma(model, sweep.true_ranges, np.ones(len(errors)))
    assert np.abs(errors / sigma).max() < 5.0
    np.testing.assert_allclose(np.std(errors / sigma), 1.0, atol=0.03)
    assert abs(np.mean(errors / sigma)) < 0.03


def test_scan_is_what_a_driver_delivers(simulation):
    sweep = simulation.scan(7)
    scan = sweep.scan
    assert scan.stamp == pytest.approx(0.7)
    assert scan.time_offsets.min() >= 0.0
    assert scan.time_offsets.max() < 0.1
    assert (np.diff(scan.time_offsets) >= 0.0).all()
    np.testing.assert_array_equal(scan.points, scan.points.astype(np.float32))
    assert scan.rings.dtype == np.int32
    assert sweep.intensities.dtype == np.float32
    assert 0.0 <= sweep.intensities.min() < sweep.intensities.max() <= 255.0
    assert 0.5 * 28_800 < len(scan) < 28_800
    assert len(sweep.true_ranges) == len(sweep.moving) == len(scan)


def test_same_seed_same_bytes_in_any_order(simulation):
    again = replace(simulation)
    later = again.scan(9)
    for index in (3, 9, 4):
        assert same_bytes(simulation.scan(index), again.scan(index))
    assert same_bytes(simulation.scan(9), later)
    assert not same_bytes(simulation.scan(9), replace(simulation, seed=6).scan(9))


def test_is_a_scan_sequence(simulation):
    assert len(simulation) == 300
    assert "yard" in simulation.name
    stamps = [scan.stamp for scan in simulation.scans(10, 20, 4)]
    np.testing.assert_allclose(stamps, [1.0, 1.4, 1.8])
    truth = simulation.ground_truth
    assert len(truth) == 300
    np.testing.assert_allclose(truth.T_world_lidar[10:20:4], simulation.T_world_lidar_at(np.array(stamps)), atol=1e-12)
    assert next(simulation.scans(299)).stamp == pytest.approx(29.9)


def test_dropouts_happen_at_their_rate():
    n = 100_000
    measured = measure(NOISY, np.full(n, 10.0), np.ones(n), np.full(n, 0.8), np.random.default_rng([1, 2]))
    assert abs(np.isinf(measured).mean() - 0.005) < 0.001
    inside = measured[np.isfinite(measured)]
    np.testing.assert_allclose(inside / 0.002, np.round(inside / 0.002), atol=1e-6)


def test_edges_bloom():
    """A pole 8 columns wide before a wall: only the columns beside it change, at the rate of the beam's width."""
    columns, lasers = 2000, 16
    ranges = np.full((columns, lasers), 20.0)
    ranges[500:508] = 5.0
    ranges[1000:1500] = np.inf
    model = replace(NOISY, beam_divergence=0.003)
    flat = ranges.ravel()
    trials = [bloom(model, flat, lasers, 2.0 * np.pi / columns, np.random.default_rng([k, 0])) for k in range(200)]
    changed = np.mean([edge.reshape(columns, lasers) for _, edge in trials], axis=(0, 2))
    assert set(np.flatnonzero(changed)) == {499, 508, 1000, 1499}
    np.testing.assert_allclose(changed[[499, 508, 1000]], 0.003 / (4.0 * np.pi / columns), atol=0.03)
    bloomed, edge = trials[0]
    assert set(bloomed[edge]) <= {5.0, 20.0}
    np.testing.assert_array_equal(bloomed[~edge], flat[~edge])


GRASS_M = 0.2
LAWN = Grass(HeightField(np.array([-500.0, -500.0]), 1000.0, np.full((2, 2), GRASS_M)), 0.3)


@pytest.fixture(scope="module")
def meadow(yard):
    grown = simulation_in(replace(yard, movers=(), grass=LAWN), "car", 1.73, 50)
    return replace(grown, sensor=replace(grown.sensor, ranging=EXACT))


@pytest.mark.parametrize("cosine", [1.0, 0.3, 0.06])
def test_rays_end_among_blades_as_beer_and_lambert_have_it(cosine, rng):
    count = 40_000
    ranges, is_blade = ranges_in_grass(LAWN, np.zeros((count, 3)), np.full(count, 50.0), np.full(count, cosine), rng)
    # Tips are evenly distributed between half the height and all of it.
    tips = GRASS_M * np.linspace(0.5, 1.0, 1001) / cosine
    assert is_blade.mean() == pytest.approx((1.0 - np.exp(-tips / 0.3)).mean(), abs=0.01)
    assert (ranges[~is_blade] == 50.0).all()
    depth = 50.0 - ranges[is_blade]
    assert 0.0 <= depth.min() <= depth.max() <= tips.max()


def test_a_scan_ends_above_the_ground_within_the_grass(meadow):
    sweep = meadow.scan(30)
    points = in_world(meadow, sweep.scan)
    ranges = np.linalg.norm(sweep.scan.points, axis=1)
    is_shortened = ranges < sweep.true_ranges - 1e-3
    above = points[is_shortened, 2] - meadow.world.ground_at(points[is_shortened, :2])
    assert 0.1 < is_shortened.mean() < 0.9
    assert above.min() > -0.05  # the hills are soft, so that the grass follows them
    assert above.max() < GRASS_M + 0.05
    assert np.median(above) > 0.05
    is_near = ranges < 8.0
    assert is_shortened[is_near].mean() < is_shortened[~is_near & is_shortened | (ranges < 30.0) & ~is_near].mean()
    np.testing.assert_array_equal(meadow.scan(30).scan.points, sweep.scan.points)


def test_the_reference_map_is_of_the_ground(meadow):
    mown = replace(meadow, world=replace(meadow.world, grass=None))
    np.testing.assert_array_equal(reference_map(meadow, step=25).points, reference_map(mown, step=25).points)
