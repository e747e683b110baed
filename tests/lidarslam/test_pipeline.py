"""Scans of known truth through the pipeline: poses, map, and what happens when tracking is lost."""

import ctypes
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from scipy.spatial import cKDTree

from lidarslam.config.settings import Config
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, inverse, log, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.motion.deskew import move
from lidarslam.mapping.pose_graph.keyframe_graph import GraphScan
from lidarslam.odometry.interface import Motion
from lidarslam.odometry.methods.consistency import ConsistencyCheck
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.estimates import STAGES
from lidarslam.pipeline.localisation import OdometryAlone, make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import EVERY_SCANS
from lidarslam.simulation.record import RecordRequest, make_simulation


def make_pipeline(odometry: Any, follower: Any = None, **config: float) -> Pipeline:
    config = {"voxel_size_m": 0.1} | config
    return Pipeline(odometry, OdometryAlone(ConsistencyCheck()), GlobalMapConfig(**config), follower)


@pytest.fixture
def true_odometry(room_truth: Trajectory) -> ExternalOdometry:
    return ExternalOdometry(room_truth)


def test_true_motions_give_true_poses_and_a_true_map(
    true_odometry: ExternalOdometry, room: Any, room_scans: list[Scan], room_truth: Trajectory
) -> None:
    pipeline = make_pipeline(true_odometry)
    results = list(pipeline.run(room_scans))
    truth = inverse(room_truth.T_world_lidar[0]) @ room_truth.T_world_lidar
    np.testing.assert_allclose([result.T_world_lidar for result in results], truth, atol=1e-9)
    assert all(result.status is Status.OK for result in results)
    assert all(set(result.stage_ms) == set(STAGES) for result in results)
    assert pipeline.map.global_map is not None
    in_room = transform_points(room_truth.T_world_lidar[0], pipeline.map.global_map.points())
    # A voxel's mean may lie off a corner by a part of the voxel; nothing else may lie off a surface.
    distance = room.distance_to_surface(in_room)
    assert np.median(distance) < 1e-6
    assert distance.max() < 0.06


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="needs glibc")
def test_free_memory_is_returned(true_odometry: ExternalOdometry, room_scans: list[Scan]) -> None:
    """Blocks that are kept between others hold what is freed around them."""
    blocks = [b"x" * 60_000 for _ in range(4_000)]
    kept = blocks[::50]
    del blocks
    before = psutil.Process().memory_info().rss
    scans = [replace(room_scans[0].select(np.arange(0)), stamp=0.1 * k) for k in range(EVERY_SCANS + 1)]
    list(make_pipeline(true_odometry).run(scans))
    assert len(kept) == 80
    assert psutil.Process().memory_info().rss < before - 100e6


class _Astray:
    """True motions, but for one scan whose motion is wrong or not measured."""

    def __init__(self, truth: Trajectory, index: int, error: list[float], failure: str | None = None) -> None:
        self._motions = [np.eye(4), *truth.relative_motions()]
        self._motions[index] = self._motions[index] @ exp(error)
        self._failures = {index: failure}
        self._next = 0

    def estimate(self, scan: Scan) -> Motion:
        index, self._next = self._next, self._next + 1
        return Motion(self._motions[index], len(scan), self._failures.get(index))

    def close(self) -> None:
        pass


@pytest.mark.parametrize("failure", [None, "the sensor was covered"])
def test_a_lost_scan_is_said_to_be_lost_and_stays_out_of_the_map(
    room: Any, room_scans: list[Scan], room_truth: Trajectory, failure: str | None
) -> None:
    error = [0.0] * 6 if failure else [0.0, 0.0, 0.4, 0.0, 0.0, 0.0]
    pipeline = make_pipeline(_Astray(room_truth, 19, error, failure))
    results = list(pipeline.run(room_scans))
    # The scan before the last is compensated with the wrong motion, and may show it.
    statuses = [result.status for result in results]
    assert statuses[:18] == [Status.OK] * 18
    assert statuses[18:] in ([Status.OK, Status.LOST], [Status.DEGRADED, Status.LOST])
    assert failure is None or results[19].message == failure
    assert pipeline.map.global_map is not None
    in_room = transform_points(room_truth.T_world_lidar[0], pipeline.map.global_map.points())
    assert room.distance_to_surface(in_room).max() < 0.06, "no wall is drawn twice"


def test_an_error_of_a_reader_reaches_the_caller_after_the_scans_before_it(
    true_odometry: ExternalOdometry, room_scans: list[Scan]
) -> None:
    def scans() -> Any:
        yield from room_scans[:3]
        raise InputError("disk")

    results = []
    with pytest.raises(InputError, match="disk"):
        for result in make_pipeline(true_odometry).run(scans()):
            results.append(result)
    assert len(results) == 3


class _Notes:
    """A follower that writes down what it is told."""

    def __init__(self) -> None:
        self.told: list[Any] = []
        self.store: list[Any] = []  # of submaps

    def draw(self, points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float, _attributes: object) -> None:
        assert voxel_size_m == 0.1
        self.told.append((len(points), T_world_lidar))

    def add(self, scan: GraphScan) -> None:
        self.told.append(scan)

    @property
    def scans(self) -> list[GraphScan]:
        return [one for one in self.told if isinstance(one, GraphScan)]


def test_a_follower_sees_what_a_scan_showed_before_the_next(
    true_odometry: ExternalOdometry, room_scans: list[Scan]
) -> None:
    notes = _Notes()
    results = list(make_pipeline(true_odometry, notes).run(room_scans))
    assert [isinstance(one, GraphScan) for one in notes.told] == [True, *([False, True] * 19), False]
    for result, scan, drawn in zip(results, notes.scans, notes.told[1::2], strict=True):
        assert scan.T_world_lidar is result.T_world_lidar
        assert scan.belongs_in_map
        assert not scan.lost
        assert drawn[0] == len(result.points)
        assert drawn[1] is result.T_world_lidar
    poses = np.array([result.T_world_lidar for result in results])
    motions = [scan.T_prev_curr for scan in notes.scans[1:]]
    np.testing.assert_allclose(motions, inverse(poses[:-1]) @ poses[1:], atol=1e-12)


def test_a_follower_hears_of_a_lost_scan_and_does_not_draw_it(room_scans: list[Scan], room_truth: Trajectory) -> None:
    notes = _Notes()
    list(make_pipeline(_Astray(room_truth, 19, [0.0] * 6, "the sensor was covered"), notes).run(room_scans))
    assert [scan.lost for scan in notes.scans] == [False] * 19 + [True]
    assert notes.scans[19].T_prev_curr is None
    assert isinstance(notes.told[-1], GraphScan)


def test_a_follower_is_up_to_date_when_a_run_is_broken_off(
    true_odometry: ExternalOdometry, room_scans: list[Scan]
) -> None:
    notes = _Notes()
    results = make_pipeline(true_odometry, notes).run(room_scans)
    for _ in range(5):
        next(results)
    results.close()
    assert len(notes.scans) >= 5
    assert not any(thread.name.startswith("graph") for thread in threading.enumerate())


def test_a_sweep_is_compensated_with_the_motion_after_it(room: Any, room_truth: Trajectory) -> None:
    """A robot that stands still for a second and then turns: stamps at the sweeps' starts, as drivers put them."""

    def turning(time: FloatArray) -> FloatArray:
        angle = np.maximum(0.0, np.asarray(time) - 1.0) * 2.0
        return exp(np.multiply.outer(angle, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))

    stamps = 0.1 * np.arange(8, 14)
    truth = Trajectory(stamps, turning(stamps))
    scans = [room.sweep(turning, float(stamp), stamp_at=0.0) for stamp in stamps]
    results = list(make_pipeline(ExternalOdometry(truth)).run(scans))
    for result, T_room_lidar in zip(results[:-1], truth.T_world_lidar, strict=False):
        assert room.distance_to_surface(transform_points(T_room_lidar, result.points)).max() < 1e-6
    assert all(result.status is Status.OK for result in results)


def test_the_first_sweep_enters_the_map_with_the_velocity_that_the_second_shows() -> None:
    """A car at speed, without an odometry: nothing is known of the first sweep's motion until the second."""
    simulation = make_simulation(RecordRequest(Path(), "street", "vlp-16", "car-fast", "upright", 2, 0, ""))
    first, second = simulation.scans()
    config = Config.model_validate({"odometry": {"method": "constant-velocity"}})
    pipeline = Pipeline(make_odometry(config.odometry), make_localiser(config), GlobalMapConfig(voxel_size_m=0.2))
    results = list(pipeline.run([first, second]))
    assert all(result.status is Status.OK for result in results)
    T_map_lidar = simulation.ground_truth.at(np.array([first.stamp, second.stamp]), 0.2)
    velocity = log(inverse(T_map_lidar[0]) @ T_map_lidar[1]) / (second.stamp - first.stamp)
    assert np.linalg.norm(velocity[3:]) > 9.0
    assert first.time_offsets is not None
    true = move(first.points, first.time_offsets, velocity)
    assert pipeline.map.global_map is not None
    distance, _ = cKDTree(pipeline.map.global_map.points()).query(true[np.linalg.norm(true, axis=1) < 30.0])
    assert np.quantile(distance, 0.99) < 0.2, "a voxel; the sweep moves by a metre"


def test_the_range_is_cropped(true_odometry: ExternalOdometry, room: Any, drive: Callable[..., FloatArray]) -> None:
    scans = [room.sweep(drive, float(stamp)) for stamp in (0.1, 0.2)]
    for result in make_pipeline(true_odometry, min_range_m=2.0, max_range_m=4.0).run(scans):
        ranges = np.linalg.norm(result.points, axis=1)
        assert ranges.min() > 1.9  # compensation moves points by centimetres after the crop
        assert ranges.max() < 4.1
