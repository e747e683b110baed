"""Simulated drives, the mapper along them, and how far its poses are off."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle
from lidarslam.core.scan import Scan
from lidarslam.mapping.localization.map_localiser import MapLocaliser
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.simulation.motion import mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import Sensor, Spinning, find_sensor
from lidarslam.simulation.world import World, build_world

NOTHING = Prior()


def light(name: str = "vlp-16") -> Sensor:
    """A sensor with a quarter of its columns, for speed."""
    sensor = find_sensor(name)
    assert isinstance(sensor.pattern, Spinning)
    return replace(sensor, pattern=replace(sensor.pattern, columns=sensor.pattern.columns // 4))


def simulated(place: World | str, carrier: str, sensor: Sensor, scans: int, seed: int = 0) -> Simulation:
    """A carrier on its route through a world, its sensor upright."""
    world = build_world(place, seed) if isinstance(place, str) else place
    motion = motion_along_route(carrier, world, seed)
    return Simulation(world, sensor, motion, mount_pose("upright", motion.sensor_height_m), scans, seed=seed)


def process(
    mapper: Mapper | MapLocaliser, scans: Sequence[Scan], priors: Sequence[Prior] | None = None
) -> list[MappedScan]:
    """What the mapper makes of scans, without an odometry unless its motions are given."""
    told = priors or [NOTHING] * len(scans)
    return [mapper.process(mapper.sample(scan), prior) for scan, prior in zip(scans, told, strict=True)]


def poses_of(results: Sequence[MappedScan]) -> FloatArray:
    """(N, 4, 4)."""
    return np.array([result.state.T_world_lidar for result in results])


def errors(found: FloatArray, true: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (N,) in metres and angles (N,) in degrees between poses (N, 4, 4)."""
    off = inverse(true) @ found
    return np.linalg.norm(off[..., :3, 3], axis=-1), np.rad2deg(rotation_angle(off))


def assert_near(found: FloatArray, true: FloatArray, metres: float, degrees: float | None = None) -> None:
    """No pose (4, 4) or (N, 4, 4) is off by more, by default as many radians as metres."""
    assert np.shape(found) == np.shape(true) or np.ndim(true) == 2
    off_m, off_deg = errors(found, true)
    assert np.max(off_m) < metres
    assert np.max(off_deg) < (np.rad2deg(metres) if degrees is None else degrees)
