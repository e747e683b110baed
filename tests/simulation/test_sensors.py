"""Sensors look where their manuals say, in the order of time."""

import numpy as np
import pytest

from lidarslam.simulation.motion import MOUNTS, mount_pose
from lidarslam.simulation.sensors import SENSORS, RisleyPrisms, Spinning, find_sensor

# name: rays a sweep, lasers, lowest and highest elevation in degrees
FACTS = {
    "vlp-16": (28_800, 16, -15.0, 15.0),
    "hdl-32e": (69_440, 32, -30.67, 10.67),
    "hdl-64e": (133_312, 64, -24.33, 2.0),
    "hdl-64e-calibrated": (133_312, 64, -24.30, 1.97),
    "os0-64": (65_536, 64, -45.46, 45.85),
    "os1-64": (65_536, 64, -16.611, 16.611),
    "os1-128": (131_072, 128, -21.82, 20.95),
    "xt32": (64_000, 32, -16.0, 15.0),
    "livox": (20_000, 4, -7.0, 52.0),
    "mid-360": (20_000, 4, -7.0, 52.0),
    "avia": (24_000, 6, -38.6, 38.6),
}


def elevations_deg(directions):
    return np.rad2deg(np.arcsin(directions[:, 2]))


@pytest.mark.parametrize("name", FACTS)
def test_rays_are_as_published(name):
    sensor = find_sensor(name)
    rays_per_scan, lasers, lowest, highest = FACTS[name]
    directions, fractions, rings = sensor.pattern.rays(3)
    assert directions.shape == (rays_per_scan, 3) == (sensor.pattern.columns * sensor.pattern.lasers, 3)
    assert sensor.pattern.lasers == lasers
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    assert (np.diff(fractions) >= 0.0).all()
    assert fractions[0] == 0.0
    assert fractions[-1] < 1.0
    assert rings.dtype == np.int32
    np.testing.assert_array_equal(np.bincount(rings), np.full(lasers, sensor.pattern.columns))
    angles = elevations_deg(directions)
    # The petals of prisms seldom reach the rim at the top and at the bottom.
    atol = 1.0 if isinstance(sensor.pattern, RisleyPrisms) else 0.05
    np.testing.assert_allclose([angles.min(), angles.max()], [lowest, highest], atol=atol)


@pytest.mark.parametrize("name", [name for name in FACTS if isinstance(SENSORS[name].pattern, Spinning)])
def test_a_ring_keeps_its_elevation_and_turns_clockwise(name):
    directions, _, rings = find_sensor(name).pattern.rays(0)
    for ring in (0, rings.max()):
        own = directions[rings == ring]
        assert np.ptp(elevations_deg(own)) < 1e-9
        azimuth = np.unwrap(np.arctan2(own[:, 1], own[:, 0]))
        assert (np.diff(azimuth) < 0.0).all()
        np.testing.assert_allclose(np.ptp(azimuth), 2.0 * np.pi, rtol=2e-3)


def test_vlp_16_fires_by_its_manual():
    """Lasers 0, 1, 2 look at -15, 1 and -13 degrees, 2.304 us apart, and the head turns on between them."""
    directions, fractions, rings = find_sensor("vlp-16").pattern.rays(0)
    np.testing.assert_allclose(elevations_deg(directions[:4]), [-15.0, 1.0, -13.0, 3.0], atol=1e-9)
    np.testing.assert_array_equal(rings[:4], [0, 8, 1, 9])
    np.testing.assert_allclose(np.diff(fractions[:16]) * 1800 * 55.296, 2.304, atol=1e-9)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    np.testing.assert_allclose(azimuth[1] - azimuth[0], -2.0 * np.pi * fractions[1], atol=1e-12)


@pytest.mark.parametrize("name", ["livox", "mid-360", "avia"])
def test_livox_goes_on_and_does_not_repeat(name):
    sensor = find_sensor(name)
    lasers = sensor.pattern.lasers
    sweeps = [sensor.pattern.rays(index).directions for index in range(60)]
    # From the last shot of a sweep to the first of the next it is one step of the pattern.
    steps = np.linalg.norm(sweeps[0][lasers:] - sweeps[0][:-lasers], axis=1)
    assert np.linalg.norm(sweeps[1][0] - sweeps[0][-lasers]) < 1.1 * steps.max()
    assert steps.max() <= sensor.pattern.column_angle * (1.0 + 1e-6)
    for later in sweeps[1:]:
        assert np.median(np.linalg.norm(later - sweeps[0], axis=1)) > 0.05


def test_mounts_turn_the_sensor():
    up = {name: mount_pose(name, 1.5)[:3, 2] for name in MOUNTS}
    np.testing.assert_allclose(up["upright"], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(up["upside-down"], [0.0, 0.0, -1.0], atol=1e-12)
    assert 0.8 < up["tilted"][2] < 0.95
    assert mount_pose("tilted", 1.5)[0, 0] > 0.0
    assert mount_pose("tilted", 1.5)[2, 0] < 0.0  # looks down to the front
    for name in MOUNTS:
        np.testing.assert_array_equal(mount_pose(name, 1.5)[:3, 3], [0.0, 0.0, 1.5])
