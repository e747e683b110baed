"""A street along a given path stands clear of all of it, and a car can drive there."""

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import make_transform
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.mesh import Caster, box_mesh, cylinder_mesh, merge
from lidarslam.simulation.motion import find_carrier, motion_along, rotations
from lidarslam.simulation.record import check_clearance, given_path, read_trajectory
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.worlds.along import FREE_SIDE_M, build_along


def figure_of_eight(size_m=70.0, rounds=1):
    angle = np.linspace(0.0, 2.0 * np.pi * rounds, 800 * rounds)
    return size_m * np.stack([np.sin(angle), 0.6 * np.sin(2.0 * angle)], axis=1)


def distances(world, path, height_m):
    """How far it is from places above the path (N, 2) to what stands on the ground."""
    solids = merge([box_mesh(world.boxes), cylinder_mesh(world.cylinders)])
    eyes = np.column_stack([path, world.ground_at(path) + height_m])
    return Caster(world, solids).distances(eyes)


@pytest.fixture(scope="module")
def eight():
    return build_along(figure_of_eight(), 3)


@pytest.mark.parametrize("height_m", [0.3, 1.7, 6.0])
def test_nothing_is_near_the_path_at_any_height(eight, height_m):
    away = distances(eight, figure_of_eight(), height_m)
    # Of the kerb's stones all is below.
    assert away.min() > FREE_SIDE_M - 0.02
    assert np.quantile(away, 0.9) < 9.0


def test_both_sides_are_built_up(eight):
    path = figure_of_eight()
    ahead = np.gradient(path, axis=0)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
    eyes = np.column_stack([path, eight.ground_at(path) + 2.5])
    caster = Caster(eight)
    for side in (left, -left):
        rays = np.column_stack([side, np.zeros(len(side))])
        ranges = caster.cast(eyes, rays, np.zeros(len(eyes)), 100.0).ranges
        assert (ranges < 15.0).mean() > 0.6
        assert ranges.min() > FREE_SIDE_M
    assert (eight.cylinders.radii == 0.33).sum() > 40  # wheels
    assert eight.movers


def test_the_ground_follows_given_heights():
    path = figure_of_eight()
    path = np.column_stack([path, 5.0 + 0.05 * path[:, 0]])
    world = build_along(path, 0)
    np.testing.assert_allclose(world.ground_at(path[:, :2]), path[:, 2] + 0.08, atol=0.15)


def test_paths_that_are_no_streets():
    with pytest.raises(InputError, match="1 m or more and within 5 km"):
        build_along(np.zeros((5, 2)), 0)
    with pytest.raises(InputError, match=r"within 6000\.0 m"):
        build_along(np.array([[0.0, 0.0], [6000.0, 0.0]]), 0)


def along(world, path, carrier="car"):
    ahead = np.gradient(path, axis=0)
    zero = np.zeros(len(path))
    T = make_transform(rotations(zero, zero, np.arctan2(ahead[:, 1], ahead[:, 0])), np.column_stack([path, zero]))
    motion = motion_along(Trajectory(0.1 * np.arange(len(path)), T), world, carrier=carrier)
    return Simulation(world, find_sensor("vlp-16"), motion, np.eye(4), len(path) - 2)


def test_a_way_through_a_house_is_refused_with_its_place(eight):
    check_clearance(along(eight, figure_of_eight()), find_carrier("car"), "a.tum")
    straight = np.column_stack([np.linspace(0.0, 60.0, 120), np.zeros(120)])
    with pytest.raises(InputError, match=r"a\.tum: leads through something solid in street, seed 3, at x .* --world"):
        check_clearance(along(eight, straight), find_carrier("car"), "a.tum")


@pytest.mark.real_data
@pytest.mark.parametrize("sequence", ["07", "00"])
def test_kitti_paths_are_clear_and_drivable(sequence, real_data):
    file = real_data / "trajectories" / "kitti_ground_truth" / f"{sequence}.txt"
    path = given_path(file, "car")
    world = build_along(path, 0)
    assert len(world.boxes) < 20_000
    for height_m in (0.4, 1.7):
        assert distances(world, path, height_m).min() > FREE_SIDE_M - 0.02
    motion = motion_along(read_trajectory(file), world, smoothing_s=0.25)
    positions = motion.pose_at(np.arange(1.0, motion.duration_s - 1.0, 0.05))[:, :3, 3]
    acceleration = np.linalg.norm(np.diff(positions, 2, axis=0), axis=1) / 0.05**2
    assert acceleration.max() < 8.0
    assert np.quantile(acceleration, 0.99) < 4.5
