"""Sweeps of known truth through the mapper, with either map: accuracy, what stays out of it, and the way back."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.config import MappingConfig, TrackingConfig
from lidarslam.mapping.loam.feature_map import FeatureMap
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.simulation.sensors import find_sensor

from .runs import assert_near, poses_of, process, simulated
from .shapes import on_sides

Path = Callable[[FloatArray], FloatArray]
VELOCITY = np.array([0.0, 0.01, 0.3, 0.8, 0.05, 0.0])  # of the drive
SURFELS, LOAM = MappingConfig(), MappingConfig(method="loam")


def assert_true(results: list[MappedScan], T_room_lidar: FloatArray, metres: float, degrees: float) -> None:
    """In a world that is the first scan's frame."""
    assert_near(poses_of(results), inverse(T_room_lidar[0]) @ T_room_lidar, metres, degrees)
    assert [result.status for result in results] == [Status.OK] * len(results)


def assert_moving(last: MappedScan, degrees_per_s: float, metres_per_s: float) -> None:
    """Its velocity is that of the drive."""
    np.testing.assert_allclose(last.state.velocity[:3], VELOCITY[:3], atol=np.deg2rad(degrees_per_s))
    np.testing.assert_allclose(last.state.velocity[3:], VELOCITY[3:], atol=metres_per_s)


def true_priors(truth: Trajectory) -> list[Prior]:
    return [Prior(T, VELOCITY) for T in (np.eye(4), *truth.relative_motions())]


def garbage(stamp: float, seed: int = 0, count: int = 2_000) -> Scan:
    """Points that lie on nothing."""
    return Scan(np.random.default_rng(seed).uniform(-6.0, 6.0, (count, 3)), stamp, np.linspace(0.0, 0.1, count))


def empty(stamp: float) -> Scan:
    return Scan(np.empty((0, 3)), stamp, np.empty(0))


def snapshot(room: Any, T_room_lidar: FloatArray, stamp: float, seed: int) -> Scan:
    """A scan of an instant, without times."""
    still = room.sweep(lambda time: np.broadcast_to(T_room_lidar, (*np.shape(time), 4, 4)), 0.001 * seed)
    return Scan(still.points, stamp)


@pytest.fixture(scope="session")
def from_rest(drive: Path) -> Path:
    """The drive, but the first sweep of `room_scans` is taken at rest."""
    return lambda time: drive(np.maximum(0.15, np.asarray(time)))


@pytest.fixture(scope="session")
def rest_scans(room: Any, from_rest: Path, room_truth: Trajectory) -> list[Scan]:
    return [room.sweep(from_rest, float(stamp)) for stamp in room_truth.stamps]


@pytest.fixture(scope="session")
def rest_truth(from_rest: Path, room_truth: Trajectory) -> Trajectory:
    return Trajectory(room_truth.stamps, from_rest(room_truth.stamps))


@pytest.fixture
def mapper() -> Mapper:
    return Mapper(MappingConfig())


@pytest.fixture(scope="module")
def followed(rest_scans: list[Scan]) -> Mapper:
    mapper = Mapper(MappingConfig())
    process(mapper, rest_scans[:15])
    return mapper


@pytest.fixture
def settled(followed: Mapper) -> Mapper:
    """A mapper that has followed the first fifteen scans."""
    return deepcopy(followed)


@pytest.mark.parametrize(("sensor", "kind"), [("vlp-16", SurfelMap), ("mid-360", FeatureMap)])
def test_without_rings_planes_pass_through_neighbouring_voxels(scan_room, sensor, kind):
    mapper = Mapper(SURFELS)
    (mapped,) = process(mapper, [scan_room(sensor)])
    assert isinstance(mapper.local_map, kind)
    assert mapped.has_surfels == (kind is SurfelMap)  # the pose graph rebuilds no others


def test_poses_and_velocities_are_true_without_any_prior(mapper, rest_scans, rest_truth):
    results = process(mapper, rest_scans)
    assert_true(results, rest_truth.T_world_lidar, 0.0025, 0.03)
    for result in results[3:]:
        assert_moving(result, 2.0, 0.1)


@pytest.mark.parametrize(("config", "recording", "metres", "degrees"), [
    (SURFELS, "room_scans", 0.008, 0.2), (LOAM, "ring_scans", 0.01, 0.25),
], ids=["surfels", "loam"])  # fmt: skip
def test_a_sensor_that_moves_already_is_seen_to_move(config, recording, metres, degrees, room_truth, request):
    """The first sweep is bent by a motion that nobody knows; what it has drawn must not hide the motion for ever."""
    results = process(Mapper(config), request.getfixturevalue(recording))
    assert_true(results, room_truth.T_world_lidar, metres, degrees)
    assert_moving(results[-1], 3.0, 0.15)


def test_poses_are_true_from_wrong_priors(mapper, rng, rest_scans, rest_truth):
    """Each is wrong by two degrees and ten centimetres, in some direction."""
    axes = rng.normal(size=(20, 2, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    off = exp(np.concatenate([np.deg2rad(2.0) * axes[:, 0], 0.1 * axes[:, 1]], axis=1))
    results = process(mapper, rest_scans, [Prior(T) for T in [np.eye(4), *rest_truth.relative_motions()] @ off])
    assert_true(results, rest_truth.T_world_lidar, 0.003, 0.04)


@pytest.mark.parametrize(("config", "recording", "metres", "degrees"), [
    (SURFELS, "room_scans", 0.002, 0.03), (LOAM, "ring_scans", 0.003, 0.1),
], ids=["surfels", "loam"])  # fmt: skip
def test_poses_are_true_with_the_true_motion(config, recording, metres, degrees, room_truth, request):
    results = process(Mapper(config), request.getfixturevalue(recording), true_priors(room_truth))
    assert_true(results, room_truth.T_world_lidar, metres, degrees)
    np.testing.assert_array_equal(results[0].state.T_world_lidar, np.eye(4))
    assert (results[0].registered, results[0].added, results[0].fit) == (False, True, None)
    assert all(result.registered and result.added and result.is_connected for result in results[1:])


def test_compensating_twice_is_nearly_as_good_as_estimating_the_velocity(rest_scans, rest_truth):
    results = process(Mapper(MappingConfig(continuous_time=False)), rest_scans)
    assert_true(results, rest_truth.T_world_lidar, 0.009, 0.18)


def test_scans_without_times_are_registered_as_they_are(room, drive, mapper):
    stamps = 0.1 * np.arange(1, 21)
    truth = drive(stamps)
    scans = [snapshot(room, T, float(stamp), k) for k, (T, stamp) in enumerate(zip(truth, stamps, strict=True))]
    assert_true(process(mapper, scans), truth, 0.004, 0.04)


def test_a_sensor_upside_down_is_as_good(mapper, rest_scans, rest_truth):
    T_lidar_mounted = np.diag([1.0, -1.0, -1.0, 1.0])
    scans = [replace(scan, points=scan.points @ T_lidar_mounted[:3, :3]) for scan in rest_scans]
    assert_true(process(mapper, scans), rest_truth.T_world_lidar @ T_lidar_mounted, 0.0025, 0.03)


def test_the_pose_does_not_drift_while_nothing_moves(mapper, room, drive):
    """Fifty times the very same scan."""
    scan = snapshot(room, drive(np.array([0.5]))[0], 0.0, 1)
    results = process(mapper, [replace(scan, stamp=0.1 * k) for k in range(51)])
    assert_near(poses_of(results), np.eye(4), 1e-3, 0.01)


def test_a_first_scan_of_nothing_is_lost_and_the_next_begins_the_map(mapper, rest_scans, rest_truth):
    (first,) = process(mapper, [empty(0.0)])
    assert (first.status, first.message) == (Status.LOST, "no points within range")
    assert mapper.local_map is None
    assert_true(process(mapper, rest_scans), rest_truth.T_world_lidar, 0.006, 0.06)


@pytest.mark.parametrize(("nothing_known", "why"), [(empty, "no points within range"), (garbage, "% of the scan")])
def test_a_scan_of_nothing_or_another_place_is_lost_goes_on_as_before_and_changes_nothing(
    settled, rest_scans, rest_truth, nothing_known, why
):
    held, truth = len(settled.local_map), inverse(rest_truth.T_world_lidar[0]) @ rest_truth.T_world_lidar
    (lost,) = process(settled, [nothing_known(rest_scans[15].stamp)])
    assert (lost.status, lost.registered) == (Status.LOST, False)
    assert why in lost.message
    assert len(settled.local_map) == held
    np.testing.assert_array_equal(lost.state.T_world_lidar, lost.T_world_predicted)
    assert np.linalg.norm(lost.state.T_world_lidar[:3, 3] - truth[15, :3, 3]) < 0.02
    results = process(settled, rest_scans[16:])
    assert [result.status for result in results] == [Status.OK] * 4
    assert np.linalg.norm((poses_of(results) - truth[16:])[:, :3, 3], axis=1).max() < 0.006


@pytest.mark.parametrize(("earlier", "is_inserted"), [(1, True), (6, False)])
def test_a_scan_that_fits_badly_has_a_pose_but_stays_out_of_a_map_that_is_not_young(rest_scans, earlier, is_inserted):
    mapper = Mapper(MappingConfig(tracking=TrackingConfig(degraded_below=1.0)))
    mapper.process(mapper.sample(rest_scans[0]), Prior(velocity=np.zeros(6)))
    process(mapper, rest_scans[1:earlier])
    held = len(mapper.local_map)
    # A quarter of its points stand before the walls, as people do.
    crowded = rest_scans[earlier].points.copy()
    crowded[::4] *= 0.8
    (placed,) = process(mapper, [replace(rest_scans[earlier], points=crowded)])
    assert (placed.registered, placed.status) == (True, Status.DEGRADED)
    assert "fits the map" in placed.message
    assert (len(mapper.local_map) > held) == is_inserted


@pytest.mark.parametrize("turned_deg", [-100.0, 180.0])
def test_turned_on_the_spot_it_finds_its_way_back(settled, room, rest_truth, turned_deg):
    T_turned = rest_truth.T_world_lidar[14] @ exp([0.0, 0.0, np.deg2rad(turned_deg), 0.0, 0.0, 0.0])
    (found,) = process(settled, [snapshot(room, T_turned, float(rest_truth.stamps[15]) + 1.0, 7)])
    assert_near(found.state.T_world_lidar, inverse(rest_truth.T_world_lidar[0]) @ T_turned, 0.01, 0.1)
    assert found.status is Status.DEGRADED
    assert "from the prediction" in found.message


def test_a_place_that_no_motion_leads_to_is_not_taken_until_driving_decides(settled, room, rest_truth):
    """Turned within a tenth of a second: another room that looks alike is as probable, for a second."""
    T_turned = rest_truth.T_world_lidar[14] @ exp([0.0, 0.0, np.deg2rad(150.0), 0.0, 0.0, 0.0])
    stamps = rest_truth.stamps[14] + 0.1 * np.arange(1, 26)
    found = process(settled, [snapshot(room, T_turned, float(stamp), 7 + k) for k, stamp in enumerate(stamps)])
    assert [one.status for one in found[:4]] == [Status.LOST] * 4
    assert found[-1].status is Status.OK
    assert_near(found[-1].state.T_world_lidar, inverse(rest_truth.T_world_lidar[0]) @ T_turned, 0.05, 0.1)


def test_in_the_new_map_it_goes_on_from_where_the_old_one_ended(rest_scans, rest_truth, monkeypatch):
    """Two covered scans, then the room again, which fits the new map and not what came between."""
    monkeypatch.setattr("lidarslam.mapping.tracking.tracking_state.GIVE_UP_AFTER", 1)
    mapper = Mapper(MappingConfig())
    process(mapper, [garbage(0.0)])
    restarted, *results = process(mapper, rest_scans)
    assert "a new map begins here" in restarted.message
    assert [result.status for result in results] == [Status.OK] * 19
    relative = inverse(restarted.state.T_world_lidar) @ results[-1].state.T_world_lidar
    truth = inverse(rest_truth.T_world_lidar[0]) @ rest_truth.T_world_lidar[-1]
    assert np.linalg.norm(relative[:3, 3] - truth[:3, 3]) < 0.01


def indoors(seed: int, stamp: float, outdoors: int) -> Scan:
    """A box of 8 x 6 x 3 m seen from its middle, and so many points twelve metres away, as through windows."""
    rng = np.random.default_rng(seed)
    points = on_sides(rng, np.array([4.0, 3.0, 1.5]), 4_000)
    away = rng.normal(size=(outdoors, 3))
    away *= 12.0 / np.linalg.norm(away, axis=1, keepdims=True)
    return Scan(np.concatenate([points, away]), stamp)


def test_scans_still_fit_when_the_cells_become_smaller(mapper):
    """Windows are behind the sensor now: the scene has shrunk to a third."""
    process(mapper, [indoors(k, 0.1 * k, outdoors=8_000) for k in range(4)])
    cell_m = mapper.local_map.cell_m
    results = process(mapper, [indoors(k, 0.1 * k, outdoors=0) for k in range(4, 36)])
    assert mapper.local_map.cell_m < 0.6 * cell_m
    assert [result.status for result in results] == [Status.OK] * len(results)
    assert np.linalg.norm(results[-1].state.T_world_lidar[:3, 3]) < 0.02


def test_a_sensor_that_was_carried_away_is_relocalised_in_loams_map(ring_scans, room_truth):
    """Covered for a second and turned by 100 degrees in the meantime."""
    mapper = Mapper(LOAM)
    process(mapper, ring_scans[:10], true_priors(room_truth)[:10])
    assert process(mapper, [empty(ring_scans[10].stamp)])[0].status is Status.LOST
    turn = exp([0.0, 0.0, np.deg2rad(100.0), 0.0, 0.0, 0.0])
    turned = [replace(scan, points=scan.points @ turn[:3, :3], stamp=scan.stamp + 1.0) for scan in ring_scans[11:20]]
    results = process(mapper, turned)
    assert any("relocalised" in result.message for result in results)
    truth = inverse(room_truth.T_world_lidar[0]) @ room_truth.T_world_lidar[19] @ turn
    assert_near(results[-1].state.T_world_lidar, truth, 0.05, 1.0)


def test_along_a_corridor_loam_keeps_the_odometry(room):
    """Walls, floor and ceiling along x, the sensor's way, look alike from everywhere: only the odometry tells it."""
    corridor, way = replace(room, half_size=(1e3, 1.5, 1.2), pillars=()), exp([0.0, 0.0, 0.0, 0.09, 0.0, 0.0])
    seen = corridor.ring_sweep(lambda time: np.broadcast_to(np.eye(4), (len(time), 4, 4)), 0.0)
    near = seen.select(np.linalg.norm(seen.points, axis=1) < 6.0)  # else incidence is grazing
    scans = [replace(near, stamp=0.1 * k, time_offsets=None) for k in range(6)]
    results = process(Mapper(LOAM), scans, [Prior(way)] * 6)
    sigmas = [np.sqrt(result.state.covariance[3, 3]) for result in results[1:]]
    for k, result in enumerate(results[1:], start=1):
        assert result.status is Status.DEGRADED
        assert "x" in result.degenerate
        assert result.state.T_world_lidar[0, 3] == pytest.approx(0.09 * k, abs=0.02)
        np.testing.assert_allclose(result.state.T_world_lidar[1:3, 3], 0.0, atol=5e-3)
    assert (np.diff(sigmas) > 0.0).all(), "the uncertainty grows on the way"


@pytest.mark.parametrize("config", [SURFELS, LOAM], ids=["surfels", "loam"])
def test_a_scan_beyond_the_reach_of_the_cells_is_lost_with_the_reason(config, room, drive):
    near, beyond = Prior(np.eye(4)), Prior(exp([0.0, 0.0, 0.0, 1e7, 0.0, 0.0]), covariance=1e-12 * np.eye(6))
    mapper = Mapper(config.model_copy(update={"cell_m": 0.05, "max_range_m": 30.0}))
    _, lost = process(mapper, [room.ring_sweep(drive, 0.1), room.ring_sweep(drive, 0.2)], [near, beyond])
    assert lost.status is Status.LOST
    assert "52 km" in lost.message


@pytest.fixture(scope="module")
def disturbed_scans(room_scans: list[Scan]) -> list[Scan]:
    """Thinned sweeps; two are of points that lie on nothing, so that the map is begun anew, and one is empty."""
    chosen = [scan.select(np.arange(0, len(scan), 3)) for scan in room_scans[:12]]
    for index in (5, 6):
        chosen[index] = garbage(chosen[index].stamp, index)
    chosen[9] = empty(chosen[9].stamp)
    return chosen


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "recording", "resumed"),
    [("surfels", "disturbed_scans", (1, 6, 8)), ("loam", "ring_scans", (1, 7))],
)
def test_a_restored_mapper_goes_on_to_the_last_bit(through_disk, request, monkeypatch, method, recording, resumed):
    monkeypatch.setattr("lidarslam.mapping.tracking.tracking_state.GIVE_UP_AFTER", 2)
    config, scans = MappingConfig(keypoints=600, method=method), request.getfixturevalue(recording)[:12]
    expected = process(Mapper(config), scans)
    assert Status.OK in {mapped.status for mapped in expected}
    assert any("a new map" in mapped.message for mapped in expected) == (method == "surfels")
    for after in resumed:
        first, second = Mapper(config), Mapper(config)
        process(first, scans[:after])
        second.restore(through_disk(first.state()))
        for found, mapped in zip(process(second, scans[after:]), expected[after:], strict=True):
            np.testing.assert_array_equal(found.T_world_predicted, mapped.T_world_predicted)
            for name, value in vars(mapped.state).items():
                np.testing.assert_array_equal(getattr(found.state, name), value, err_msg=name)
            for name in ("registered", "status", "message", "fit", "degenerate", "iterations", "added", "is_connected"):
                assert getattr(found, name) == getattr(mapped, name), name


@pytest.mark.parametrize(("angle_deg", "added"), [(0.0, 4), (2.0, 12)])
def test_a_sensor_that_stands_adds_few_scans_to_the_map(angle_deg, added):
    """Its rings hit the same spots of rough ground again and again, and these must not seem certain."""
    (scan,) = simulated("fields", "car", find_sensor("vlp-16"), 1).scans()
    mapper = Mapper(MappingConfig())
    turns = exp(np.outer(np.deg2rad(angle_deg) * np.arange(12), [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    turned = [Scan(transform_points(inverse(T), scan.points), 0.1 * number) for number, T in enumerate(turns)]
    results = process(mapper, turned)
    assert all(result.added for result in results)
    assert mapper.local_map.scans == added
