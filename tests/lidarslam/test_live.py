"""`lidarslam live` with a real publisher in another process, over the loopback interface."""

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from lidarslam.config.settings import Config
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp, inverse, log, make_transform
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.mounting import correct_elevation
from lidarslam.datasets.ros.bag_imu import Edges, add_edges, chain
from lidarslam.datasets.ros.bag_message import TRANSFORMS_TYPE
from lidarslam.datasets.ros.made_messages import header, point_cloud, transforms
from lidarslam.live.live import bounded
from lidarslam.live.messages import CloudDecoder, PosePublisher
from lidarslam.live.receiving import IncomingQueue, LiveStatistics, PublishedTopic, Received, count_missing, find_topic
from lidarslam.mapping.config import MappingConfig
from lidarslam.pipeline.estimates import ScanEstimate, SweepMotion

from ..conftest import succeeds
from .conftest import scan_estimate

LIDARSLAM = [sys.executable, "-m", "lidarslam"]
PLAY = [sys.executable, Path(__file__).parents[2] / "benchmarks" / "play_bag.py"]
PLAYED = ["--topic", "/points", "--reliable", "--linger", "60"]
SCANS = 12
CLOUD = "sensor_msgs/msg/PointCloud2"
STORE = get_typestore(Stores.ROS2_JAZZY)
# Neither other tests nor a robot on the network are met here.
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='localhost'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
_DOMAINS = itertools.count(1 + os.getpid() % 200)


def simulate(folder: Path, scans: int, *options: str) -> Path:
    """A recording of an office, as a bag."""
    sensor = ("--sensor", "vlp-16", "--format", "mcap")
    succeeds("simulate", "-o", folder, "--scans", scans, *sensor, *options)
    return folder


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tmp_path_factory.mktemp("live") / "office", SCANS)


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    pytest.importorskip("cyclonedds")
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    return next(_DOMAINS)


Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def started() -> Iterator[Start]:
    """Starts processes that end with the test."""
    running: list[subprocess.Popen[str]] = []

    def start(*command: object) -> "subprocess.Popen[str]":
        pipe = subprocess.PIPE
        running.append(subprocess.Popen([str(word) for word in command], stdout=pipe, stderr=pipe, text=True))
        return running[-1]

    yield start
    for process in running:
        process.kill()
        process.communicate()


def position(odometry: Any) -> list[float]:
    at = odometry.pose.pose.position
    return [at.x, at.y, at.z]


@pytest.mark.long
def test_a_robot_gets_its_poses_and_the_run_is_that_of_its_bag(bag, tmp_path, domain, started):
    """With constant velocity a run knows no more of a scan than a live one: the poses are the same, bit for bit."""
    from lidarslam.live.dds import DdsNode

    method = ["--odometry", "constant-velocity", "--no-report", "--set", "mapping.budget_ms=1e6"]
    live, ran = tmp_path / "live", tmp_path / "ran"
    node = DdsNode(domain)
    odometry = node.subscribe(PublishedTopic("/lidarslam/odometry", "nav_msgs/msg/Odometry", True))
    transforms = node.subscribe(PublishedTopic("/tf", TRANSFORMS_TYPE, True))
    options = ["--domain", domain, "--scans", SCANS, "--queue", SCANS]
    lidarslam = started(*LIDARSLAM, "live", *options, "-o", live, *method)
    started(*PLAY, bag, "--domain", domain, *PLAYED)
    poses: list[bytes] = []
    moved: list[bytes] = []
    while lidarslam.poll() is None:
        poses += [message.raw for message in odometry.take(0.1)]
        moved += [message.raw for message in transforms.take(0.1)]
    output, errors = lidarslam.communicate()
    assert lidarslam.returncode == 0, errors
    assert f"{SCANS} messages received, 0 missing between their stamps, 0 dropped" in output
    assert "latency from the arrival of a scan to its pose: median" in output
    succeeds("run", bag, "-o", ran, *method)
    for name in ("trajectory.tum", "odometry.tum", "map.ply"):
        assert (live / name).read_bytes() == (ran / name).read_bytes(), name
    trajectory = read_tum(live / "trajectory.tum")
    for raw, stamp, pose in zip(poses, trajectory.stamps, trajectory.T_world_lidar, strict=True):
        message = STORE.deserialize_cdr(raw, "nav_msgs/msg/Odometry")
        assert message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec == pytest.approx(stamp, abs=1e-6)
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "velodyne")
        np.testing.assert_allclose(position(message), pose[:3, 3], atol=1e-8)
    sent = [STORE.deserialize_cdr(raw, TRANSFORMS_TYPE).transforms[0] for raw in moved]
    assert [one.child_frame_id for one in sent] == ["velodyne"] * SCANS
    np.testing.assert_allclose([one.transform.translation.x for one in sent], trajectory.positions[:, 0], atol=1e-8)


def test_scans_wait_for_nothing():
    assert bounded(Config()).mapping.budget_ms == "auto"
    assert not bounded(Config()).pose_graph.corrects_local_map
    given = Config(mapping=MappingConfig(budget_ms=80.0))
    assert bounded(given).mapping == given.mapping


@pytest.mark.long
@pytest.mark.usefixtures("interruptible")
def test_interrupted_it_writes_what_came(bag, tmp_path, domain, started):
    """The poses until then are those of the robot, whose static transforms were published before."""
    from lidarslam.live.dds import DdsNode

    out, T_base_lidar = tmp_path / "live", make_transform(np.diag([-1.0, -1.0, 1.0]), [1.0, 0.0, 2.0])
    node = DdsNode(domain)
    static = node.publisher("/tf_static", TRANSFORMS_TYPE, is_kept=True)
    static(transform("base_link", "velodyne", T_base_lidar))
    odometry = node.subscribe(PublishedTopic("/lidarslam/odometry", "nav_msgs/msg/Odometry", True))
    options = ["--domain", domain, "--topic", "points", "--base-frame", "base_link", "-o", out]
    lidarslam = started(*LIDARSLAM, "live", *options, "--odometry", "constant-velocity", "--rerun", "save")
    started(*PLAY, bag, "--domain", domain, *PLAYED)
    found: list[bytes] = []
    while len(found) < 3 and lidarslam.poll() is None:
        found += [message.raw for message in odometry.take(0.1)]
    lidarslam.send_signal(signal.SIGINT)
    output, errors = lidarslam.communicate(timeout=240)
    assert lidarslam.returncode == 0, errors
    assert f"written to {out}" in output
    written = {"map.ply", "summary.json", "scans.csv", "report.html", "recording.rrd"}
    assert written <= {path.name for path in out.iterdir()}
    T_world_lidar = read_tum(out / "trajectory.tum").T_world_lidar
    last = STORE.deserialize_cdr(found[-1], "nav_msgs/msg/Odometry")
    assert last.child_frame_id == "base_link"
    expected = (T_base_lidar @ T_world_lidar[len(found) - 1] @ inverse(T_base_lidar))[:3, 3]
    np.testing.assert_allclose(position(last), expected, atol=1e-8)


NOW = 1_700_000_000 * 10**9  # of publication


def transform(parent: str, child: str, T: np.ndarray) -> bytes:
    return bytes(STORE.serialize_cdr(transforms(STORE, (header(STORE, 0, parent), child, T)), TRANSFORMS_TYPE))


def message_at(stamp_s: float, frame_id: str = "lidar", last_time: float = 1e8, seed: int = 0) -> bytes:
    """A serialised cloud of 200 points, with times from 0 to 0.1 s in nanoseconds."""
    table = np.zeros(200, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")]))
    for axis, values in zip("xyz", np.random.default_rng(seed).uniform(-5.0, 5.0, (200, 3)).T, strict=True):
        table[axis] = values
    table["t"] = np.linspace(0.0, last_time, 200)
    cloud = point_cloud(STORE, header(STORE, round(1e9 * stamp_s), frame_id), table)
    return bytes(STORE.serialize_cdr(cloud, CLOUD))


@pytest.fixture
def decoder() -> CloudDecoder:
    return CloudDecoder(ReaderConfig(), CLOUD, Faults())


def test_point_times_are_inferred_and_they_and_elevations_corrected_as_set(decoder):
    as_set = CloudDecoder(ReaderConfig(time_scale=-0.5, elevation_correction_deg=0.2), CLOUD, Faults())
    as_sent, corrected = (each.scan(message_at(1000.5, "os"), NOW) for each in (decoder, as_set))
    assert (as_sent.stamp_ns, as_sent.frame_id, as_sent.scan.stamp) == (1_000_500_000_000, "os", 1000.5)
    np.testing.assert_allclose(as_sent.scan.time_offsets, np.linspace(0.0, 0.1, 200), atol=1e-8)
    np.testing.assert_array_equal(corrected.scan.time_offsets, -0.5 * as_sent.scan.time_offsets)
    np.testing.assert_array_equal(corrected.scan.points, correct_elevation(as_sent.scan.points, 0.2))


def test_scans_are_joined_to_sweeps_of_a_set_duration():
    decoder = CloudDecoder(ReaderConfig(sweep_s=0.1), CLOUD, Faults())
    sweeps = [decoder.scan(message_at(1000.5 + 0.02 * number, last_time=2e7), NOW) for number in range(11)]
    assert [None if sweep is None else (sweep.stamp_ns, len(sweep.scan)) for sweep in sweeps] == [
        *[None] * 5, (1_000_540_000_000, 1000), *[None] * 4, (1_000_640_000_000, 1000)
    ]  # fmt: skip
    np.testing.assert_allclose(sweeps[5].scan.time_offsets[[0, -1]], [-0.04, 0.06], atol=1e-7)


def test_parts_of_sweeps_are_joined_once_the_first_half_second_has_shown_them():
    decoder = CloudDecoder(ReaderConfig(), CLOUD, Faults())
    parts = [decoder.scan(message_at(1000.0 + 0.02 * n, last_time=2e7, seed=n), NOW) for n in range(40)]
    assert [0 if part is None else len(part.scan) for part in parts] == [
        *[200] * 25,
        *[0] * 5,
        1000,
        *[0] * 4,
        1000,
        *[0] * 4,
    ]


def test_a_time_field_without_times_is_a_warning():
    faults = Faults()
    decoder = CloudDecoder(ReaderConfig(), CLOUD, faults)
    for number in range(12):
        live = decoder.scan(message_at(1000.0 + 0.1 * number, last_time=0.0), NOW)
        assert live.scan.time_offsets is None
    assert [warning for warning in faults.warnings() if "holds one value alone (0)" in warning]


def test_late_scans_those_of_others_and_damaged_ones_are_left_out_and_counted():
    faults = Faults()
    decoder = CloudDecoder(ReaderConfig(), CLOUD, faults)
    messages = [message_at(100.0), message_at(99.0), message_at(100.1, "rear"), message_at(100.2)[:200], b"\0\1"]
    scans = [decoder.scan(raw, NOW) for raw in [*messages, message_at(100.3)]]
    assert [scan is not None for scan in scans] == [True, False, False, False, False, True]
    assert faults.left_out == 4
    assert "not after" in faults.warnings()[0]
    assert "another sensor" in faults.warnings()[1]


def test_a_stray_stamp_costs_one_scan_and_a_clock_that_was_set_a_few():
    """Clouds are published every tenth of a second, and after a pause of ten seconds."""
    faults = Faults()
    decoder = CloudDecoder(ReaderConfig(), CLOUD, faults)
    published = [*np.arange(0.0, 0.5, 0.1), *np.arange(10.5, 12.0, 0.1)]
    stamps = [100.0 + time_s for time_s in published]
    stamps[2] = 2e9
    stamps[10:] = [stamp + 3600.0 for stamp in stamps[10:]]
    times = zip(stamps, published, strict=True)
    scans = [decoder.scan(message_at(stamp), NOW + round(1e9 * time_s)) for stamp, time_s in times]
    assert [scan is not None for scan in scans] == [number not in (2, *range(10, 15)) for number in range(20)]
    assert "ahead of the time that has passed" in faults.warnings()[0]


@pytest.mark.parametrize(("back_s", "is_set_back"), [(0.5, False), (60.0, True)])
def test_a_clock_that_was_set_back_ends_the_run_with_a_warning(back_s, is_set_back):
    faults = Faults()
    decoder = CloudDecoder(ReaderConfig(), CLOUD, faults)
    steps = 0.1 * np.arange(10)
    for number, stamp in enumerate([*(100.0 + steps), *(100.9 - back_s + 0.01 * steps)]):
        decoder.scan(message_at(stamp), NOW + number * 10**8)
        assert not decoder.is_set_back or number >= 15
    assert decoder.is_set_back == is_set_back
    assert any("clock of the stamps was set back" in warning for warning in faults.warnings()) == is_set_back


@pytest.mark.parametrize("ahead_s", [0.0, 37.0])
def test_a_stray_stamp_at_the_very_beginning_costs_one_scan(decoder, ahead_s):
    """Where the sensor's clock is ahead, as that of TAI, as many scans are lost as when a clock is set ahead."""
    stamps = [2.1e9, *(NOW / 1e9 + ahead_s + 0.1 * number for number in range(1, 8))]
    scans = [decoder.scan(message_at(stamp), NOW + number * 10**8) for number, stamp in enumerate(stamps)]
    assert [scan is None for scan in scans].index(False) == (1 if ahead_s == 0.0 else 5)
    assert scans[-1] is not None


def test_headers_without_stamps_have_the_time_of_publication(decoder):
    scans = [decoder.scan(message_at(0.0), published_ns) for published_ns in (10**18, 10**18 + 10**8)]
    assert [scan.stamp_ns for scan in scans if scan is not None] == [10**18, 10**18 + 10**8]


def test_a_full_queue_drops_every_second_message_rather_than_a_stretch():
    batches = iter([[Received(bytes([n]), 10 * n) for n in range(1, 17)]])
    queue = IncomingQueue(lambda _: next(batches, []), longest=8)
    with queue:
        while not next(batches, True) or queue.dropped < 8:
            time.sleep(0.001)
    taken = [message.published_ns for message in iter(lambda: queue.take(0.0), None)]
    assert len(taken) == 8
    assert taken[-1] == 160
    assert np.diff([0, *taken]).max() <= 30


def test_an_error_of_receiving_is_raised_where_messages_are_taken():
    def receive(_: float) -> list[Received]:
        raise InputError("gone")

    with IncomingQueue(receive, 2) as queue, pytest.raises(InputError, match="gone"):
        while queue.take(1.0) is None:
            pass


def test_missing_scans_are_counted_by_the_gaps_between_stamps():
    stamps = 1e9 + 0.1 * np.arange(50) + 0.005 * np.random.default_rng(0).standard_normal(50)
    arrivals, some = 0.1 * np.arange(50), np.delete(np.arange(50), [7, 20, 21, 22])
    assert count_missing(stamps, arrivals) == 0
    assert count_missing(stamps[some], arrivals[some]) == 4
    assert count_missing(stamps[:1], arrivals[:1]) == 0
    for late_s, missing in ((0.08, 0), (1e9, 1)):  # a late scan is not missing, and an outlier alone is
        assert count_missing(stamps + np.where(np.arange(50) == 30, late_s, 0.0), arrivals) == missing
    assert count_missing(stamps + np.where(np.arange(50) < 30, 0.0, 3600.0), arrivals) == 0


def test_latency_counts_from_arrival_and_from_stamps_of_the_same_clock():
    now, arrived_s, statistics = time.time(), time.monotonic() - 0.1, LiveStatistics()
    statistics.arrived(now - 0.2, arrived_s)
    statistics.registered(now - 0.2, arrived_s)
    counts = statistics.counts(dropped=0)
    assert 100.0 <= counts.from_arrival.median_ms < counts.from_stamp.median_ms
    assert not counts.warnings()
    other = LiveStatistics()
    other.registered(5.0, arrived_s)
    assert other.counts(dropped=3).from_stamp is None
    assert "3 scans dropped" in other.counts(dropped=3).warnings()[0]


def test_the_only_topic_of_a_type_is_taken_once_discovery_has_settled(monkeypatch):
    monkeypatch.setattr("lidarslam.live.receiving._SETTLED_S", 0.0)
    clouds, other = PublishedTopic("/points", CLOUD), PublishedTopic("/scan", "sensor_msgs/msg/LaserScan")
    several = [PublishedTopic("/a", CLOUD), PublishedTopic("/b", CLOUD), other]
    seen = iter([[], [other], [clouds]])
    assert find_topic(lambda: next(seen, [clouds]), None, [CLOUD], "--topic") is clouds
    assert find_topic(lambda: several, "b", [CLOUD], "--topic") is several[1]
    with pytest.raises(InputError, match="several are published, /a, /b; choose one with --topic"):
        find_topic(lambda: several, None, [CLOUD], "--topic")
    with pytest.raises(InputError, match="/scan: holds sensor_msgs/msg/LaserScan"):
        find_topic(lambda: [other], "/scan", [CLOUD], "--topic")
    with pytest.raises(InputError, match=r"0.3 s are over, waiting for /points; 0 topics are seen"):
        find_topic(lambda: [], "/points", [CLOUD], "--topic", 0.3)


VELOCITY, COVARIANCE = np.array([0.0, 0.0, 0.5, 2.0, 0.0, 0.0]), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-4


def localised(T: np.ndarray, status: Status = Status.OK) -> ScanEstimate:
    return scan_estimate(0.0, T, status, covariance=COVARIANCE, motion=SweepMotion(VELOCITY, VELOCITY))


def test_the_pose_of_the_body_follows_from_that_of_the_lidar():
    """A body that turns about itself: its LiDAR, one metre ahead, moves sideways, and the body does not."""
    T_body_lidar = make_transform(np.eye(3), [1.0, 0.0, 0.0])
    turn = exp(np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0]))
    sent: list[bytes] = []
    publisher = PosePublisher(sent.append, sent.append, "odom", "base_link", T_body_lidar)
    T_world_lidar = inverse(T_body_lidar) @ turn @ T_body_lidar
    publisher.publish(1_500_000_000, localised(T_world_lidar))
    odometry = STORE.deserialize_cdr(sent[0], "nav_msgs/msg/Odometry")
    turned = odometry.pose.pose.orientation
    np.testing.assert_allclose(position(odometry), 0.0, atol=1e-12)
    np.testing.assert_allclose([turned.z, turned.w], [np.sin(0.15), np.cos(0.15)])
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (1, 500_000_000)
    linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
    np.testing.assert_allclose([linear.x, linear.y, angular.z], [2.0, -0.5, 0.5], atol=1e-12)
    transform = STORE.deserialize_cdr(sent[1], TRANSFORMS_TYPE).transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    publisher.publish(1_600_000_000, localised(turn, Status.LOST))
    assert len(sent) == 2


def test_covariances_are_those_of_errors_along_the_fixed_axes(rng):
    """Against the spread of poses with random errors in the frame of the body."""
    T = exp(np.array([0.3, -0.8, 1.2, 4.0, 5.0, 6.0]))
    poses = T @ exp(rng.multivariate_normal(np.zeros(6), COVARIANCE, 200_000))
    moved = poses[:, :3, 3] - T[:3, 3]
    turned = log(make_transform(poses[:, :3, :3] @ T[:3, :3].T, np.zeros((len(poses), 3))))[:, :3]
    sent: list[bytes] = []
    PosePublisher(sent.append, None, "odom", "lidar", np.eye(4)).publish(0, localised(T))
    covariance = STORE.deserialize_cdr(sent[0], "nav_msgs/msg/Odometry").pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(covariance, np.cov(np.hstack([moved, turned]).T), atol=5e-6)


def test_static_transforms_are_chained_in_both_directions():
    a, b = exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])), exp(np.array([0.0, 0.0, 1.0, 0.0, 1.0, 0.0]))
    edges: Edges = {}
    for parent, child, T in (("/base_link", "mast", a), ("os_lidar", "os_sensor", b), ("mast", "os_sensor", a)):
        add_edges(edges, transform(parent, child, T), ros2=True)
    add_edges(edges, b"damaged", ros2=True)
    np.testing.assert_allclose(chain(edges, "base_link", "os_lidar"), a @ a @ inverse(b), atol=1e-12)
    assert chain(edges, "base_link", "camera") is None


def play(bag: Path, domain: int) -> None:
    """Publish all topics of a bag at the times at which they were recorded, once somebody takes its clouds."""
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsSubscription
    from cyclonedds.domain import DomainParticipant

    from lidarslam.live.dds import DdsNode

    node = DdsNode(domain)
    participant = DomainParticipant(domain)  # held, as the library deletes objects without a reference
    subscribed = BuiltinDataReader(participant, BuiltinTopicDcpsSubscription)
    with AnyReader([bag]) as reader:
        publishers = {
            connection.topic: node.publisher(connection.topic, connection.msgtype, connection.topic == "/tf_static")
            for connection in reader.connections
        }
        messages = [(connection.topic, time_ns, bytes(raw)) for connection, time_ns, raw in reader.messages()]
    while "rt/velodyne_points" not in [one.topic_name for one in subscribed.read(1000)]:
        time.sleep(0.05)
    begin, first_ns = time.monotonic() + 0.5, messages[0][1]
    for topic, time_ns, raw in messages:
        time.sleep(max(0.0, begin + (time_ns - first_ns) / 1e9 - time.monotonic()))
        publishers[topic](raw)


@pytest.mark.long
def test_an_imu_beside_the_clouds_takes_part(tmp_path, domain, started):
    """Its place on the LiDAR comes from /tf_static."""
    walk, errors = simulate(tmp_path / "walk", 30, "--imu"), {}
    for method in ("imu", "constant-velocity"):
        live = tmp_path / method
        options = ["--domain", domain, "--duration", "2.5", "-o", live, "--odometry", method, "--no-report"]
        lidarslam = started(*LIDARSLAM, "live", *options, "--set", "mapping.budget_ms=1e6")
        play(walk, domain)
        output, said = lidarslam.communicate(timeout=60)
        assert lidarslam.returncode == 0, said
        assert "no sample of the IMU" not in output
        found, truth = read_tum(live / "trajectory.tum"), read_tum(walk / "ground_truth.tum")
        assert len(found) > 22
        true = truth.relative_motions()[np.searchsorted(truth.stamps, found.stamps[0] - 1e-6) :][: len(found) - 1]
        turns = log(inverse(found.relative_motions()) @ true)[:, :3]
        errors[method] = float(np.rad2deg(np.sqrt((turns**2).sum(axis=1).mean())))
    assert 3.0 * errors["imu"] < errors["constant-velocity"], errors
