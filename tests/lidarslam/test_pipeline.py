"""Scans of known truth through the pipeline: poses, map, and what happens when tracking is lost; its threads."""

import ctypes
import itertools
import threading
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
from lidarslam.mapping.config import GlobalMapConfig, KeyframeConfig
from lidarslam.mapping.global_map.global_map import GlobalMap
from lidarslam.mapping.motion.deskew import move
from lidarslam.mapping.pose_graph.keyframe_graph import GraphScan, KeyframeGraph
from lidarslam.odometry.interface import Motion
from lidarslam.odometry.methods.consistency import ConsistencyCheck
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.estimates import STAGES
from lidarslam.pipeline.localisation import OdometryAlone, make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import EVERY_SCANS, BackgroundWorker, prefetch
from lidarslam.simulation.record import RecordRequest, make_simulation


def make_pipeline(odometry: Any, follower: Any = None, **config: float) -> Pipeline:
    config = {"voxel_size_m": 0.1} | config
    return Pipeline(odometry, OdometryAlone(ConsistencyCheck()), GlobalMapConfig(**config), follower)


@pytest.fixture
def true_odometry(room_truth: Trajectory) -> ExternalOdometry:
    return ExternalOdometry(room_truth)


def test_true_motions_give_true_poses_and_a_true_map(true_odometry, room, room_scans, room_truth):
    pipeline = make_pipeline(true_odometry)
    results = list(pipeline.run(room_scans))
    truth = inverse(room_truth.T_world_lidar[0]) @ room_truth.T_world_lidar
    np.testing.assert_allclose([result.T_world_lidar for result in results], truth, atol=1e-9)
    assert all(result.status is Status.OK for result in results)
    assert all(set(result.stage_ms) == set(STAGES) for result in results)
    in_room = transform_points(room_truth.T_world_lidar[0], pipeline.map.global_map.points())
    # A voxel's mean may lie off a corner by a part of the voxel; nothing else may lie off a surface.
    distance = room.distance_to_surface(in_room)
    assert np.median(distance) < 1e-6
    assert distance.max() < 0.06


def test_with_a_pose_graph_the_map_is_that_of_its_submaps(true_odometry, room_scans):
    graph = KeyframeGraph(KeyframeConfig(distance_m=0.5))
    pipeline = make_pipeline(true_odometry, graph)
    list(pipeline.run(room_scans))
    assert len(graph.store) == 2
    submaps = GlobalMap(0.1)
    for means, keyframe in zip(graph.store, graph.keyframes, strict=False):  # the last one is still open
        submaps.add_means(means, graph.scan_poses[keyframe.scan])
    np.testing.assert_array_equal(pipeline.map.global_map.points(), submaps.points())
    graph.close()


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="needs glibc")
def test_free_memory_is_returned(true_odometry, room_scans):
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


class _Notes:
    """A follower that writes down what it is told."""

    def __init__(self) -> None:
        self.told: list[Any] = []
        self.drawn: list[FloatArray] = []  # points in the world

    def draw(self, points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float, _attributes: object) -> None:
        assert voxel_size_m == 0.1
        self.told.append((len(points), T_world_lidar))
        self.drawn.append(transform_points(T_world_lidar, points))

    def add(self, scan: GraphScan) -> None:
        self.told.append(scan)

    @property
    def scans(self) -> list[GraphScan]:
        return [one for one in self.told if isinstance(one, GraphScan)]


@pytest.mark.parametrize("failure", [None, "the sensor was covered"])
def test_a_lost_scan_is_said_to_be_lost_and_stays_out_of_the_map(room, room_scans, room_truth, failure):
    error = [0.0] * 6 if failure else [0.0, 0.0, 0.4, 0.0, 0.0, 0.0]
    pipeline = make_pipeline(_Astray(room_truth, 19, error, failure), notes := _Notes())
    results = list(pipeline.run(room_scans))
    # The scan before the last is compensated with the wrong motion, and may show it.
    statuses = [result.status for result in results]
    assert statuses[:18] == [Status.OK] * 18
    assert statuses[18:] in ([Status.OK, Status.LOST], [Status.DEGRADED, Status.LOST])
    assert failure is None or results[19].message == failure
    in_room = transform_points(room_truth.T_world_lidar[0], np.concatenate(notes.drawn))
    assert room.distance_to_surface(in_room).max() < 0.06, "no wall is drawn twice"
    assert [scan.lost for scan in notes.scans] == [status is Status.LOST for status in statuses]
    assert failure is None or notes.scans[19].T_prev_curr is None
    assert isinstance(notes.told[-1], GraphScan), "which is not drawn"


def test_an_error_of_a_reader_reaches_the_caller_after_the_scans_before_it(true_odometry, room_scans):
    def scans() -> Any:
        yield from room_scans[:3]
        raise InputError("disk")

    results = []
    with pytest.raises(InputError, match="disk"):
        for result in make_pipeline(true_odometry).run(scans()):
            results.append(result)
    assert len(results) == 3


def test_a_follower_sees_what_a_scan_showed_before_the_next(true_odometry, room_scans):
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


def test_a_follower_is_up_to_date_when_a_run_is_broken_off(true_odometry, room_scans):
    notes = _Notes()
    results = make_pipeline(true_odometry, notes).run(room_scans)
    for _ in range(5):
        next(results)
    results.close()
    assert len(notes.scans) >= 5
    assert not any(thread.name.startswith("graph") for thread in threading.enumerate())


def test_a_sweep_is_compensated_with_the_motion_after_it(room, room_truth):
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


def test_the_first_sweep_enters_the_map_with_the_velocity_that_the_second_shows():
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
    true = move(first.points, first.time_offsets, velocity)
    distance, _ = cKDTree(pipeline.map.global_map.points()).query(true[np.linalg.norm(true, axis=1) < 30.0])
    assert np.quantile(distance, 0.99) < 0.2, "a voxel; the sweep moves by a metre"


def test_the_range_is_cropped(true_odometry, room, drive):
    scans = [room.sweep(drive, float(stamp)) for stamp in (0.1, 0.2)]
    for result in make_pipeline(true_odometry, min_range_m=2.0, max_range_m=4.0).run(scans):
        ranges = np.linalg.norm(result.points, axis=1)
        assert ranges.min() > 1.9  # compensation moves points by centimetres after the crop
        assert ranges.max() < 4.1


def test_reads_no_further_ahead_than_it_may_and_leaving_early_ends_the_thread():
    made = []
    reader = prefetch((made.append(item) for item in itertools.count()), ahead=2)
    next(reader)
    reader.close()
    assert len(made) <= 5
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]


class Slow:
    """Goes on when it may, and notes its calls."""

    def __init__(self) -> None:
        self.may = threading.Event()
        self.calls: list[int] = []
        self.threads: set[str] = set()

    def call(self, number: int) -> None:
        assert self.may.wait(10.0)
        self.calls.append(number)
        self.threads.add(threading.current_thread().name)


def test_calls_are_carried_out_in_order_on_a_thread_of_their_own():
    slow, worker = Slow(), BackgroundWorker("graph", max_pending=20)
    for number in range(10):
        worker.submit(slow.call, number)
    assert not slow.calls
    slow.may.set()
    worker.close()
    assert slow.calls == list(range(10))
    assert slow.threads == {"graph_0"}


def test_the_caller_waits_when_too_many_calls_are_pending():
    slow, worker = Slow(), BackgroundWorker("graph", max_pending=2)
    worker.submit(slow.call, 0)
    worker.submit(slow.call, 1)
    third = threading.Thread(target=worker.submit, args=(slow.call, 2))
    third.start()
    third.join(0.2)
    assert third.is_alive()
    slow.may.set()
    third.join(10.0)
    assert not third.is_alive()
    worker.close()
    assert slow.calls == [0, 1, 2]


@pytest.mark.parametrize("wait", ["wait", "close"])
def test_an_error_is_raised(wait):
    worker = BackgroundWorker("graph", max_pending=2)
    worker.submit(int, "no number")
    with pytest.raises(ValueError, match="no number"):
        getattr(worker, wait)()
