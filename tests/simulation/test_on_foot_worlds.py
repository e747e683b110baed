"""Corridor, stairs and crowd have the measures they are named for, and their people walk as they should."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.simulation.motion import Sway
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.world import World
from lidarslam.simulation.worlds.crowd import COMPANIONS, CROSSING, STANDING

from .conftest import cached_world, cast, caster_of

RISE_M, TREAD_M = 0.17, 0.28
each_seed = pytest.mark.parametrize("seed", [0, 1])
LEFT, RIGHT, UP, DOWN = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])


def corridor_length(world: World) -> float:
    return 1.2 - float(world.route.waypoints[:, 0].min())


@each_seed
def test_a_corridor_is_two_metres_wide_and_has_boxes_along_its_walls(seed: int) -> None:
    length, caster = corridor_length(cached_world("corridor", seed)), caster_of("corridor", seed)
    assert 24.0 <= length <= 40.0
    x = np.arange(0.02 - length, -0.02, 0.02)
    high = np.column_stack([x, np.zeros(len(x)), np.full(len(x), 1.2)])
    for sideways in (LEFT, RIGHT):
        np.testing.assert_allclose(cast(caster, high, sideways), 1.0, atol=1e-3)
    np.testing.assert_allclose(cast(caster, high, UP), 1.4, atol=1e-3)
    np.testing.assert_allclose(cast(caster, high, DOWN), 1.2, atol=1e-3)
    low = high - [0.0, 0.0, 1.0]
    widths = np.stack([cast(caster, low, sideways) for sideways in (LEFT, RIGHT)])
    assert widths.min() > 0.54
    runs = np.diff(np.pad(widths < 0.9, ((0, 0), (1, 1))).astype(int), axis=1)
    starts, stops = (np.argwhere(runs == sign) for sign in (1, -1))
    assert len(starts) == 12
    sizes = 0.02 * (stops - starts)[:, 1]
    assert sizes.min() > 0.25
    assert sizes.max() < 0.85


@each_seed
def test_a_corridor_opens_into_a_yard_and_recordings_begin_deep_in_it(seed: int) -> None:
    world = cached_world("corridor", seed)
    length, waypoints = corridor_length(world), world.route.waypoints
    mouth = np.array([[-0.5, 0.0, 1.2]])
    ahead = cast(caster_of("corridor", seed), mouth, np.array([1.0, 0.0, 0.0]))
    assert 5.0 < ahead[0] < 41.0  # a tree may stand before the far side
    assert np.ptp(waypoints[:, 1]) > 13.0
    motion = motion_along_route("handheld", world, seed)
    start, later = motion.pose_at(np.array([0.0, 8.0]))[:, :3, 3]
    assert -0.7 * length < start[0] < -0.5 * length
    assert later[0] > start[0] + 3.0  # on its way out
    np.testing.assert_array_equal(waypoints[:, 2], world.ground_at(waypoints[:, :2]))


@each_seed
def test_a_carrier_climbs_the_stairs_smoothly_and_comes_down_again(seed: int) -> None:
    world = cached_world("stairs", seed)
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
    world = cached_world("crowd", seed)
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
