"""Starts of simulated sensors, a single sweep of which may make no map, or which are at speed at the first scan."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, inverse, log
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import AXES, Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import move
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.smoothed_start import SMOOTHED, SmoothedStart, smoothed_start
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.sensors import find_sensor

from .runs import NOTHING, errors, poses_of, process, simulated


def true_poses(simulation: Simulation, scans: list[Scan]) -> FloatArray:
    """(N, 4, 4) at the stamps of scans."""
    return np.asarray(simulation.ground_truth.at(np.array([scan.stamp for scan in scans]), 0.2), dtype=np.float64)


def walk(sensor: str, start: int, count: int = 25, name: str = "office") -> tuple[list[Scan], FloatArray]:
    """Scans of a legged robot, and the motions (N, 4, 4) between them."""
    simulation = simulated(name, "legged", find_sensor(sensor), 200, seed=1)
    scans = list(simulation.scans(start, start + count))
    T_map_lidar = true_poses(simulation, scans)
    return scans, inverse(T_map_lidar[:-1]) @ T_map_lidar[1:]


@pytest.fixture(scope="module")
def strokes() -> tuple[list[Scan], FloatArray]:
    """Scans of a sensor without rings, and their motions."""
    return walk("mid-360", 40)


@pytest.mark.long
def test_motions_of_a_sensor_without_rings_are_true(strokes):
    scans, truth = strokes
    smoothed = smoothed_start(scans, MappingConfig()).motions
    assert list(smoothed) == [scan.stamp for scan in scans[1:SMOOTHED]]
    for motion, T_true in zip(smoothed.values(), truth, strict=False):
        error = inverse(T_true) @ motion.T_prev_curr
        assert np.linalg.norm(error[:3, 3]) < 0.04
        assert motion.velocity == pytest.approx(log(motion.T_prev_curr) / 0.1)


@pytest.mark.long
def test_registration_in_order_suffices_where_a_sweep_makes_a_map():
    scans, _ = walk("os0-64", 40, 10)
    assert smoothed_start(iter(scans), MappingConfig()).motions == {}


@pytest.mark.slow  # registers forty scans of a Mid-360
def test_nothing_is_smoothed_across_another_place(strokes):
    scans, _ = strokes
    elsewhere, _ = walk("mid-360", 40, name="tunnel")
    assert smoothed_start(scans[:12] + elsewhere[12:], MappingConfig()).motions == {}


def test_too_few_scans_are_left_as_they_are(strokes):
    scans, _ = strokes
    assert smoothed_start(scans[:5], MappingConfig()).motions == {}
    assert smoothed_start([], MappingConfig()) == SmoothedStart()


@pytest.mark.long
def test_a_map_too_thin_for_a_registration_grows_at_rest():
    """Few neighbouring points of a single sweep of a Mid-360 are on a plane of a forest."""
    scans, truth = walk("mid-360", 0, 26, "forest")
    results = process(Mapper(MappingConfig()), scans)
    grown = [result for result in results if not result.registered]
    assert 2 <= len(grown) < 10, "the first scan, and those that the map is too thin for"
    assert all(result.added for result in grown)
    assert [result.status for result in results[-12:]] == [Status.OK] * 12
    steps = inverse(truth) @ inverse(poses_of(results)[:-1]) @ poses_of(results)[1:]
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.08
    T_first_last = np.linalg.multi_dot(list(truth))
    assert errors(poses_of(results)[-1], T_first_last)[0] < 0.06


def clutter(rng: np.random.Generator, stamp: float) -> Scan:
    """Of a sensor without rings: points that are near one another at any time."""
    points = rng.normal(size=(1200, 3)) * [8.0, 8.0, 2.0]
    points = points[np.argsort(points[:, 2] / np.linalg.norm(points, axis=1))]
    return Scan(points, stamp, time_offsets=np.linspace(0.0, 0.1, len(points)))


def bare_ground(rng: np.random.Generator, stamp: float) -> Scan:
    """Rings that are farther apart than any plane is searched for, from half a metre above."""
    radius, azimuth = 0.5 / np.tan(np.deg2rad(np.array([2.0, 5.0, 10.0, 20.0]))), np.linspace(-np.pi, np.pi, 900)
    rings, columns = np.indices((len(radius), len(azimuth))).reshape(2, -1)
    points = radius[rings, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth)])[columns]
    heights = rng.normal(-0.5, 0.01, len(points))
    return Scan(np.column_stack([points, heights]), stamp, rings=rings.astype(np.int32))


@pytest.mark.parametrize(("method", "scan"), [("surfels", clutter), ("loam", bare_ground)])
def test_a_map_of_planes_through_voxels_grows_for_two_seconds_where_nothing_fits(rng, method, scan):
    results = process(Mapper(MappingConfig(method=method)), [scan(rng, 0.5 * number) for number in range(6)])
    assert [result.status for result in results[1:]] == [Status.DEGRADED] * 3 + [Status.LOST] * 2
    assert all(result.degenerate == AXES and result.added for result in results[1:4])
    assert poses_of(results) == pytest.approx(np.tile(np.eye(4), (6, 1, 1)), abs=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_drone_takes_off(seed):
    simulation = simulated("street", "drone-agile", find_sensor("mid-360"), 30, seed)
    scans = list(simulation.scans())
    smoothed = smoothed_start(scans, MappingConfig()).motions
    motions = [smoothed.get(scan.stamp) for scan in scans]
    priors = [NOTHING if one is None else Prior(one.T_prev_curr, one.velocity, one.covariance) for one in motions]
    results = process(Mapper(MappingConfig()), scans, priors)
    truth, estimated = true_poses(simulation, scans), poses_of(results)
    steps = inverse(inverse(truth[:-1]) @ truth[1:]) @ inverse(estimated[:-1]) @ estimated[1:]
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.1
    assert np.linalg.norm((inverse(truth[0]) @ truth[-1] - estimated[-1])[:3, 3]) < 0.5
    assert Status.LOST not in {result.status for result in results}


@pytest.mark.long
def test_between_facades_a_sensor_without_rings_is_not_at_speed():
    """The strokes of its first sweeps fit one another along the houses at 30 m/s, too; it is at rest, then tracked."""
    simulation = simulated("terrace", "tracked", find_sensor("mid-360"), 24, seed=36)
    scans = list(simulation.scans())
    smoothed = smoothed_start(scans, MappingConfig()).motions
    results = process(Mapper(MappingConfig()), scans, [smoothed.get(scan.stamp, NOTHING) for scan in scans])
    truth = true_poses(simulation, scans)
    assert errors(poses_of(results), inverse(truth[0]) @ truth)[0].max() < 0.3
    assert Status.LOST not in {result.status for result in results}


@pytest.mark.long
def test_along_equal_houses_the_later_scans_show_the_speed():
    """At 14 m/s and 5 Hz, in order: each scan fits 2.8 m ahead as well as 0.2 m back, with houses every 3 m."""
    simulation = simulated("terrace", "car-fast", find_sensor("vlp-16"), 60, seed=235)
    velocity = smoothed_start(simulation.scans(6, None, 2), MappingConfig()).velocity
    assert velocity[3:] == pytest.approx([14.1, 0.0, 0.0], abs=0.5)


# What an odometry states of itself: a tenth of a degree and a centimetre.
STATED = np.diag(np.array([np.deg2rad(0.1)] * 3 + [0.01] * 3) ** 2)


@pytest.fixture(scope="module")
def at_speed() -> Simulation:
    return simulated("street", "car-fast", find_sensor("vlp-16"), 12)


@pytest.fixture(scope="module")
def scans(at_speed: Simulation) -> list[Scan]:
    return list(at_speed.scans())


@pytest.fixture(scope="module")
def truth(at_speed: Simulation, scans: list[Scan]) -> FloatArray:
    T_map_lidar = true_poses(at_speed, scans)
    return inverse(T_map_lidar[0]) @ T_map_lidar


def mapped(scans: list[Scan], is_said_to_stand: bool = True) -> list[MappedScan]:
    prior = Prior(np.eye(4), covariance=STATED) if is_said_to_stand else NOTHING
    return process(Mapper(MappingConfig()), scans, [prior] * len(scans))


def worst_m(results: list[MappedScan], truth: FloatArray) -> float:
    return float(errors(poses_of(results), truth)[0].max())


@pytest.mark.long
@pytest.mark.parametrize(("step", "metres"), [(1, 0.05), (3, 0.1)])
def test_without_an_odometry_the_way_of_a_car_at_speed_is_found(scans, truth, step, metres):
    """Three scans apart it is three metres: out of reach of the pose expected of a car that stands."""
    results = mapped(scans[::step], is_said_to_stand=False)
    assert worst_m(results, truth[::step]) < metres
    assert [result.status for result in results] == [Status.OK] * len(results)


def test_an_odometry_that_states_that_it_stands_is_overruled(scans, truth):
    results = mapped(scans)
    assert worst_m(results, truth) < 0.05
    assert Status.LOST not in {result.status for result in results}
    assert results[1].status is Status.DEGRADED, "the first contradiction is reported"
    assert "predict" in results[1].message
    assert [result.status for result in results[-6:]] == [Status.OK] * 6


def test_scans_without_times_are_no_worse(scans, truth):
    """Compensated already, as those of KITTI odometry: nothing within a scan shows the speed."""
    velocities = log(inverse(truth[:-1]) @ truth[1:]) / 0.1
    still = [Scan(move(s.points, s.time_offsets, v), s.stamp) for s, v in zip(scans[:-1], velocities, strict=True)]
    results = mapped(still)
    assert worst_m(results, truth[:-1]) < 0.1
    assert Status.LOST not in {result.status for result in results}
