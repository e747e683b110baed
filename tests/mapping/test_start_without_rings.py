"""A drone that takes off with a Mid-360: a single sweep of strokes makes no map."""

import numpy as np
import pytest

from lidarslam.core.geometry import inverse
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.smoothed_start import smoothed_start
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.simulation.motion import mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.world import build_world


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_drone_takes_off(seed):
    world = build_world("street", seed)
    motion = motion_along_route("drone-agile", world, seed)
    T_body_lidar = mount_pose("upright", motion.sensor_height_m)
    simulation = Simulation(world, find_sensor("mid-360"), motion, T_body_lidar, 30, seed=seed)
    scans, mapper = list(simulation.scans()), Mapper(MappingConfig())
    smoothed = smoothed_start(scans, MappingConfig())
    results = []
    for scan in scans:
        motion = smoothed.get(scan.stamp)
        prior = Prior() if motion is None else Prior(motion.T_prev_curr, motion.velocity, motion.covariance)
        results.append(mapper.process(mapper.sample(scan), prior))
    T_map_lidar = simulation.ground_truth.at(np.array([scan.stamp for scan in scans]), 0.2)
    estimated = np.array([result.state.T_world_lidar for result in results])
    steps = inverse(inverse(T_map_lidar[:-1]) @ T_map_lidar[1:]) @ inverse(estimated[:-1]) @ estimated[1:]
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.1
    assert np.linalg.norm((inverse(T_map_lidar[0]) @ T_map_lidar[-1] - estimated[-1])[:3, 3]) < 0.5
    assert Status.LOST not in {result.status for result in results}
