"""Corridor, stairs and crowd have the measures they are named for, and their people walk as they should."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.caster import Caster
from lidarslam.simulation.motion import Sway, mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.world import World, build_world
from lidarslam.simulation.worlds.crowd import COMPANIONS, CROSSING, SPEED_MPS, STANDING
from lidarslam.simulation.worlds.paths import subdivide_loop

SEEDS = (0, 1, 2)
RISE_M, TREAD_M = 0.17, 0.28
world_of, each_seed = cache(build_world), pytest.mark.parametrize("seed", SEEDS)
LEFT, RIGHT, UP, DOWN = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])


@cache
def caster_of(name: str, seed: int) -> Caster:
    return Caster(world_of(name, seed))


def cast(name: str, seed: int, origins: FloatArray, direction: FloatArray) -> FloatArray:
    """Distances (N,) from origins (N, 3) to the nearest static surface in one direction (3,)."""
    rays = np.broadcast_to(direction, origins.shape)
    return caster_of(name, seed).cast(origins, rays, np.zeros(0), 200.0).ranges


def corridor_length(world: World) -> float:
    return 1.2 - float(world.route.waypoints[:, 0].min())


@each_seed
def test_a_corridor_is_two_metres_wide_and_has_boxes_along_its_walls(seed: int) -> None:
    length = corridor_length(world_of("corridor", seed))
    assert 24.0 <= length <= 40.0
    x = np.arange(0.02 - length, -0.02, 0.02)
    high = np.column_stack([x, np.zeros(len(x)), np.full(len(x), 1.2)])
    for sideways in (LEFT, RIGHT):
        np.testing.assert_allclose(cast("corridor", seed, high, sideways), 1.0, atol=1e-3)
    np.testing.assert_allclose(cast("corridor", seed, high, UP), 1.4, atol=1e-3)
    np.testing.assert_allclose(cast("corridor", seed, high, DOWN), 1.2, atol=1e-3)
    low = high - [0.0, 0.0, 1.0]
    widths = np.stack([cast("corridor", seed, low, sideways) for sideways in (LEFT, RIGHT)])
    assert widths.min() > 0.54
    runs = np.diff(np.pad(widths < 0.9, ((0, 0), (1, 1))).astype(int), axis=1)
    starts, stops = (np.argwhere(runs == sign) for sign in (1, -1))
    assert len(starts) == 12
    sizes = 0.02 * (stops - starts)[:, 1]
    assert sizes.min() > 0.25
    assert sizes.max() < 0.85


@each_seed
def test_a_corridor_opens_into_a_yard_and_recordings_begin_deep_in_it(seed: int) -> None:
    world = world_of("corridor", seed)
    length, waypoints = corridor_length(world), world.route.waypoints
    mouth = np.array([[-0.5, 0.0, 1.2]])
    ahead = cast("corridor", seed, mouth, np.array([1.0, 0.0, 0.0]))
    assert 5.0 < ahead[0] < 41.0  # a tree may stand before the far side
    assert np.ptp(waypoints[:, 1]) > 13.0
    motion = motion_along_route("handheld", world, seed)
    start, later = motion.pose_at(np.array([0.0, 8.0]))[:, :3, 3]
    assert -0.7 * length < start[0] < -0.5 * length
    assert later[0] > start[0] + 3.0  # on its way out
    np.testing.assert_array_equal(waypoints[:, 2], world.ground_at(waypoints[:, :2]))


@each_seed
def test_nothing_stands_on_the_way_through_the_corridor(seed: int) -> None:
    world = world_of("corridor", seed)
    points = subdivide_loop(world.route.waypoints, 0.1)
    for height in np.linspace(0.2, world.route.free_height_m - 0.1, 6):
        for angle in np.linspace(0.0, 2.0 * np.pi, 17)[:-1]:
            level = np.array([np.cos(angle), np.sin(angle), 0.0])
            assert cast("corridor", seed, points + height * UP, level).min() > world.route.free_side_m
    assert (cast("corridor", seed, points + 0.2 * UP, UP) > world.route.free_height_m - 0.2).all()


@each_seed
def test_all_steps_of_the_stairs_are_equal(seed: int) -> None:
    """Treads found by rays from above the way up, flight by flight."""
    waypoints = world_of("stairs", seed).route.waypoints
    climbs = [(a, b) for a, b in pairwise(waypoints) if b[2] > a[2] + 0.1]
    assert len(climbs) in (8, 10, 12)
    for foot, head in climbs:
        steps = round((head[2] - foot[2]) / RISE_M)
        middles = foot + (np.arange(steps + 1) / steps)[:, None] * (head - foot)
        np.testing.assert_allclose(np.abs(middles[-1] - middles[0])[0], steps * TREAD_M)
        middles[-1] -= 0.1 * TREAD_M * (head - foot) / np.linalg.norm(head - foot)
        # The mean line crosses every tread in its middle.
        treads = middles[:, 2] + 1.0 - cast("stairs", seed, middles + UP, DOWN)
        np.testing.assert_allclose(treads - foot[2], RISE_M * np.arange(steps + 1), atol=2e-3)


@each_seed
def test_a_carrier_climbs_the_stairs_smoothly_and_comes_down_again(seed: int) -> None:
    world = world_of("stairs", seed)
    motion = replace(motion_along_route("handheld", world, seed), sway=Sway())
    times = np.arange(0.0, motion.duration_s, 0.01)
    z = motion.pose_at(times)[:, 2, 3]
    assert z.max() == pytest.approx(world.route.waypoints[:, 2].max(), abs=0.05)
    assert z.max() > 4 * 2 * 9 * RISE_M - 0.05
    assert abs(z[0]) < 1e-9
    assert abs(z[-1]) < 1e-9
    climb = np.gradient(z, times)
    assert 0.4 < np.abs(climb).max() < 0.55
    assert np.abs(np.gradient(climb, times)).max() < 1.0
    level = np.linalg.norm(np.diff(motion.pose_at(times)[:, :2, 3], axis=0), axis=1)
    steep = np.abs(climb[1:]) > 0.35
    assert np.median(np.abs(np.diff(z))[steep] / level[steep]) == pytest.approx(RISE_M / TREAD_M, rel=0.01)


@each_seed
def test_a_crowd_is_around_the_start_and_half_of_it_goes_along(seed: int) -> None:
    world = world_of("crowd", seed)
    motion = motion_along_route("handheld", world, seed)
    assert len(world.movers) == COMPANIONS + STANDING + CROSSING == 30
    times = np.arange(0.0, 8.0, 0.5)
    carrier = motion.pose_at(times)[:, :3, 3]
    people = np.stack([mover.pose_at(times)[:, :3, 3] for mover in world.movers])
    apart = np.linalg.norm((people - carrier)[..., :2], axis=2)
    assert apart[:, 0].max() < 13.0
    assert np.median(apart[:, 0]) < 6.0
    beside = apart[:COMPANIONS, times > 3.5]
    assert np.ptp(beside, axis=1).max() < 1.0
    assert beside.max() < 8.5
    assert apart[:, times > 1.0].min() > world.route.free_side_m


@each_seed
def test_people_are_displaced_by_their_speed_times_the_time(seed: int) -> None:
    movers = world_of("crowd", seed).movers
    times = np.linspace(0.0, 30.0, 3001)
    for number, mover in enumerate(movers):
        steps = np.linalg.norm(np.diff(mover.pose_at(times)[:, :3, 3], axis=0), axis=1)
        expected = SPEED_MPS if number < COMPANIONS else mover.speed_mps
        np.testing.assert_allclose(np.median(steps), 0.01 * expected, atol=1e-9)
        assert (steps.sum() == 0.0) == (COMPANIONS <= number < COMPANIONS + STANDING)
        top = (mover.boxes.centres + mover.boxes.half_sizes)[:, 2].max()
        assert 1.5 < top < 1.9


def test_many_rays_of_a_crowds_first_scan_end_at_people() -> None:
    world = world_of("crowd", 0)
    motion = motion_along_route("handheld", world, 0)
    T_body_lidar = mount_pose("upright", motion.sensor_height_m)
    sweep = Simulation(world, find_sensor("vlp-16"), motion, T_body_lidar, 2).scan(0)
    assert sweep.moving is not None
    assert 0.1 < sweep.moving.mean() < 0.7


@pytest.mark.parametrize("name", ["mid-360", "avia"])
def test_points_of_sensors_without_rings_carry_none(name: str) -> None:
    world = world_of("crowd", 0)
    motion = motion_along_route("legged", world, 0)
    scan = Simulation(world, find_sensor(name), motion, mount_pose("upright", 0.75), 1).scan(0).scan
    assert scan.rings is None
    assert scan.time_offsets is not None
    assert len(scan) > 10_000
