"""Every format, read back with the program's own readers."""

import weakref
from dataclasses import replace

import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader

from lidarslam.core.geometry import exp, transform_points
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.datasets.published.kitti import read_entry, read_tr
from lidarslam.datasets.registry import open_recording
from lidarslam.datasets.ros.bag_message import typestore
from lidarslam.simulation.bag_writer import DRIVERS
from lidarslam.simulation.recorder import CLOCK_START_NS, Rig, SimulatedScan, clock_ns
from lidarslam.simulation.writers import FORMATS, T_CAM_LIDAR

BAGS = ("rosbag1", "rosbag2", "mcap")
SWEEP_S = 0.1
STAMPS = (0.0, 0.1, 0.2, 0.30000000000000004)


@pytest.fixture(scope="module")
def sweeps(room, drive):
    """Rolling sweeps through the room, stamped at their start, in the float32 that all formats hold."""
    made = []
    for stamp in STAMPS:
        rng = np.random.default_rng(round(10 * stamp))
        swept = room.sweep(drive, stamp, stamp_at=0.0)
        points = swept.points.astype(np.float32).astype(np.float64)
        rings = rng.integers(0, 16, len(points)).astype(np.int32)
        scan = Scan(points, stamp, swept.time_offsets, rings)
        made.append(SimulatedScan(scan, rng.integers(0, 256, len(points)).astype(np.float32)))
    return made


@pytest.fixture
def rig(drive):
    return Rig("velodyne", SWEEP_S, drive)


def some_imu():
    """Samples from 0 to 0.5 s that can be recognised."""
    stamps = np.arange(101) / 200
    turns, forces = np.random.default_rng(3).normal([[[0.0] * 3], [[1.0, 2.0, 9.5]]], 0.3, (2, 101, 3))
    return ImuSamples(stamps, turns, forces, exp([0.1, 0.2, 3.0, 0.05, -0.02, 0.1]))


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("name", ["ply", *BAGS])
def test_scans_and_imu_of_every_driver_in_every_format(name, driver, tmp_path, sweeps, rig):
    imu = some_imu()
    recording = write(name, tmp_path / "room", sweeps, replace(rig, driver=driver, imu=imu))
    assert recording.name == "room"
    assert len(recording) == len(sweeps)
    for scan, expected in zip(recording.scans(), (sweep.scan for sweep in sweeps), strict=True):
        assert scan.stamp == clock_ns(expected.stamp) / 10**9
        np.testing.assert_array_equal(scan.points, expected.points)
        np.testing.assert_array_equal(scan.rings, expected.rings)
        np.testing.assert_allclose(scan.time_offsets, expected.time_offsets, rtol=0.0, atol=5e-7)
    found = recording.imu
    np.testing.assert_array_equal(found.stamps, [clock_ns(stamp) / 10**9 for stamp in imu.stamps])
    np.testing.assert_allclose(found.angular_velocities, imu.angular_velocities, rtol=1e-8)
    np.testing.assert_allclose(found.accelerations, imu.accelerations, rtol=1e-8)
    np.testing.assert_allclose(found.T_lidar_imu, imu.T_lidar_imu, atol=1e-11)
    assert found.notes == ()
    info, summary = recording.describe(), recording.describe().imu
    assert not info.first.dropped
    assert not info.notes
    if name in BAGS:
        assert info.topic == DRIVERS[driver].topic
        assert info.point_time.reference == ("absolute" if driver in ("hesai", "livox") else "relative")
    assert (summary.samples, round(summary.rate_hz), summary.has_extrinsic) == (101, 200, True)
    assert summary.name == {"ply": "imu.csv"}.get(name, DRIVERS[driver].imu_topic)


def write(name, folder, sweeps, rig):
    """The recording that the program's reader finds in a folder with the scans."""
    FORMATS[name].write(folder, iter(sweeps), rig)
    return open_recording(FORMATS[name].source_in(folder))


# What the drivers publish, written down from their sources: name, offset and datatype of each field, then the step.
_F4, _F8, _U2, _U4 = 7, 8, 4, 6
_XYZ = [("x", 0, _F4), ("y", 4, _F4), ("z", 8, _F4)]
PUBLISHED = {
    "velodyne": ([*_XYZ, ("intensity", 12, _F4), ("ring", 16, _U2), ("time", 18, _F4)], 22),
    "ouster": (
        [
            *_XYZ, ("intensity", 16, _F4), ("t", 20, _U4), ("reflectivity", 24, _U2), ("ring", 26, _U2),
            ("ambient", 28, _U2), ("range", 32, _U4),
        ],
        48,
    ),
    "hesai": ([*_XYZ, ("intensity", 12, _F4), ("ring", 16, _U2), ("timestamp", 18, _F8)], 26),
}  # fmt: skip


@pytest.mark.parametrize(("name", "driver"), zip(BAGS, PUBLISHED, strict=True))
def test_messages_are_laid_out_as_the_driver_lays_them_out(name, driver, tmp_path, sweeps, rig):
    for record_ns, message, simulated in messages(name, driver, tmp_path / "room", sweeps, rig):
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        assert stamp_ns == clock_ns(simulated.scan.stamp) > CLOCK_START_NS - 1
        assert record_ns == stamp_ns + round(SWEEP_S * 1e9)
        fields, step = PUBLISHED[driver]
        assert [(field.name, field.offset, field.datatype) for field in message.fields] == fields
        assert {field.count for field in message.fields} == {1}
        assert (message.point_step, message.row_step) == (step, step * len(simulated.scan))
        assert (message.height, message.width) == (1, len(simulated.scan))
        assert message.data.shape == (message.row_step,)
        assert message.is_dense
        assert not message.is_bigendian


def messages(name, driver, folder, sweeps, rig):
    """Record stamp and message, decoded by rosbags with the definitions in the bag, with the sweep it was made of."""
    FORMATS[name].write(folder, iter(sweeps), replace(rig, driver=driver))
    source = FORMATS[name].source_in(folder)
    store = typestore(ros2=name != "rosbag1")
    with (Rosbag1Reader if name == "rosbag1" else Rosbag2Reader)(source) as reader:
        deserialize = store.deserialize_ros1 if name == "rosbag1" else store.deserialize_cdr
        found = [(record_ns, deserialize(raw, c.msgtype)) for c, record_ns, raw in reader.messages()]
        assert [connection.topic for connection in reader.connections] == [DRIVERS[driver].topic]
    assert len(found) == len(sweeps)
    return [(*row, simulated) for row, simulated in zip(found, sweeps, strict=True)]


@pytest.mark.parametrize("name", BAGS)
def test_livox_messages_are_whole_to_another_decoder(name, tmp_path, sweeps, rig):
    few = [SimulatedScan(s.scan.select(np.arange(40)), s.intensities[:40]) for s in sweeps]
    for number, (record_ns, message, simulated) in enumerate(messages(name, "livox", tmp_path / "x", few, rig)):
        stamp_ns = clock_ns(simulated.scan.stamp)
        assert (message.timebase, message.point_num, record_ns) == (stamp_ns, 40, stamp_ns + round(SWEEP_S * 1e9))
        assert message.header.frame_id == "livox_frame"
        assert getattr(message.header, "seq", number) == number
        decoded = [[p.x, p.y, p.z] for p in message.points]
        np.testing.assert_array_equal(decoded, simulated.scan.points)
        offset_ns = [p.offset_time for p in message.points]
        np.testing.assert_allclose(offset_ns, 1e9 * simulated.scan.time_offsets, rtol=0.0, atol=0.51)
        assert [p.line for p in message.points] == simulated.scan.rings.tolist()
        assert [p.reflectivity for p in message.points] == simulated.intensities.astype(int).tolist()


@pytest.mark.parametrize(("name", "driver"), [("rosbag1", "livox"), ("rosbag2", "livox"), ("mcap", "ouster")])
def test_a_scan_without_points(name, driver, tmp_path, sweeps, rig):
    nothing = SimulatedScan(sweeps[1].scan.select(np.arange(0)), sweeps[1].intensities[:0])
    recording = write(name, tmp_path / "x", [sweeps[0], nothing, sweeps[2]], replace(rig, driver=driver))
    assert [len(scan) for scan in recording.scans()] == [len(sweeps[0].scan), 0, len(sweeps[2].scan)]


def test_ply(tmp_path, sweeps, rig):
    recording = write("ply", tmp_path / "room", sweeps, rig)
    for scan, simulated in zip(recording.scans(), sweeps, strict=True):
        np.testing.assert_allclose(scan.time_offsets, simulated.scan.time_offsets, rtol=0.0, atol=0.51e-9)
    info = recording.describe()
    assert [f"{field.name} {field.type_name}" for field in info.fields] == [
        "x float32", "y float32", "z float32", "intensity float32", "t uint32", "ring uint16",
    ]  # fmt: skip
    assert (info.point_time.unit, info.point_time.reference) == ("ns", "relative")


def test_kitti_scans_are_compensated_exactly_and_the_truth_comes_through_the_calibration(tmp_path, sweeps, rig, room):
    recording = write("kitti", tmp_path / "drive", sweeps, rig)
    T_room_lidar = rig.T_world_lidar_at(np.array(STAMPS))
    for scan, simulated, T in zip(recording.scans(), sweeps, T_room_lidar, strict=True):
        assert scan.stamp == pytest.approx(simulated.scan.stamp, abs=1e-9)
        assert scan.time_offsets is None
        # The reader raises the points by KITTI's angle, so what comes out is where the surfaces are.
        assert room.distance_to_surface(transform_points(T, scan.points)).max() < 2e-5
        assert room.distance_to_surface(transform_points(T, simulated.scan.points)).max() > 0.05
    np.testing.assert_allclose(recording.ground_truth.stamps, STAMPS, atol=1e-9)
    np.testing.assert_allclose(recording.ground_truth.T_world_lidar, T_room_lidar, atol=1e-8)
    assert recording.describe().ground_truth == tmp_path / "drive" / "poses" / "00.txt"


def test_kitti_cameras_stand_on_one_line_across_the_car_and_look_ahead(tmp_path, sweeps, rig):
    write("kitti", tmp_path / "drive", sweeps[:1], rig)
    path = tmp_path / "drive" / "sequences" / "00" / "calib.txt"
    np.testing.assert_allclose(read_tr(path), T_CAM_LIDAR, atol=1e-12)
    assert np.rad2deg(np.arccos(T_CAM_LIDAR[2, 0])) < 1.5  # the camera's z is the LiDAR's x, nearly
    P = np.stack([read_entry(path, 12, f"P{camera}").reshape(3, 4) for camera in range(4)])
    np.testing.assert_array_equal(P[:, :, :3], P[[0] * 4, :, :3])
    assert (-P[:, 0, 3] / P[:, 0, 0]).round(3).tolist() == [0.0, 0.537, -0.063, 0.469]


@pytest.mark.parametrize("name", FORMATS)
def test_one_scan_is_held_at_a_time(name, tmp_path, sweeps, rig):
    alive = weakref.WeakSet()
    most = 0

    def stream():
        nonlocal most
        for number in range(12):
            source = sweeps[number % len(sweeps)]
            scan = Scan(source.scan.points, 0.1 * number, source.scan.time_offsets, source.scan.rings)
            made = SimulatedScan(scan, source.intensities)
            alive.add(made)
            yield made
            del made, scan
            most = max(most, len(alive))

    FORMATS[name].write(tmp_path / "room", stream(), rig)
    assert most == 1  # the writer's own, when the next one is asked for


@pytest.mark.parametrize("name", FORMATS)
def test_declared_files_are_the_written_ones(name, tmp_path, sweeps, rig):
    FORMATS[name].write(tmp_path / "room", iter(sweeps[:2]), replace(rig, imu=some_imu()))
    patterns = FORMATS[name].files
    for entry in (tmp_path / "room").iterdir():
        assert any(entry.match(pattern) for pattern in patterns)
    assert all(any((tmp_path / "room").glob(pattern)) for pattern in patterns)
