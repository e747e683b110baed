"""Recordings of an Ouster, written by the maker's library from scans of a simulated room, with a sensor's metadata."""

import struct

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.info_text import describe_source
from lidarslam.datasets.packets.ouster import find_metadata
from lidarslam.datasets.registry import open_recording

core = pytest.importorskip("ouster.sdk.core", reason="needs ouster-sdk (pip install --no-deps ouster-sdk)")

FIRST_NS, PERIOD_NS, COUNT = 1_700_000_000_000_000_000, 100_000_000, 4
HALF_ROOM = np.array([7.0, 5.0, 3.0])


@pytest.fixture(scope="module")
def sensor():
    """An OS1-64 with 1024 columns and its design values."""
    info = core.SensorInfo.from_default(core.LidarMode._1024x10)
    info.format.udp_profile_lidar = core.UDPProfileLidar.RNG19_RFL8_SIG16_NIR16
    info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
    info.fw_rev, info.image_rev = "v2.4.0", "ousteros-image-prod-aries-v2.4.0"
    info.sn, info.init_id = 122233334, 5
    return core.SensorInfo(info.to_json_string())


@pytest.fixture(scope="module")
def frames(sensor):
    """Frames of ranges in the room, whose first and last columns of the first were not received."""
    unit = core.XYZLut(sensor, use_extrinsics=False)(np.full((sensor.h, sensor.w), 1000, np.uint32))
    made = []
    for number in range(COUNT):
        frame = core.LidarFrame(sensor)
        frame.frame_id = 700 + number
        ranges = 1000.0 * (HALF_ROOM / np.maximum(np.abs(unit), 1e-6)).min(axis=-1)
        ranges[:, ::11] = 0.0  # no return
        frame.field("RANGE")[:] = ranges
        frame.field("REFLECTIVITY")[:] = np.arange(sensor.h)[:, np.newaxis] + number
        frame.field("SIGNAL")[:] = 999
        columns = np.arange(sensor.w)
        frame.timestamp[:] = (FIRST_NS + number * PERIOD_NS + columns * PERIOD_NS // sensor.w).astype(np.uint64)
        frame.measurement_id[:] = columns
        frame.status[:] = 1
        frame.packet_timestamp[:] = frame.timestamp[:: sensor.format.columns_per_packet]
        made.append(frame)
    return made


@pytest.fixture(scope="module")
def packets(sensor, frames):
    """LiDAR packets of all frames with one IMU packet before each frame."""
    layout, made = core.PacketFormat(sensor), []
    for number, frame in enumerate(frames):
        imu = core.ImuPacket(layout)
        ns = FIRST_NS + number * PERIOD_NS
        values = struct.pack("<QQQ6f", ns, ns + 10, ns + 20, 0.0, 0.5, 1.0, 90.0 - number, 0.0, number - 180.0)
        imu.buf[:] = np.frombuffer(values, np.uint8)
        for packet in (imu, *core.frame_to_packets(frame, layout, sensor.init_id, sensor.sn)):
            packet.host_timestamp = FIRST_NS + len(made) * 1_500_000
            made.append(packet)
    return made


@pytest.fixture(params=["osf", "pcap"])
def recorded(request, tmp_path, sensor, frames, packets):
    path = tmp_path / f"drive.{request.param}"
    if request.param == "osf":
        osf = pytest.importorskip("ouster.sdk.osf")
        writer = osf.Writer(str(path), sensor)
        for frame in frames:
            writer.save(0, frame)
        writer.close()
        return path
    pcap = pytest.importorskip("ouster.sdk.pcap", exc_type=ImportError)
    pcap.record(packets, str(path))
    (tmp_path / "drive_metadata.json").write_text(sensor.to_json_string())
    (tmp_path / "drive.json").write_text("{}")  # is something else
    return path


def assert_equal(scans, sensor, frames):
    lookup = core.XYZLut(sensor, use_extrinsics=False)
    assert len(scans) == len(frames)
    for number, (scan, frame) in enumerate(zip(scans, frames, strict=True)):
        ranges = frame.field("RANGE")
        expected = lookup(ranges)
        returns = ranges > 0
        assert scan.stamp == (FIRST_NS + number * PERIOD_NS) / 1e9
        np.testing.assert_allclose(
            scan.points[np.lexsort((scan.rings, scan.time_offsets))], expected.transpose(1, 0, 2)[returns.T], atol=1e-9
        )
        rows, columns = np.nonzero(returns.T)[::-1]
        np.testing.assert_array_equal(scan.rings, rows)
        np.testing.assert_array_equal(scan.intensities, rows + number)
        since = columns * PERIOD_NS // sensor.w
        np.testing.assert_allclose(scan.time_offsets, since / 1e9, atol=1e-9)


def test_points_times_rings_and_intensities(recorded, sensor, frames):
    recording = open_recording(recorded)
    assert len(recording) == COUNT
    assert_equal(list(recording.scans()), sensor, frames)
    assert [scan.stamp for scan in recording.scans(1, 4, 2)] == [scan.stamp for scan in recording.scans()][1::2]
    assert list(recording.scans(COUNT)) == []


def test_info(recorded):
    info = open_recording(recorded).describe()
    assert (info.reader, info.scans, info.last_stamp) == ("packets", COUNT, (FIRST_NS + 3 * PERIOD_NS) / 1e9)
    assert "range" in [field.name for field in info.fields]
    assert "timestamp in ns, relative; +0.1 to +99.8 ms" in describe_source(recorded, ReaderConfig())
    untimed = open_recording(recorded, ReaderConfig(time_reference="none"))
    assert next(untimed.scans()).time_offsets is None


def assert_imu(imu):
    np.testing.assert_allclose(imu.stamps, (FIRST_NS + 20 + PERIOD_NS * np.arange(COUNT)) / 1e9, atol=1e-6)
    np.testing.assert_allclose(imu.accelerations, np.tile([0.0, 4.903325, 9.80665], (COUNT, 1)), rtol=1e-6)
    rates_deg = [[90.0 - number, 0.0, number - 180.0] for number in range(COUNT)]
    np.testing.assert_allclose(np.rad2deg(imu.angular_velocities), rates_deg, rtol=1e-6)
    assert np.abs(imu.T_lidar_imu[:3, 3]).max() == pytest.approx(0.011775)  # metres


def test_imu_of_a_capture(recorded):
    imu = open_recording(recorded).imu
    if recorded.suffix == ".osf":
        assert imu is None  # frames alone were written
    else:
        assert_imu(imu)


def test_damaged_files(recorded):
    whole = recorded.read_bytes()
    for content in (b"", b"nonsense" * 500):
        recorded.write_bytes(content)
        with pytest.raises(InputError, match=r"cannot be read by ouster-sdk .* copy it again"):
            open_recording(recorded).describe()
    recorded.write_bytes(whole[: len(whole) // 2])
    try:
        assert len(list(open_recording(recorded).scans())) < COUNT
    except InputError as error:
        assert "ouster-sdk" in str(error)  # noqa: PT017


def test_metadata_of_another_recording_is_not_taken(tmp_path, sensor):
    (tmp_path / "office.json").write_text(sensor.to_json_string())
    (tmp_path / "street.pcap").write_bytes(b"")
    assert find_metadata(tmp_path / "street.pcap") == tmp_path / "office.json"  # the only recording there
    (tmp_path / "office.pcap").write_bytes(b"")
    assert find_metadata(tmp_path / "street.pcap") is None
    assert find_metadata(tmp_path / "office.pcap") == tmp_path / "office.json"


def test_a_capture_without_metadata_asks_for_it(tmp_path, packets):
    pytest.importorskip("velodyne_decoder")
    pcap = pytest.importorskip("ouster.sdk.pcap", exc_type=ImportError)
    pcap.record(packets[:70], str(tmp_path / "drive.pcap"))
    with pytest.raises(InputError, match=r"put the sensor's metadata beside it as drive\.json"):
        open_recording(tmp_path / "drive.pcap").describe()


@pytest.fixture
def bag(bag_kit, sensor, packets):
    from rosbags.typesys import get_types_from_msg

    bag_kit.store.register(get_types_from_msg("uint8[] buf\n", "ouster_ros/msg/PacketMsg"))

    def write(with_metadata=True, extra=0):
        topics = {"/ouster/lidar_packets": [], "/ouster/imu_packets": []}
        for packet in packets:
            kind = "lidar" if isinstance(packet, core.LidarPacket) else "imu"
            content = np.append(np.asarray(packet.buf, np.uint8), np.zeros(extra, np.uint8))
            message = bag_kit.new("ouster_ros/PacketMsg", buf=content)
            topics[f"/ouster/{kind}_packets"].append((packet.host_timestamp, message))
        if with_metadata:
            text = bag_kit.new("std_msgs/String", data=sensor.to_json_string())
            topics["/ouster/metadata"] = [(FIRST_NS - 1, text)]
        return bag_kit.write(topics)

    return write


@pytest.mark.parametrize("extra", [0, 1])  # early drivers recorded a byte more
def test_packets_in_a_bag(bag, sensor, frames, extra):
    recording = open_recording(bag(extra=extra))
    assert len(recording) == COUNT
    assert_equal(list(recording.scans()), sensor, frames)
    assert_imu(recording.imu)
    info = recording.describe()
    assert info.topic == "/ouster/lidar_packets"
    assert [topic.name for topic in info.topics] == ["/ouster/imu_packets", "/ouster/lidar_packets", "/ouster/metadata"]
    assert recording.name == "drive"


def test_metadata_beside_a_bag(bag, sensor, frames):
    path = bag(with_metadata=False)
    with pytest.raises(InputError, match=r"put it beside the bag as drive\.json"):
        open_recording(path).describe()
    (path.parent / "drive.json").write_text(sensor.to_json_string())
    assert_equal(list(open_recording(path).scans()), sensor, frames)
