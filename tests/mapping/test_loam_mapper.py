"""Sweeps of known truth through LOAM's mapping: accuracy, degenerate directions, the way back, a state that goes on."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, rotation_angle
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.loam.feature_map import FeatureMap
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper

VELOCITY = np.array([0.0, 0.01, 0.3, 0.8, 0.05, 0.0])  # of the drive
NOTHING = Prior()
LOAM = MappingConfig(method="loam")


def process(mapper: Mapper, scans: list[Scan], priors: list[Prior] | None = None) -> list[MappedScan]:
    return [mapper.process(scan, prior) for scan, prior in zip(scans, priors or [NOTHING] * len(scans), strict=True)]


def true_priors(truth: Trajectory) -> list[Prior]:
    return [Prior(T, VELOCITY) for T in (np.eye(4), *truth.relative_motions())]


def errors(results: list[MappedScan], T_room_lidar: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (N,) in metres and angles (N,) in degrees from the truth, whose world is the first scan's frame."""
    truth = inverse(T_room_lidar[0]) @ T_room_lidar[: len(results)]
    error = inverse(truth) @ np.array([result.state.T_world_lidar for result in results])
    return np.linalg.norm(error[:, :3, 3], axis=1), np.rad2deg(rotation_angle(error))


def assert_true(results: list[MappedScan], T_room_lidar: FloatArray, metres: float, degrees: float) -> None:
    distance, angle = errors(results, T_room_lidar)
    assert distance.max() < metres
    assert angle.max() < degrees
    assert [result.status for result in results] == [Status.OK] * len(results)


@pytest.fixture
def mapper() -> Mapper:
    return Mapper(LOAM)


def test_the_first_scan_makes_maps_of_edges_and_planes(mapper, ring_scans):
    first = mapper.process(ring_scans[0], NOTHING)
    np.testing.assert_array_equal(first.state.T_world_lidar, np.eye(4))
    assert (first.status, first.registered, first.added, first.fit) == (Status.OK, False, True, None)
    assert isinstance(mapper.local_map, FeatureMap)
    assert min(len(grid) for grid in mapper.local_map.grids) > 10


def test_poses_are_true_with_the_true_motion(mapper, ring_scans, room_truth):
    results = process(mapper, ring_scans, true_priors(room_truth))
    assert_true(results, room_truth.T_world_lidar, 0.003, 0.1)
    assert all(result.registered and result.added and result.is_connected for result in results[1:])


@pytest.mark.parametrize("seed", range(2))
def test_poses_are_true_from_wrong_motions(mapper, ring_scans, room_truth, seed):
    """Each is wrong by a degree and ten centimetres; the velocity is true."""
    axes = np.random.default_rng(seed).normal(size=(20, 2, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    off = exp(np.concatenate([np.deg2rad(1.0) * axes[:, 0], 0.1 * axes[:, 1]], axis=1))
    priors = [
        replace(prior, T_prev_curr=prior.T_prev_curr @ T) for prior, T in zip(true_priors(room_truth), off, strict=True)
    ]
    priors[0] = Prior(velocity=VELOCITY)
    assert_true(process(mapper, ring_scans, priors), room_truth.T_world_lidar, 0.006, 0.15)


def test_poses_and_velocities_are_true_without_any_prior(mapper, ring_scans, room_truth):
    """The first sweep is bent by a motion that is not known yet."""
    results = process(mapper, ring_scans)
    assert_true(results, room_truth.T_world_lidar, 0.01, 0.25)
    np.testing.assert_allclose(results[-1].state.velocity[:3], VELOCITY[:3], atol=np.deg2rad(2.0))
    np.testing.assert_allclose(results[-1].state.velocity[3:], VELOCITY[3:], atol=0.1)


def test_poses_are_true_with_noise(mapper, ring_scans, room_truth, rng):
    """Two centimetres along the ray."""
    scans = []
    for scan in ring_scans:
        ranges = np.linalg.norm(scan.points, axis=1, keepdims=True)
        scans.append(replace(scan, points=scan.points * (1.0 + 0.02 * rng.standard_normal(ranges.shape) / ranges)))
    assert_true(process(mapper, scans, true_priors(room_truth)), room_truth.T_world_lidar, 0.006, 0.15)


def test_a_sensor_that_was_carried_away_is_relocalised(mapper, ring_scans, room_truth):
    """Covered for a second and turned by 100 degrees in the meantime."""
    process(mapper, ring_scans[:10], true_priors(room_truth)[:10])
    assert mapper.process(Scan(np.empty((0, 3)), ring_scans[10].stamp, np.empty(0)), NOTHING).status is Status.LOST
    turn = exp([0.0, 0.0, np.deg2rad(100.0), 0.0, 0.0, 0.0])
    turned = [replace(scan, points=scan.points @ turn[:3, :3], stamp=scan.stamp + 1.0) for scan in ring_scans[11:20]]
    results = process(mapper, turned)
    truth = inverse(room_truth.T_world_lidar[0]) @ room_truth.T_world_lidar[11:20] @ turn
    error = inverse(truth) @ np.array([result.state.T_world_lidar for result in results])
    assert any("relocalised" in result.message for result in results)
    assert np.linalg.norm(error[-1, :3, 3]) < 0.05
    assert np.rad2deg(rotation_angle(error[-1])) < 1.0


def test_along_a_corridor_the_odometry_is_kept(mapper):
    """Walls, floor and ceiling along x, the sensor's way; the odometry is a tenth too short."""
    half = np.array([1e3, 1.5, 1.2])

    def scan(stamp: float) -> Scan:
        azimuth, elevation = np.meshgrid(
            np.deg2rad(np.arange(0.0, 360.0, 0.5)), np.deg2rad(np.arange(-28.0, 29.0, 2.0))
        )
        rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        rays = rays.reshape(3, -1).T
        ranges = (half / np.maximum(np.abs(rays), 1e-12))[:, 1:].min(axis=1)
        near = ranges < 6.0  # else incidence is grazing
        rings = np.arange(29, dtype=np.int32).repeat(720)
        return Scan((rays * ranges[:, None])[near], stamp, rings=rings[near])

    way = exp([0.0, 0.0, 0.0, 0.09, 0.0, 0.0])
    results = process(mapper, [scan(0.1 * k) for k in range(6)], [Prior(way)] * 6)
    sigmas = [np.sqrt(result.state.covariance[3, 3]) for result in results[1:]]
    for k, result in enumerate(results[1:], start=1):
        assert result.status is Status.DEGRADED
        assert "x" in result.degenerate
        assert result.state.T_world_lidar[0, 3] == pytest.approx(0.09 * k, abs=0.02)
        np.testing.assert_allclose(result.state.T_world_lidar[1:3, 3], 0.0, atol=5e-3)
    assert (np.diff(sigmas) > 0.0).all(), "the uncertainty grows on the way"


def test_a_mapper_goes_on(ring_scans, through_disk):
    """Among the scans is an empty one."""
    scans = list(ring_scans[:10])
    scans[7] = Scan(np.empty((0, 3)), scans[7].stamp, np.empty(0))
    whole = Mapper(LOAM)
    expected = process(whole, scans)
    for after in (1, 5, 8):
        first, second = Mapper(LOAM), Mapper(LOAM)
        process(first, scans[:after])
        second.restore(through_disk(first.state()))
        for scan, mapped in zip(scans[after:], expected[after:], strict=True):
            found = second.process(scan, NOTHING)
            np.testing.assert_array_equal(found.state.T_world_lidar, mapped.state.T_world_lidar)
            np.testing.assert_array_equal(found.state.covariance, mapped.state.covariance)
            assert (found.status, found.message, found.fit) == (mapped.status, mapped.message, mapped.fit)
