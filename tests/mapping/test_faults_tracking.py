"""What becomes of tracking when something goes wrong: covers, kidnapping, dropped scans, traffic, standing still.

Offices and tunnels scanned by a simulated VLP-16 of few columns; poses, statuses and the map against the truth.
"""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from simulated_faults import (
    Faulty,
    carried_off,
    covered,
    dropped,
    even_tunnel,
    index_back,
    passing_by,
    standing_still,
    straight_drive,
)

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, rotation_angle, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.simulation.motion import motion_along, mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.world import World, build_world

from . import runs
from .runs import light, poses_of, simulated
from .shapes import on_sides

AT = 70
COUNT = 100


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lidarslam.mapping.tracking.tracking_state.GIVE_UP_AFTER", 5)


@pytest.fixture(scope="module")
def office() -> World:
    return build_world("office", 0)


@pytest.fixture(scope="module")
def drive_by(office: World) -> Simulation:
    return simulated(office, "tracked", light(), COUNT)


@pytest.fixture(scope="module")
def _followed(drive_by: Simulation) -> Mapper:
    mapper = Mapper(MappingConfig())
    runs.process(mapper, list(drive_by.scans(0, AT)))
    return mapper


@pytest.fixture
def mapper(_followed: Mapper) -> Mapper:
    """One that has followed the drive up to scan `AT`."""
    return deepcopy(_followed)


def process(mapper: Mapper, recorded: Faulty, first: int = AT) -> list[MappedScan]:
    return runs.process(mapper, recorded.scans[first:])


def errors(results: list[MappedScan], recorded: Faulty, first: int = AT) -> tuple[FloatArray, FloatArray]:
    """Metres (N,) and degrees (N,) off the truth, whose world is the first scan's frame."""
    truth = recorded.truth.T_world_lidar
    return runs.errors(poses_of(results), inverse(truth[0]) @ truth[first : first + len(results)])


def assert_nothing_wrong_is_believed(results: list[MappedScan], recorded: Faulty) -> None:
    """No pose that is ok is wrong, and nothing was drawn where it is not."""
    metres, degrees = errors(results, recorded)
    believed = np.array([result.status is Status.OK or result.added for result in results])
    assert metres[believed].max(initial=0.0) < 0.06
    assert degrees[believed].max(initial=0.0) < 1.5


def assert_recovered(results: list[MappedScan], recorded: Faulty, last: int = 5) -> None:
    assert [result.status for result in results[-last:]] == [Status.OK] * last
    metres, degrees = errors(results, recorded)
    assert metres[-last:].max() < 0.04
    assert degrees[-last:].max() < 1.0


def polluted_share(results: list[MappedScan], recorded: Faulty, simulation: Simulation, first: int = AT) -> float:
    """Share of the points that scans drew farther than 0.2 m from everything that stands there."""
    T_world = recorded.truth.T_world_lidar[0]
    drawn = [
        transform_points(
            T_world @ result.state.T_world_lidar,
            Sweep(scan.points, scan.time_offsets).compensated(result.state.velocity),
        )
        for result, scan in zip(results, recorded.scans[first : first + len(results)], strict=True)
        if result.added
    ]
    return float((simulation.distance_to_surfaces(np.concatenate(drawn)) > 0.2).mean())


@pytest.mark.long
@pytest.mark.parametrize("cover", ["near", "stray"])
def test_a_covered_sensor_is_lost_and_goes_on_in_the_same_map(mapper, drive_by, cover):
    """For one second, while it moves on; more scans than after which a map is given up."""
    recorded = covered(drive_by, AT, AT + 10, cover)
    held = len(mapper.local_map or ())
    results = process(mapper, replace(recorded, scans=recorded.scans[: AT + 10]))
    assert {result.status for result in results} == {Status.LOST}
    assert {result.added for result in results} == {False}
    assert all("within range" in result.message for result in results)
    assert len(mapper.local_map or ()) == held
    results += process(mapper, recorded, AT + 10)
    assert_nothing_wrong_is_believed(results, recorded)
    assert_recovered(results, recorded)
    assert polluted_share(results, recorded, drive_by) < 0.02


def test_a_first_scan_of_stray_points_begins_no_map(drive_by):
    recorded = covered(drive_by, 0, 3, "stray")
    mapper = Mapper(MappingConfig())
    results = runs.process(mapper, recorded.scans[:3])
    assert [result.status for result in results] == [Status.LOST] * 3
    assert mapper.local_map is None
    assert "only 25 points" in results[0].message


@pytest.mark.parametrize("turned_deg", [0.0, pytest.param(90.0, marks=pytest.mark.slow)])
def test_carried_5_m_back_it_finds_itself_in_its_map(mapper, drive_by, turned_deg):
    back = index_back(drive_by, AT, 5.0)
    recorded = carried_off(drive_by, AT, back, turned_deg)
    moved = recorded.truth.positions[AT] - recorded.truth.positions[AT - 1]
    assert np.linalg.norm(moved) > 3.0
    results = process(mapper, replace(recorded, scans=recorded.scans[: AT + 18]))
    assert results[0].status is not Status.OK
    assert any("relocalised in the map" in result.message for result in results[:3])
    assert not any(result.is_connected for result in results if "relocalised in the map" in result.message)
    assert not results[0].added
    assert_nothing_wrong_is_believed(results, recorded)
    assert_recovered(results, recorded, 3)
    assert polluted_share(results, recorded, drive_by) < 0.02


@pytest.mark.slow  # looks all over the map again and again, or follows a hundred scans
def test_carried_to_an_unknown_place_it_says_so_and_comes_back(mapper, drive_by):
    """In a tunnel it begins a map that is told to be a guess; back in the office, it is in its first map again."""
    away = simulated("tunnel", "tracked", light(), 20)
    results = runs.process(mapper, [replace(scan, stamp=0.1 * (AT + k)) for k, scan in enumerate(away.scans())])
    assert Status.OK not in {result.status for result in results}
    assert "a new map begins here" in results[4].message
    assert "in a new map" in results[-1].message
    assert results[-1].added
    back = runs.process(mapper, [replace(scan, stamp=scan.stamp + 2.0) for scan in drive_by.scans(AT, COUNT)])
    recorded = Faulty((), drive_by.ground_truth, np.zeros(COUNT, dtype=np.bool_), AT)
    assert Status.OK in {result.status for result in back}
    assert_nothing_wrong_is_believed([r if r.status is Status.OK else replace(r, added=False) for r in back], recorded)
    assert_recovered(back, recorded, 3)


@pytest.mark.parametrize(("missing", "then", "last"), [(10, 20, 5), pytest.param(50, 25, 3, marks=pytest.mark.slow)])
def test_dropped_scans_do_no_harm_and_5_s_are_bridged_when_the_map_is_met_again(mapper, drive_by, missing, then, last):
    recorded = dropped(replace(drive_by, scan_count=AT + missing + then), range(AT, AT + missing))
    results = process(mapper, recorded)
    assert_nothing_wrong_is_believed(results, recorded)
    assert_recovered(results, recorded, last)


@pytest.mark.slow  # follows a hundred scans
@pytest.mark.parametrize("turn", [(1500.0, 250.0), (600.0, 180.0)])
def test_sudden_turns_on_the_spot_are_followed(turn):
    """After four seconds of rest as fast as that one way round, then the other; nothing tells but the scans."""
    acceleration_deg, rate_deg = turn
    world = build_world("hall", 0)
    route = motion_along_route("tracked", world, 0)
    times = np.arange(0.0, 6.0, 0.02)
    rates = np.clip(acceleration_deg * (times - 4.03), 0.0, rate_deg)
    rates -= np.clip(2.0 * acceleration_deg * (times - 4.83), 0.0, 2.0 * rate_deg)
    turn = np.zeros((len(times), 6))
    turn[1:, 2] = np.deg2rad(np.cumsum(0.01 * (rates[1:] + rates[:-1])))
    T_world_first = make_transform(np.eye(3), [0.0, 0.0, route.sensor_height_m]) @ route.pose_at(np.zeros(1))[0]
    motion = motion_along(Trajectory(times, T_world_first @ exp(turn)))
    simulation = Simulation(world, light("os1-64"), motion, mount_pose("upright", 0.0), 58)
    recorded = Faulty(tuple(simulation.scans()), simulation.ground_truth, np.zeros(58, dtype=np.bool_), 0)
    results = process(Mapper(MappingConfig()), recorded, 0)
    metres, degrees = errors(results, recorded, 0)
    assert {result.status for result in results} == {Status.OK}
    assert metres.max() < 0.05
    assert degrees.max() < 2.0
    assert degrees[-3:].max() < 0.3


def stand(world: World, scans: int, mover_sides_m: FloatArray | None = None) -> Faulty:
    """Standing where the tracked carrier begins, people going up and down at the sides."""
    motion = motion_along_route("tracked", world, 0)
    T_world_body = motion.pose_at(np.zeros(1))[0]
    place, yaw = T_world_body[:3, 3], float(np.arctan2(T_world_body[1, 0], T_world_body[0, 0]))
    if mover_sides_m is not None:
        people = passing_by(place, yaw, np.array([0.4, 0.6, 1.8]), mover_sides_m, 1.2, 2.0)
        world = replace(world, movers=(*world.movers, *people))
    still = standing_still(place, yaw, motion.sensor_height_m)
    simulation = Simulation(world, light(), still, mount_pose("upright", motion.sensor_height_m), scans)
    return Faulty(tuple(simulation.scans()), simulation.ground_truth, np.zeros(scans, dtype=np.bool_), 0)


@pytest.mark.long
@pytest.mark.parametrize("name", ["office", pytest.param("forest", marks=pytest.mark.slow)])
def test_nothing_drifts_while_the_sensor_stands_still(name):
    """Noise of the first scans shows in the first poses; from the tenth on the pose stays, through 50 scans."""
    turned_deg = []
    for seed in range(3):
        recorded = stand(build_world(name, seed), 50)
        results = process(Mapper(MappingConfig()), recorded, 0)
        assert {result.status for result in results} == {Status.OK}
        poses = poses_of(results)
        drift = inverse(poses[10]) @ poses[40:]
        assert np.linalg.norm(drift[:, :3, 3].mean(axis=0)) < 0.01
        turned_deg.append(np.rad2deg(rotation_angle(drift)).mean())
    assert np.mean(turned_deg) < 0.08


@pytest.mark.slow  # looks all over the map again and again, or follows a hundred scans
def test_people_who_hide_much_of_the_view_do_not_drag_the_pose(office):
    recorded = stand(office, 80, np.array([0.8, -0.8, 0.9, -0.9, 1.0, -1.1, 1.2]))
    results = process(Mapper(MappingConfig()), recorded, 0)
    metres, degrees = errors(results, recorded, 0)
    assert {result.status for result in results} == {Status.OK}
    assert metres.max() < 0.03
    assert degrees[10:].max() < 0.4


@pytest.mark.long
def test_along_a_featureless_tunnel_every_scan_is_degraded_and_the_motion_continues():
    """At 3 to 4 m/s over 22 m: within the change of the speed, as at a constant velocity."""
    world = even_tunnel(12.0, 60.0, 65.0)
    motion = motion_along(straight_drive(65.0, 4.0, 1.5))
    sensor = light()
    sensor = replace(sensor, ranging=replace(sensor.ranging, max_range_m=20.0))
    simulation = Simulation(world, sensor, motion, mount_pose("upright", 0.0), 150)
    x = simulation.ground_truth.positions[:, 0]
    nothing = (x > 33.0) & (x < 39.0)
    assert nothing.sum() > 10
    recorded = Faulty(tuple(simulation.scans()), simulation.ground_truth, nothing, 0)
    results = process(Mapper(MappingConfig()), recorded, 0)
    concerned = [result for result, here in zip(results, nothing, strict=True) if here]
    assert {result.status for result in concerned} == {Status.DEGRADED}
    assert all("x" in result.degenerate for result in concerned)
    true = inverse(simulation.ground_truth.T_world_lidar[0]) @ simulation.ground_truth.T_world_lidar
    assert np.abs((poses_of(results) - true)[:, 0, 3]).max() < 2.0


def test_a_scan_that_fits_two_places_alike_is_at_neither(rng):
    """A plain room looks the same after half a turn."""
    walls = [on_sides(rng, np.array([5.0, 3.0, 1.5]), 8_000) for _ in range(11)]
    walls[-1] -= np.array([2.5, 1.0, 0.0])
    results = runs.process(Mapper(MappingConfig()), [Scan(points, 0.1 * k) for k, points in enumerate(walls)])
    assert results[-1].status is Status.LOST
