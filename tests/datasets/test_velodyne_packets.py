"""Packets of a VLP-16, written here as its manual lays them out, of a simulated room."""

import struct
from functools import cache

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.registry import open_recording

from .conftest import write_pcap

pytest.importorskip("velodyne_decoder", reason="needs the extra velodyne")

STAMP_S = 1_700_000_123.25
SEQUENCE_S, LASER_S = 55.296e-6, 2.304e-6  # of one firing of all 16 lasers, and from laser to laser
TURNS_PER_S = 10.0
# The elevation of a laser by its number, in the order of firing.
ELEVATIONS_DEG = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], dtype=np.float64)
# How far above the middle of the sensor each laser's beam begins.
HEIGHTS_M = 1e-3 * np.array([11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2])
HALF_ROOM = np.array([7.0, 5.0, 3.0])


def measured(seconds, lasers):
    """Ranges (N,) and points (N, 3) at these times; the sensor turns clockwise from forward."""
    azimuth = 360.0 * TURNS_PER_S * seconds % 360.0
    angle, elevation = np.radians(azimuth), np.radians(ELEVATIONS_DEG[lasers])
    level = np.cos(elevation)
    rays = np.column_stack([level * np.cos(angle), -level * np.sin(angle), np.sin(elevation)])
    begins = np.column_stack([np.zeros((len(rays), 2)), HEIGHTS_M[lasers]])
    ranges = ((np.sign(rays) * HALF_ROOM - begins) / np.where(rays == 0.0, 1e-9, rays)).min(axis=1)
    return ranges, ranges[:, np.newaxis] * rays + begins


def packet(first_s):
    """The 1206 bytes of one data packet, and the time, laser and points of its firings."""
    block, channel = np.divmod(np.arange(12 * 32), 32)
    sequence, laser = np.divmod(channel, 16)
    since = (2 * block + sequence) * SEQUENCE_S + laser * LASER_S
    ranges, points = measured(first_s + since, laser)
    data = b""
    for number in range(12):
        azimuth = 360.0 * TURNS_PER_S * (first_s + 2 * number * SEQUENCE_S) % 360.0
        data += struct.pack("<HH", 0xEEFF, round(100.0 * azimuth) % 36000)
        for index in range(32 * number, 32 * number + 32):
            data += struct.pack("<HB", round(ranges[index] / 0.002), 10 + laser[index])
    data += struct.pack("<IBB", round(1e6 * (123.25 + first_s)), 0x37, 0x22)  # past the hour; strongest return; VLP-16
    assert len(data) == 1206
    return data, first_s + since, laser, points


@cache
def packets(duration_s):
    """Of a recording that begins at azimuth zero."""
    return [packet(first_s) for first_s in np.arange(0.0, duration_s, 24 * SEQUENCE_S)]


@pytest.fixture
def capture(tmp_path):
    sent = packets(0.35)
    stamps = [STAMP_S + times[0] for _, times, _, _ in sent]
    return write_pcap(tmp_path / "drive.pcap", [data for data, *_ in sent], stamps), sent


def assert_as_measured(scan, sent):
    """Every point, by its time and laser, is one that was sent, on the grid of 2 mm; times within microseconds."""
    assert len(scan) > 0
    order = np.argsort(ELEVATIONS_DEG)
    rings = np.empty(16, int)
    rings[order] = np.arange(16)
    times, lasers, points = (np.concatenate([part[field] for part in sent]) for field in (1, 2, 3))
    since = scan.stamp - STAMP_S + scan.time_offsets
    near = np.empty_like(scan.points)
    for ring in range(16):
        mine, theirs = scan.rings == ring, rings[lasers] == ring
        known = times[theirs]  # increase
        nearest = np.searchsorted(0.5 * (known[1:] + known[:-1]), since[mine])
        np.testing.assert_allclose(known[nearest], since[mine], atol=3e-6)
        near[mine] = points[theirs][nearest]
    begins = np.column_stack([np.zeros((len(scan), 2)), HEIGHTS_M[order[scan.rings]]])
    ranges, expected = (np.linalg.norm(points - begins, axis=1) for points in (scan.points, near))
    np.testing.assert_allclose(ranges, expected, atol=0.00101)  # the range is on a grid of 2 mm
    # The azimuth is on one of 0.01 degrees, and interpolated within a block.
    assert np.linalg.norm(scan.points - near, axis=1).max() < 0.00101 + np.radians(0.02) * expected.max()
    np.testing.assert_array_equal(scan.intensities, 10 + order[scan.rings])


def test_points_times_rings_and_intensities_of_a_capture(capture):
    path, sent = capture
    recording = open_recording(path)
    scans = list(recording.scans())
    assert len(scans) == len(recording) == 4
    assert scans[0].stamp == pytest.approx(STAMP_S, abs=1e-6)
    assert scans[1].time_offsets.max() == pytest.approx(0.1, abs=0.002)
    for scan in scans:
        assert_as_measured(scan, sent)
    assert 384 * len(sent) - sum(len(scan) for scan in scans) in (0, 1)  # the library may drop one at azimuth zero
    assert [scan.stamp for scan in recording.scans(1, None, 2)] == [scan.stamp for scan in scans][1::2]
    untimed = open_recording(path, ReaderConfig(time_reference="none"))
    assert next(untimed.scans()).time_offsets is None
    assert untimed.describe().point_time is None


def scan_message(kit, sent, stamp_ns):
    found = []
    for data, times, _, _ in sent:
        ns = round(1e9 * times[0]) + round(STAMP_S * 1e9)
        stamp = kit.new("builtin_interfaces/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        found.append(kit.new("velodyne_msgs/VelodynePacket", stamp=stamp, data=np.frombuffer(data, np.uint8)))
    return kit.new("velodyne_msgs/VelodyneScan", header=kit.header(stamp_ns), packets=found)


@pytest.fixture
def velodyne_kit(bag_kit):
    time = "builtin_interfaces/Time" if bag_kit.ros2 else "time"
    packet_text, scan_text = f"{time} stamp\nuint8[1206] data\n", "std_msgs/Header header\nVelodynePacket[] packets\n"
    bag_kit.store.register(get_types_from_msg(packet_text, "velodyne_msgs/msg/VelodynePacket"))
    bag_kit.store.register(get_types_from_msg(scan_text, "velodyne_msgs/msg/VelodyneScan"))
    return bag_kit


def test_a_bag_with_the_same_packets(velodyne_kit):
    sent = packets(0.3)
    messages = []
    for part in (sent[:76], sent[76:152], sent[152:]):
        stamp_ns = round(1e9 * (STAMP_S + part[-1][1][0]))  # the driver stamps a scan at its last packet
        messages.append((stamp_ns, scan_message(velodyne_kit, part, stamp_ns)))
    path = velodyne_kit.write({"/velodyne_packets": messages, "/imu": "sensor_msgs/msg/Imu"})
    recording = open_recording(path)
    info = recording.describe()
    assert info.topic == "/velodyne_packets"
    assert (info.point_time.unit, info.point_time.reference) == ("ns", "absolute")
    assert [field.name for field in info.fields][:5] == ["x", "y", "z", "intensity", "time"]
    scans = list(recording.scans())
    assert len(scans) == 3
    for scan, (stamp_ns, _) in zip(scans, messages, strict=True):
        assert scan.stamp == stamp_ns / 1e9
        assert_as_measured(scan, sent)


def test_clouds_come_before_packets(velodyne_kit, make_sweep):
    part = packets(0.1)
    stamp_ns = round(1e9 * STAMP_S)
    cloud = velodyne_kit.cloud(make_sweep("velodyne", stamp_ns).records, stamp_ns)
    message = scan_message(velodyne_kit, part, stamp_ns)
    path = velodyne_kit.write({"/packets": [(stamp_ns, message)], "/points": [(stamp_ns, cloud)]})
    assert open_recording(path).describe().topic == "/points"
    assert open_recording(path, ReaderConfig(topic="/packets")).describe().topic == "/packets"


def test_an_empty_or_damaged_message_costs_no_other(velodyne_kit):
    sent = packets(0.2)
    half = len(sent) // 2
    stamps_ns = [round(1e9 * STAMP_S) + number * 10**8 for number in range(3)]
    nonsense = [(b"\x11" * 1206, *rest) for _, *rest in sent[:3]]
    parts = ([], nonsense, sent[half:])
    messages = [(ns, scan_message(velodyne_kit, part, ns)) for ns, part in zip(stamps_ns, parts, strict=True)]
    faults = Faults()
    scans = list(open_recording(velodyne_kit.write({"/packets": messages})).scans(faults=faults))
    assert [len(scan) > 0 for scan in scans] == [False, True]
    assert faults.left_out == 1
    assert "cannot be decoded" in faults.warnings()[0]


@pytest.mark.parametrize(("payload", "said"), [
    (bytes(100), "no packets of a Velodyne; for an Ouster, .* as other.json"), (b"\x11" * 1206, "cannot be decoded"),
])  # fmt: skip
def test_packets_of_others_are_refused(tmp_path, payload, said):
    path = write_pcap(tmp_path / "other.pcap", [payload] * 10, STAMP_S + 0.001 * np.arange(10))
    with pytest.raises(InputError, match=said):
        open_recording(path).describe()


def test_damaged_captures(capture, tmp_path):
    path, _ = capture
    whole = path.read_bytes()
    cut = tmp_path / "cut.pcap"
    cut.write_bytes(whole[: len(whole) // 2])
    assert len(list(open_recording(cut).scans())) == 2
    cut.write_bytes(whole[: 24 + 200 * (16 + 42 + 1206) + 7])  # within the head of a packet
    assert len(list(open_recording(cut).scans())) == 2
    for content, said in ((b"", "no capture that"), (b"nonsense" * 50, "editcap -F pcap"), (whole[:24], "no packets")):
        cut.write_bytes(content)
        with pytest.raises(InputError, match=said):
            open_recording(cut).describe()
