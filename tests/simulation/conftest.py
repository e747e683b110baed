"""A small world whose surfaces have formulas, and the distance to them; the program's worlds, and rays cast in them."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, rotation_z
from lidarslam.core.scan import Scan
from lidarslam.simulation.mesh import Caster
from lidarslam.simulation.motion import mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import RangeModel, find_sensor
from lidarslam.simulation.world import Boxes, Cylinders, HeightField, Mover, Route, World, build_world

EXACT = RangeModel(0.3, 100.0, 0.0, 0.0, 0.0, 1e-9, dropout=0.0)

cached_world = cache(build_world)


@cache
def caster_of(name: str, seed: int) -> Caster:
    return Caster(cached_world(name, seed))


def cast(caster: Caster, origins: FloatArray, direction: FloatArray) -> FloatArray:
    """Distances (N,) along unit vectors (3,) or (N, 3) to what stands still, infinite where nothing is hit."""
    rays = np.broadcast_to(direction, origins.shape)
    return caster.cast(origins, rays, np.zeros(0), np.inf).ranges


def simulation_in(world: World, carrier: str, height_m: float, scans: int) -> Simulation:
    motion = motion_along_route(carrier, world, seed=2)
    return Simulation(world, find_sensor("vlp-16"), motion, mount_pose("upright", height_m), scans, seed=5)


def in_world(simulation: Simulation, scan: Scan) -> FloatArray:
    """The points (N, 3) of a scan, each by the true pose at its own time."""
    T = simulation.T_world_lidar_at(scan.stamp + scan.time_offsets)
    return np.einsum("nij,nj->ni", T[:, :3, :3], scan.points) + T[:, :3, 3]


@pytest.fixture(scope="session")
def yard() -> World:
    """A rolling yard of 60 x 50 m within walls, with blocks, poles and a car that goes round.

    The ground is soft hills with the middle free for a route of 28 x 18 m.
    """
    x, y = np.meshgrid(np.linspace(-35.0, 35.0, 141), np.linspace(-30.0, 30.0, 121), indexing="ij")
    heights = 0.5 * np.sin(x / 7.0) * np.cos(y / 6.0) + 0.02 * x
    ground = HeightField(np.array([-35.0, -30.0]), 0.5, heights)
    walls = [((30, 0), (0.2, 25)), ((-30, 0), (0.2, 25)), ((0, 25), (30, 0.2)), ((0, -25), (30, 0.2))]
    blocks = [((0, 0), (6, 3)), ((20, 18), (3, 2)), ((-21, -17), (2, 3)), ((22, -16), (1.5, 1.5))]
    centres = np.array([[*xy, 1.0] for xy, _ in walls + blocks], dtype=float)
    half_sizes = np.array([[*size, 4.0] for _, size in walls + blocks], dtype=float)
    turns = np.stack([np.eye(3)] * 4 + [rotation_z(0.3 * k) for k in range(4)])
    feet = np.array([[18.0, 4.0, -2.0], [-18.0, 5.0, -2.0], [4.0, 14.0, -2.0], [-6.0, -15.0, -2.0]])
    poles = Cylinders(feet, feet + np.array([0.0, 0.0, 7.0]), np.array([0.15, 0.3, 0.2, 0.4]))
    car = Boxes(np.array([[0.0, 0.0, 0.7]]), np.array([[2.0, 0.9, 0.7]]), np.eye(3)[None])
    lap = np.array([[26.0, 21.0, 0.0], [-26.0, 21.0, 0.0], [-26.0, -21.0, 0.0], [26.0, -21.0, 0.0]])
    mover = Mover(car, lap, speed_mps=5.0, start_m=15.0)
    corners = np.array([[14.0, 9.0], [-14.0, 9.0], [-14.0, -9.0], [14.0, -9.0]])
    route = Route(np.column_stack([corners, ground.height_at(corners)]), 4.0, 2.0, 10.0, 10.0)
    return World("yard", 0, route, Boxes(centres, half_sizes, turns), poles, (ground,), (mover,))


@pytest.fixture(scope="session")
def distance_to_yard(yard: World) -> Callable[[FloatArray], FloatArray]:
    """Distance (N,) of points (N, 3) to the nearest surface of the yard that stands still."""

    def distance(points: FloatArray) -> FloatArray:
        nearest = np.full(len(points), np.inf)
        for centre, half, R in zip(yard.boxes.centres, yard.boxes.half_sizes, yard.boxes.R_world_box, strict=True):
            outside = np.abs((points - centre) @ R) - half
            gap = np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(axis=1), 0.0)
            nearest = np.minimum(nearest, np.abs(gap))
        for start, end, radius in zip(yard.cylinders.starts, yard.cylinders.ends, yard.cylinders.radii, strict=True):
            away = np.linalg.norm((points - start)[:, :2], axis=1)
            top = np.hypot(np.maximum(away - radius, 0.0), points[:, 2] - end[2])
            # The mesh has 24 flat sides, within 0.6 % of the radius of the round one.
            side = np.maximum(np.abs(away - radius) - 0.006 * radius, 0.0)
            nearest = np.minimum(nearest, np.minimum(side, top))
        above = np.abs(points[:, 2] - yard.ground_at(points[:, :2]))
        return np.minimum(nearest, above)  # of the ground an upper bound, and the hills are soft

    return distance
