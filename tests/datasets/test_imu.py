"""IMU samples of bags, folders and KITTI raw drives, and how they are made usable."""

from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp, inverse
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.imu_samples import read_imu_csv, usable_samples
from lidarslam.datasets.info_text import describe_source
from lidarslam.datasets.registry import open_recording
from lidarslam.datasets.ros import made_messages

from .conftest import STAMP_NS

IMU_PERIOD_NS = 5_000_000
T_LIDAR_BASE = exp([0.1, -0.2, 0.3, 0.5, 0.0, -1.0])
T_BASE_IMU = exp([0.0, 0.0, 3.0, 0.1, 0.2, 0.3])


class Samples:
    """Random samples of an IMU, and the messages that hold them."""

    def __init__(self, rng, count=41, in_g=False):
        self.stamps_ns = [STAMP_NS + IMU_PERIOD_NS * k for k in range(count)]
        self.stamps = np.array([stamp_ns / 10**9 for stamp_ns in self.stamps_ns])
        self.w = rng.normal(0.0, 0.2, (count, 3))
        self.a = rng.normal([0.0, 0.0, 9.8], 0.2, (count, 3))
        self.in_g = in_g

    def messages(self, kit, frame_id="imu", order=None):
        found = []
        for number in range(len(self.w)) if order is None else order:
            acceleration = self.a[number] / (9.80665 if self.in_g else 1.0)
            message = kit.imu(self.stamps_ns[number], frame_id, self.w[number], acceleration)
            found.append((STAMP_NS + IMU_PERIOD_NS * len(found) + 1_000_000, message))
        return found

    def assert_found(self, imu, rtol=1e-15):
        np.testing.assert_allclose(imu.stamps, self.stamps, rtol=0, atol=3e-7)
        np.testing.assert_array_equal(imu.angular_velocities, self.w)
        np.testing.assert_allclose(imu.accelerations, self.a, rtol=rtol)


@pytest.fixture
def samples(rng):
    return Samples(rng)


def transforms(kit, *edges):
    """A message of transforms from named parents to named children."""
    named = ((made_messages.header(kit.store, 0, parent), child, T) for parent, child, T in edges)
    return made_messages.transforms(kit.store, *named)


@pytest.fixture
def write_bag(velodyne_clouds):
    """Write a bag of two clouds and other topics."""
    return lambda kit, topics: kit.write({"/points": velodyne_clouds(kit, 2), **topics})


@pytest.mark.parametrize("frame_id", ["imu", "imu_link", "/a/longer_name_of_23_bytes"])  # CDR pads behind it
def test_every_kind_of_bag(bag_kit, write_bag, samples, frame_id):
    imu = open_recording(write_bag(bag_kit, {"/imu": samples.messages(bag_kit, frame_id)})).imu
    samples.assert_found(imu)
    assert imu.T_lidar_imu is None
    assert imu.notes == ()
    assert imu.rate_hz == pytest.approx(200.0, rel=1e-3)


def test_the_extrinsic_goes_along_the_chain_of_frames(bag_kit, write_bag, samples):
    static = [(STAMP_NS, transforms(bag_kit, ("base", "/imu", T_BASE_IMU), ("base", "mast", np.eye(4))))]
    static += [(STAMP_NS + 1, transforms(bag_kit, ("mast", "lidar", inverse(T_LIDAR_BASE))))]
    path = write_bag(bag_kit, {"/imu": samples.messages(bag_kit), "/tf_static": static})
    np.testing.assert_allclose(open_recording(path).imu.T_lidar_imu, T_LIDAR_BASE @ T_BASE_IMU, atol=1e-12)
    text = describe_source(path, ReaderConfig())
    assert "/imu, 41 samples at 200 Hz, extrinsic known" in text
    assert "An IMU is there: run with --odometry learned+imu." in text


def test_frames_that_are_not_connected(ros2_kit, write_bag, samples):
    static = [(STAMP_NS, transforms(ros2_kit, ("base", "imu", T_BASE_IMU), ("map", "lidar", np.eye(4))))]
    path = write_bag(ros2_kit, {"/imu": samples.messages(ros2_kit), "/tf_static": static})
    assert open_recording(path).imu.T_lidar_imu is None
    assert "extrinsic unknown" in describe_source(path, ReaderConfig())


def test_samples_in_disorder_repeated_and_broken(ros2_kit, write_bag, samples):
    order = [*range(5, 41), 3, 3, *range(5)]
    samples.w[10] = np.nan
    imu = open_recording(write_bag(ros2_kit, {"/imu": samples.messages(ros2_kit, order=order)})).imu
    kept = np.delete(np.arange(41), 10)
    np.testing.assert_array_equal(imu.stamps, samples.stamps[kept])
    np.testing.assert_array_equal(imu.angular_velocities, samples.w[kept])
    assert "1 IMU sample with a number that is not finite left out." in imu.notes
    assert "2 IMU samples with the stamp of another left out." in imu.notes


def test_accelerations_in_g(ros2_kit, write_bag, rng):
    samples = Samples(rng, in_g=True)
    path = write_bag(ros2_kit, {"/imu": samples.messages(ros2_kit)})
    imu = open_recording(path).imu
    samples.assert_found(imu, rtol=1e-12)
    assert "in g" in imu.notes[0]
    assert "are in g" in describe_source(path, ReaderConfig())


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ({"/camera/imu": "imu_camera", "/front/imu": "imu_front"}, "/front/imu"),
        ({"/camera/imu": "base", "/vn100/data": "front_imu"}, "/vn100/data"),
    ],
)
def test_of_several_the_nearest(ros2_kit, velodyne_clouds, rng, names, expected):
    clouds = velodyne_clouds(ros2_kit, 2)
    for _, cloud in clouds:
        cloud.header.frame_id = "front_lidar"
    found = {name: Samples(rng, 60 - 10 * k) for k, name in enumerate(names)}
    recorded = {name: found[name].messages(ros2_kit, frame_id) for name, frame_id in names.items()}
    path = ros2_kit.write({"/front/points": clouds, **recorded})
    found[expected].assert_found(open_recording(path).imu)
    other = next(name for name in names if name != expected)
    found[other].assert_found(open_recording(path, ReaderConfig(imu_topic=other)).imu)
    with pytest.raises(InputError, match=f"imu_topic is '/none'; its IMU topics: .*{expected}"):
        _ = open_recording(path, ReaderConfig(imu_topic="/none")).imu


def test_where_no_cloud_is_stamped_samples_have_the_times_of_recording(ros2_kit, velodyne_clouds, samples):
    clouds = velodyne_clouds(ros2_kit, 2)
    for _, cloud in clouds:
        cloud.header.stamp.sec = cloud.header.stamp.nanosec = 0
    path = ros2_kit.write({"/points": clouds, "/imu": samples.messages(ros2_kit)})
    np.testing.assert_allclose(open_recording(path).imu.stamps, samples.stamps + 1e-3, atol=1e-6)


def folder_of_scans(path: Path, count=3):
    path.mkdir()
    for number in range(count):
        np.save(path / f"scan_{number}.npy", np.random.default_rng(number).uniform(1, 9, (50, 3)))
    (path / "timestamps.txt").write_text("".join(f"{STAMP_NS / 1e9 + 0.1 * k:.9f}\n" for k in range(count)))
    return path


def test_nanoseconds_with_an_exponent(tmp_path):
    table = np.column_stack([1.4e18 + 5e6 * np.arange(4), np.ones((4, 6))])
    np.savetxt(tmp_path / "imu.csv", table, delimiter=",")
    np.testing.assert_allclose(read_imu_csv(tmp_path / "imu.csv").stamps, 1.4e9 + 0.005 * np.arange(4), atol=1e-6)


@pytest.mark.parametrize("unit", ["s", "ns"])
def test_a_table_beside_the_scans(tmp_path, samples, unit):
    folder = folder_of_scans(tmp_path / "scans")
    rows = [
        f"{t if unit == 'ns' else f'{t / 10**9:.9f}'},{','.join(map(repr, (*w.tolist(), *a.tolist())))}"
        for t, w, a in zip(samples.stamps_ns, samples.w, samples.a, strict=True)
    ]
    extrinsic = " ".join(map(repr, T_BASE_IMU[:3].ravel().tolist()))
    euroc = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1]"
    head = [euroc] if unit == "ns" else [f"# T_lidar_imu: {extrinsic}", "stamp_s,wx,wy,wz,ax,ay,az"]
    (folder / "imu.csv").write_text("\n".join([*head, *rows, ""]))
    recording = open_recording(folder)
    samples.assert_found(recording.imu)
    known = "unknown" if unit == "ns" else "known"
    assert f"imu.csv, 41 samples at 200 Hz, extrinsic {known}" in describe_source(folder, ReaderConfig())
    if known == "known":
        np.testing.assert_allclose(recording.imu.T_lidar_imu, T_BASE_IMU, atol=1e-12)
    assert len(recording) == 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("stamp,a\n1,2,3,4,5,6,7\n2,x,3,4,5,6,7\n", "csv:3: expected 7 numbers.*'2,x"),
        ("1,2,3\n", "expected 7 numbers"),
        ("# T_lidar_imu: 1 2 3\n1,2,3,4,5,6,7\n", "first three rows of a rigid transform"),
        (f"# T_lidar_imu: {'2 ' * 12}\n1,2,3,4,5,6,7\n", "rigid transform"),
    ],
)
def test_a_damaged_table(tmp_path, content, message):
    folder = folder_of_scans(tmp_path / "scans")
    (folder / "imu.csv").write_text(content)
    recording = open_recording(folder)
    assert len(list(recording.scans())) == 3
    with pytest.raises(InputError, match=message):
        _ = recording.imu


def test_samples_out_of_the_sensors_range_are_left_out():
    stamps = np.arange(400) / 200
    rates = np.stack([3 * np.sin(stamps), np.cos(stamps), 0 * stamps], axis=1)
    forces = np.tile([0.0, 0.0, 9.81], (400, 1))
    found = usable_samples(stamps, np.clip(rates, -2.0, 2.0), forces, None)
    expected = np.abs(rates[:, 0]) < 2.0
    np.testing.assert_array_equal(found.stamps, stamps[expected])
    assert found.notes == (f"{(~expected).sum()} IMU samples out of the sensor's range left out.",)
    assert usable_samples(stamps, rates, forces, None).notes == ()


def test_missing_samples_are_noted(rng):
    stamps = np.arange(1000) / 200
    kept = rng.permutation(1000) >= 100
    zeros, forces = np.zeros((900, 3)), np.tile([0.0, 0.0, 9.81], (900, 1))
    (note,) = usable_samples(stamps[kept], zeros, forces, None).notes
    assert note == "10 % of the IMU's samples are missing."
    jittered = stamps[:900] + rng.uniform(-0.001, 0.001, 900)
    assert usable_samples(jittered, zeros, forces, None).notes == ()
