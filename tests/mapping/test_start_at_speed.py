"""Cars that are at speed at the first scan, with an odometry that says nothing, the truth, or that they stand."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, inverse, log
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import move
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.sensors import find_sensor

from .runs import errors, poses_of, simulated
from .runs import process as mapped

COUNT = 12
# What an odometry states of itself: a tenth of a degree and a centimetre.
STATED = np.diag(np.array([np.deg2rad(0.1)] * 3 + [0.01] * 3) ** 2)


@pytest.fixture(scope="module")
def at_speed() -> Simulation:
    return simulated("street", "car-fast", find_sensor("vlp-16"), COUNT)


@pytest.fixture(scope="module")
def scans(at_speed: Simulation) -> list[Scan]:
    return list(at_speed.scans())


@pytest.fixture(scope="module")
def truth(at_speed: Simulation, scans: list[Scan]) -> FloatArray:
    T_map_lidar = at_speed.ground_truth.at(np.array([scan.stamp for scan in scans]), 0.2)
    return np.asarray(inverse(T_map_lidar[0]) @ T_map_lidar, dtype=np.float64)


def process(scans: list[Scan], motions: list[FloatArray | None]) -> list[MappedScan]:
    priors = [Prior() if motion is None else Prior(motion, covariance=STATED) for motion in motions]
    return mapped(Mapper(MappingConfig()), scans, priors)


def worst_m(results: list[MappedScan], truth: FloatArray) -> float:
    return float(errors(poses_of(results), truth)[0].max())


@pytest.mark.long
@pytest.mark.parametrize(("step", "metres"), [(1, 0.05), (3, 0.1)])
def test_without_an_odometry_its_way_is_found(scans, truth, step, metres):
    """Three scans apart it is three metres: out of reach of the pose expected of a car that stands."""
    results = process(scans[::step], [None] * len(scans[::step]))
    assert worst_m(results, truth[::step]) < metres
    assert [result.status for result in results] == [Status.OK] * len(results)


def test_an_odometry_that_states_that_it_stands_is_overruled(scans, truth):
    results = process(scans, [np.eye(4)] * COUNT)
    assert worst_m(results, truth) < 0.05
    assert Status.LOST not in {result.status for result in results}
    assert results[1].status is Status.DEGRADED, "the first contradiction is reported"
    assert "predict" in results[1].message
    assert [result.status for result in results[-6:]] == [Status.OK] * 6


def test_scans_without_times_are_no_worse(scans, truth):
    """Compensated already, as those of KITTI odometry: nothing within a scan shows the speed."""
    velocities = log(inverse(truth[:-1]) @ truth[1:]) / 0.1
    still = [Scan(move(s.points, s.time_offsets, v), s.stamp) for s, v in zip(scans[:-1], velocities, strict=True)]
    results = process(still, [np.eye(4)] * len(still))
    assert worst_m(results, truth[:-1]) < 0.1
    assert Status.LOST not in {result.status for result in results}
