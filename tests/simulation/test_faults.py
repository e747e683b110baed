"""Faults of a recording: what the scans show, and that the truth goes with them."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_faults import (
    carried_off,
    covered,
    dropped,
    even_tunnel,
    index_back,
    open_plain,
    passing_by,
    standing_still,
    straight_drive,
)

from lidarslam.core.geometry import inverse, rotation_angle
from lidarslam.simulation.motion import Motion, Sway, mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.sensors import Spinning, find_sensor
from lidarslam.simulation.world import World


@pytest.fixture
def simulation(yard: World) -> Simulation:
    sensor = find_sensor("vlp-16")
    assert isinstance(sensor.pattern, Spinning)
    sensor = replace(sensor, pattern=replace(sensor.pattern, columns=180))
    base = np.zeros((11, 7))
    base[:, 0], base[:, 1], base[:, 2] = np.linspace(-8.0, 12.0, 11), 8.0, 1.5
    motion = Motion("straight", np.linspace(0.0, 4.0, 11), base, Sway(), 0.0, repeats=False)
    return Simulation(yard, sensor, motion, mount_pose("upright", 0.0), 30)


def test_a_cover_leaves_nothing_of_what_is_farther(simulation: Simulation) -> None:
    for cover, most, reach_m in (("empty", 0, 0.0), ("near", 10_000, 0.3), ("stray", 25, 40.0)):
        recorded = covered(simulation, 5, 8, cover)  # type: ignore[arg-type]
        assert recorded.concerned.nonzero()[0].tolist() == [5, 6, 7]
        assert recorded.after == 8
        for scan in recorded.scans[5:8]:
            assert len(scan) <= most
            assert np.linalg.norm(scan.points, axis=1).max(initial=0.0) <= reach_m
        np.testing.assert_array_equal(recorded.scans[8].points, simulation.scan(8).scan.points)


def test_carried_off_it_goes_on_elsewhere(simulation: Simulation) -> None:
    recorded = carried_off(simulation, 20, index_back(simulation, 20, 5.0), 90.0)
    jump = inverse(recorded.truth.T_world_lidar[19]) @ recorded.truth.T_world_lidar[20]
    assert np.linalg.norm(jump[:3, 3]) == pytest.approx(5.0, abs=0.6)
    assert np.rad2deg(rotation_angle(jump)) == pytest.approx(90.0, abs=1e-6)
    assert len(recorded.scans) == len(recorded.truth) == 30
    np.testing.assert_allclose([scan.stamp for scan in recorded.scans], recorded.truth.stamps)
    scan, T = recorded.scans[25], recorded.truth.T_world_lidar[25]
    still = scan.points @ T[:3, :3].T + T[:3, 3]  # it moves by half a metre during a sweep
    assert np.median(simulation.distance_to_surfaces(still)) < 0.3


def test_dropped_scans_are_gone_from_the_truth_too(simulation: Simulation) -> None:
    recorded = dropped(simulation, range(10, 13))
    assert len(recorded.scans) == len(recorded.truth) == 27
    assert recorded.after == 10
    assert recorded.scans[10].stamp == recorded.truth.stamps[10] == pytest.approx(1.3)


def test_people_pass_where_they_are_sent() -> None:
    movers = passing_by(
        np.array([1.0, 2.0, 0.0]), np.pi / 2, np.array([0.4, 0.6, 1.8]), np.array([1.0, -2.0]), 1.2, 3.0
    )
    for mover, x in zip(movers, (0.0, 3.0), strict=True):
        positions = mover.pose_at(np.linspace(0.0, 20.0, 200))[:, :3, 3]
        np.testing.assert_allclose(positions[:, 0], x, atol=1e-9)
        assert positions[:, 1].min() == pytest.approx(-1.0, abs=0.2)
        assert positions[:, 1].max() == pytest.approx(5.0, abs=0.2)


def test_standing_still_is_at_its_place_for_ever() -> None:
    poses = standing_still(np.array([1.0, 2.0, 0.5]), 0.3, 1.0).pose_at(np.array([0.0, 1.7, 500.0]))
    np.testing.assert_allclose(poses[:, :3, 3], np.tile([1.0, 2.0, 0.5], (3, 1)), atol=1e-12)
    assert np.abs(rotation_angle(inverse(poses[0]) @ poses)).max() < 1e-9


@pytest.mark.parametrize("build", [even_tunnel, open_plain])
def test_between_its_ends_a_featureless_place_is_even(build: object) -> None:
    world = build(20.0, 60.0, 80.0)  # type: ignore[operator]
    boxes = world.boxes.centres[world.boxes.half_sizes[:, 0] < 30.0]
    x = np.concatenate([boxes[:, 0], world.cylinders.starts[:, 0]])
    assert ((x < 20.0) | (x > 60.0)).all()
    assert (x < 20.0).sum() > 10
    assert (x > 60.0).sum() > 10


def test_the_drive_does_not_go_evenly() -> None:
    drive = straight_drive(80.0, 5.0, 1.5)
    steps = np.diff(drive.positions[:, 0])
    assert steps[0] < 0.02
    assert steps[60:].min() < 0.8 * steps[60:].max()
    assert drive.positions[-1, 0] <= 80.0
