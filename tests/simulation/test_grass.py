"""Rays end among blades as often and as deep as Beer and Lambert's law has it."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.simulation.noise import ranges_in_grass
from lidarslam.simulation.reference_map import reference_map
from lidarslam.simulation.world import Grass, HeightField

from .conftest import EXACT, in_world, simulation_in

HEIGHT_M = 0.2
LAWN = Grass(HeightField(np.array([-500.0, -500.0]), 1000.0, np.full((2, 2), HEIGHT_M)), 0.3)


@pytest.fixture(scope="module")
def simulation(yard):
    grown = simulation_in(replace(yard, movers=(), grass=LAWN), "car", 1.73, 50)
    return replace(grown, sensor=replace(grown.sensor, ranging=EXACT))


@pytest.mark.parametrize("cosine", [1.0, 0.3, 0.06])
def test_the_law(cosine, rng):
    count = 40_000
    ranges, is_blade = ranges_in_grass(LAWN, np.zeros((count, 3)), np.full(count, 50.0), np.full(count, cosine), rng)
    # Tips are evenly distributed between half the height and all of it.
    tips = HEIGHT_M * np.linspace(0.5, 1.0, 1001) / cosine
    assert is_blade.mean() == pytest.approx((1.0 - np.exp(-tips / 0.3)).mean(), abs=0.01)
    assert (ranges[~is_blade] == 50.0).all()
    depth = 50.0 - ranges[is_blade]
    assert 0.0 <= depth.min() <= depth.max() <= tips.max()


def test_a_scan_ends_above_the_ground_within_the_grass(simulation):
    sweep = simulation.scan(30)
    points = in_world(simulation, sweep.scan)
    ranges = np.linalg.norm(sweep.scan.points, axis=1)
    is_shortened = ranges < sweep.true_ranges - 1e-3
    above = points[is_shortened, 2] - simulation.world.ground_at(points[is_shortened, :2])
    assert 0.1 < is_shortened.mean() < 0.9
    assert above.min() > -0.05  # the hills are soft, so that the grass follows them
    assert above.max() < HEIGHT_M + 0.05
    assert np.median(above) > 0.05
    is_near = ranges < 8.0
    assert is_shortened[is_near].mean() < is_shortened[~is_near & is_shortened | (ranges < 30.0) & ~is_near].mean()
    np.testing.assert_array_equal(simulation.scan(30).scan.points, sweep.scan.points)


def test_the_reference_map_is_of_the_ground(simulation):
    mown = replace(simulation, world=replace(simulation.world, grass=None))
    np.testing.assert_array_equal(reference_map(simulation, step=25).points, reference_map(mown, step=25).points)
