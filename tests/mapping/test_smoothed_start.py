"""The motions of the first scans, of simulated sensors whose motion is known."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, inverse, log
from lidarslam.core.scan import Scan
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.smoothed_start import SMOOTHED, smoothed_start
from lidarslam.simulation.motion import mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.world import build_world


def walk(sensor: str, start: int, count: int = 25, name: str = "office") -> tuple[list[Scan], FloatArray]:
    """Scans of a legged robot, and the motions (N, 4, 4) between them."""
    world = build_world(name, 1)
    motion = motion_along_route("legged", world, 1)
    simulation = Simulation(world, find_sensor(sensor), motion, mount_pose("upright", motion.sensor_height_m), 200)
    scans = list(simulation.scans(start, start + count))
    T_map_lidar = simulation.ground_truth.at(np.array([scan.stamp for scan in scans]), 0.2)
    return scans, np.asarray(inverse(T_map_lidar[:-1]) @ T_map_lidar[1:], dtype=np.float64)


@pytest.fixture(scope="module")
def strokes() -> tuple[list[Scan], FloatArray]:
    """Scans of a sensor without rings, and their motions."""
    return walk("mid-360", 40)


@pytest.mark.long
def test_motions_of_a_sensor_without_rings_are_true(strokes):
    scans, truth = strokes
    smoothed = smoothed_start(scans, MappingConfig())
    assert list(smoothed) == [scan.stamp for scan in scans[1:SMOOTHED]]
    for motion, T_true in zip(smoothed.values(), truth, strict=False):
        error = inverse(T_true) @ motion.T_prev_curr
        assert np.linalg.norm(error[:3, 3]) < 0.04
        assert motion.velocity == pytest.approx(log(motion.T_prev_curr) / 0.1)


@pytest.mark.long
def test_registration_in_order_suffices_where_a_sweep_makes_a_map():
    scans, _ = walk("os0-64", 40, 10)
    assert smoothed_start(iter(scans), MappingConfig()) == {}


@pytest.mark.slow  # registers forty scans of a Mid-360
def test_nothing_is_smoothed_across_another_place(strokes):
    scans, _ = strokes
    elsewhere, _ = walk("mid-360", 40, name="tunnel")
    assert smoothed_start(scans[:12] + elsewhere[12:], MappingConfig()) == {}


def test_too_few_scans_are_left_as_they_are(strokes):
    scans, _ = strokes
    assert smoothed_start(scans[:5], MappingConfig()) == {}
    assert smoothed_start([], MappingConfig()) == {}
