"""A run as a bag, read back by rosbags and by the libraries of MCAP, and as a recording."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, transform_points
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import open_recording
from lidarslam.exports.source import read_run_scans
from lidarslam.mapping.global_map.point_cloud import PointCloud

from ..conftest import lidarslam, succeeds, write_run
from .conftest import refused

SCANS = 6
FIRST_STAMP = 1_700_000_000.123456789
VELOCITY = np.array([0.0, 0.0, 0.4, 6.0, 0.3, 0.0])
SIGMAS = (0.001, 0.002, 0.003, 0.01, 0.02, 0.05)


@pytest.fixture
def landmarks(rng: np.random.Generator) -> FloatArray:
    """Fixed points of the world."""
    return rng.uniform(-20.0, 20.0, (500, 3))


@pytest.fixture
def run(tmp_path: Path, landmarks: FloatArray) -> Path:
    """A run of constant velocity over sweeps of 0.1 s; the odometry drifts, and the last scan is lost."""
    recording = tmp_path / "recording"
    recording.mkdir()
    stamps = FIRST_STAMP + 0.1 * np.arange(SCANS)
    offsets = np.linspace(0.0, 0.1, len(landmarks))
    for number in range(SCANS):
        T = inverse(exp(np.multiply.outer(0.1 * number + offsets, VELOCITY)))
        points = np.einsum("nij,nj->ni", T[:, :3, :3], landmarks) + T[:, :3, 3]
        table = np.zeros(len(points), [*((name, "f4") for name in ("x", "y", "z", "t", "intensity")), ("ring", "u2")])
        table["x"], table["y"], table["z"], table["t"] = *points.T, offsets
        table["intensity"], table["ring"] = np.arange(len(points)), np.arange(len(points)) % 16
        np.save(recording / f"{number:06d}.npy", table)
    np.savetxt(recording / "timestamps.txt", stamps, fmt="%.9f")
    T = exp(np.multiply.outer(0.1 * np.arange(SCANS), VELOCITY))
    about = {"source": str(recording), "start": 0, "stop": None, "step": 1}
    cloud = PointCloud(landmarks, np.zeros((500, 3)))
    folder = write_run(tmp_path / "run", Trajectory(stamps, T), cloud, **about)
    drift = exp(np.multiply.outer(np.arange(SCANS), [0.0, 0.0, 0.01, 0.02, 0.0, 0.0]))
    Trajectory(stamps, T @ drift).save(folder / "odometry.tum")
    names = ("sigma_rx", "sigma_ry", "sigma_rz", "sigma_x", "sigma_y", "sigma_z")
    rows = [["ok", *map(str, SIGMAS)]] * (SCANS - 1) + [["lost", *[""] * 6]]
    (folder / "scans.csv").write_text("\n".join(",".join(row) for row in [["status", *names], *rows]) + "\n")
    return folder


def pose(message: Any) -> FloatArray:
    """Of a Pose or a Transform."""
    t = message.position if hasattr(message, "position") else message.translation
    q = message.orientation if hasattr(message, "orientation") else message.rotation
    return make_transform(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [t.x, t.y, t.z])


def xyz(cloud: Any) -> FloatArray:
    raw = np.frombuffer(bytes(cloud.data), np.uint8).reshape(cloud.width, cloud.point_step)
    assert [field.name for field in cloud.fields[:3]] == ["x", "y", "z"]
    return raw[:, :12].copy().view("<f4").astype(np.float64)


def read_with_rosbags(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    messages = defaultdict(list)
    with AnyReader([bag]) as reader:
        for connection, recorded_ns, data in reader.messages():
            messages[connection.topic].append((recorded_ns, reader.deserialize(data, connection.msgtype)))
    return messages


def read_with_mcap(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    pytest.importorskip("mcap_ros2")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    messages = defaultdict(list)
    with bag.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            messages[channel.topic].append((message.log_time, decoded))
    return messages


BAGS = [(name, read_with_rosbags) for name in ("slam.mcap", "slam.bag", "slam.db3", "slam")]


@pytest.mark.parametrize(("name", "read"), [*BAGS, ("slam.mcap", read_with_mcap)])
def test_poses_and_points_come_back(run, landmarks, tmp_path, name, read):
    succeeds("export-bag", run, "--out", tmp_path / name)
    messages = read(tmp_path / name)
    scans = read_run_scans(run)
    stamps_ns = [round(stamp * 1e9) for stamp in scans.trajectory.stamps]
    assert sorted(messages) == ["/map_points", "/odometry", "/path", "/points", "/tf"]
    for topic in ("/odometry", "/points"):
        stamps = [message.header.stamp for _, message in messages[topic]]
        assert [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps] == stamps_ns
        assert [recorded for recorded, _ in messages[topic]] == stamps_ns
    for number, (_, odometry) in enumerate(messages["/odometry"]):
        T = scans.trajectory.T_world_lidar[number]
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "lidar")
        np.testing.assert_allclose(pose(odometry.pose.pose), T, atol=1e-9)
        map_to_odom, odom_to_lidar = messages["/tf"][number][1].transforms
        assert (map_to_odom.header.frame_id, map_to_odom.child_frame_id) == ("map", "odom")
        assert (odom_to_lidar.header.frame_id, odom_to_lidar.child_frame_id) == ("odom", "lidar")
        np.testing.assert_allclose(pose(map_to_odom.transform) @ pose(odom_to_lidar.transform), T, atol=1e-9)
        np.testing.assert_allclose(pose(odom_to_lidar.transform), scans.odometry.T_world_lidar[number], atol=1e-9)
        points = xyz(messages["/points"][number][1])
        error = np.abs(transform_points(T, points) - landmarks).max()
        assert error < 1e-4 if number < SCANS - 1 else error > 0.1  # a lost scan has no motion to be deskewed with
    path = messages["/path"][0][1]
    np.testing.assert_allclose([pose(each.pose) for each in path.poses], scans.trajectory.T_world_lidar, atol=1e-9)
    np.testing.assert_allclose(xyz(messages["/map_points"][0][1]), landmarks, atol=1e-5)


def test_covariance_and_velocity_are_in_the_frames_of_ros(run, tmp_path):
    succeeds("export-bag", run, "--out", tmp_path / "slam.mcap", "--no-clouds")
    messages = read_with_rosbags(tmp_path / "slam.mcap")
    assert "/points" not in messages
    odometry = [message for _, message in messages["/odometry"]]
    R = pose(odometry[3].pose.pose)[:3, :3]
    covariance = odometry[3].pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(R.T @ covariance[:3, :3] @ R, np.diag(SIGMAS[3:]) ** 2, atol=1e-9)
    np.testing.assert_allclose(R.T @ covariance[3:, 3:] @ R, np.diag(SIGMAS[:3]) ** 2, atol=1e-9)
    assert not odometry[-1].pose.covariance.any()
    twist = odometry[3].twist.twist
    found = [twist.angular.x, twist.angular.y, twist.angular.z, twist.linear.x, twist.linear.y, twist.linear.z]
    np.testing.assert_allclose(found, VELOCITY, atol=1e-6)


def test_path_and_map_are_latched(run, tmp_path):
    latched = {}
    for name in ("slam.mcap", "slam.bag"):
        succeeds("export-bag", run, "--out", tmp_path / name, "--no-clouds")
        with AnyReader([tmp_path / name]) as reader:
            latched[name] = {c.topic: c.ext for c in reader.connections}
    assert {topic for topic, ext in latched["slam.bag"].items() if ext.latching} == {"/path", "/map_points"}
    durable = {topic: ext.offered_qos_profiles[0].durability.name for topic, ext in latched["slam.mcap"].items()}
    kinds = {"/path": "TRANSIENT_LOCAL", "/map_points": "TRANSIENT_LOCAL", "/tf": "VOLATILE", "/odometry": "VOLATILE"}
    assert durable == kinds


def test_the_bag_is_a_recording(run, landmarks, tmp_path):
    succeeds("export-bag", run, "--out", tmp_path / "slam.mcap")
    scans = list(open_recording(tmp_path / "slam.mcap", ReaderConfig(topic="/points")).scans())
    trajectory = read_run_scans(run).trajectory
    assert [scan.stamp for scan in scans] == trajectory.stamps.tolist()
    for scan, T in zip(scans[:-1], trajectory.T_world_lidar, strict=False):
        assert scan.time_offsets is None
        np.testing.assert_allclose(transform_points(T, scan.points), landmarks, atol=1e-4)
        np.testing.assert_array_equal(scan.intensities, np.arange(len(landmarks)))
        np.testing.assert_array_equal(scan.rings, np.arange(len(landmarks)) % 16)


def test_what_is_in_the_way(run, tmp_path):
    out = tmp_path / "slam.mcap"
    out.write_text("mine")
    refused("export-bag", run, "--out", out)
    assert out.read_text() == "mine"
    succeeds("export-bag", run, "--out", out, "--overwrite")
    assert lidarslam("export-bag", run, "--out", tmp_path / "slam.zip").exit_code == 2
    (tmp_path / "recording").rename(tmp_path / "elsewhere")
    assert "leave them out with --no-clouds" in refused("export-bag", run, "--out", tmp_path / "slam.bag")
    assert not list(tmp_path.glob(".partial*"))
    succeeds("export-bag", run, "--out", tmp_path / "slam.bag", "--no-clouds")


def test_the_recording_is_not_replaced(run, tmp_path):
    """Nor a file of it."""
    about = {"source": str(tmp_path / "site.mcap"), "start": 0, "stop": None, "step": 1}
    (tmp_path / "site.mcap").write_text("recorded")
    of_bag = write_run(tmp_path / "of_bag", read_run_scans(run).trajectory, **about)
    for of, out in ((of_bag, tmp_path / "site.mcap"), (run, tmp_path / "recording/000000.npy")):
        out.rename(named := out.with_suffix(".mcap"))
        assert "belongs to the recording" in refused("export-bag", of, "--out", named, "--overwrite")
