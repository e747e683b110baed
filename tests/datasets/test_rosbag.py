"""Real bags of every kind, written by a driver's layout and read back."""

import logging
from fractions import Fraction

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.info_text import describe_source
from lidarslam.datasets.point_table import PointField
from lidarslam.datasets.recording import Topic, find_truth_file
from lidarslam.datasets.registry import open_recording
from lidarslam.datasets.ros.bag_file import BagFile
from lidarslam.datasets.times.point_time import PointTimeModel

from .conftest import COMPRESSIONS, LATENCY_NS, PERIOD_NS, STAMP_NS, execute, point_table, stamps_ns


@pytest.fixture
def sweep(make_sweep):
    return make_sweep("velodyne", STAMP_NS)


@pytest.fixture
def drive(bag_kit, make_sweep):
    """A bag of six velodyne scans beside an IMU's empty topic, and what is in it."""
    sweeps = [make_sweep("velodyne", stamp_ns, holes=True) for stamp_ns in stamps_ns(6)]
    return bag_kit.write({"/points": recorded(bag_kit, sweeps), "/imu": "sensor_msgs/msg/Imu"}), sweeps


def recorded(kit, sweeps, first_ns=STAMP_NS):
    clouds = [kit.cloud(sweep.records, first_ns + i * PERIOD_NS) for i, sweep in enumerate(sweeps)]
    return [(first_ns + i * PERIOD_NS + LATENCY_NS, cloud) for i, cloud in enumerate(clouds)]


def assert_scan(scan, sweep, stamp_ns):
    assert scan.stamp == stamp_ns / 10**9
    assert scan.dropped == np.count_nonzero(~sweep.returns)
    np.testing.assert_array_equal(scan.points, sweep.points[sweep.returns])
    np.testing.assert_array_equal(scan.rings, sweep.rings[sweep.returns])
    np.testing.assert_allclose(scan.time_offsets, sweep.offsets[sweep.returns], rtol=0.0, atol=1e-9)


def test_every_driver_in_every_kind_of_bag(bag_kit, driver, make_sweep):
    first_ns = STAMP_NS + 123_456_789  # a stamp that float64 has to round
    sweeps = [make_sweep(driver, first_ns + i * PERIOD_NS, holes=True) for i in range(3)]
    path = bag_kit.write({"/points": recorded(bag_kit, sweeps, first_ns)})
    recording = open_recording(path)
    assert (len(recording), recording.name, recording.T_cam_lidar) == (3, "drive", None)
    for i, (scan, sweep) in enumerate(zip(recording.scans(), sweeps, strict=True)):
        assert_scan(scan, sweep, first_ns + i * PERIOD_NS)


@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2"])
@pytest.mark.parametrize("clock_ns", [0, 2_000_000, -STAMP_NS, 55_000_000_000 - STAMP_NS])
def test_livox_custom_message(bag_kit, rng, package, clock_ns):
    points, lines = rng.uniform(1, 9, (200, 3)).astype("f4"), rng.integers(0, 6, 200)
    offset_ns = np.r_[0, np.sort(rng.integers(0, 10**8, 199))]
    messages = [
        (stamp_ns + LATENCY_NS, bag_kit.livox(points, offset_ns, lines, stamp_ns, stamp_ns + clock_ns, package))
        for stamp_ns in stamps_ns(3)
    ]
    recording = open_recording(bag_kit.write({"/livox/lidar": messages}))
    for scan, stamp_ns in zip(recording.scans(), stamps_ns(3), strict=True):
        assert scan.stamp == stamp_ns / 10**9
        np.testing.assert_array_equal(scan.points, points)
        np.testing.assert_array_equal(scan.rings, lines)
        assert set(scan.intensities) == {9.0}  # of `reflectivity`
        # A time base that is not the stamp's clock, or never set, leaves the first point at the stamp.
        base_s = float(Fraction(stamp_ns + clock_ns, 10**9) - Fraction(scan.stamp)) if abs(clock_ns) < 10**9 else 0.0
        np.testing.assert_allclose(scan.time_offsets, base_s + offset_ns / 1e9, rtol=0.0, atol=1e-9)
    info = recording.describe()
    assert (info.point_time.field, info.point_time.unit) == ("offset_time", "ns")
    assert any("another clock" in note for note in info.notes) == (abs(clock_ns) > 10**9)


def test_without_type_definitions(bag_kit, sweep):
    path = bag_kit.write({"/points": recorded(bag_kit, [sweep])}, definitions=False)
    if bag_kit.kind == "db3":  # as rosbag2 wrote it up to ROS 2 Humble
        for table in ("schema", "message_definitions"):
            execute(bag_kit.storage_file(path), f"DROP TABLE {table}")
    assert_scan(next(open_recording(path).scans()), sweep, STAMP_NS)


@pytest.mark.parametrize(
    ("kind", "compression"), [*COMPRESSIONS, ("db3", (CompressionMode.FILE, CompressionFormat.ZSTD))]
)
def test_compressed_bags(make_bag_kit, sweep, kind, compression):
    kit = make_bag_kit(kind)
    path = kit.write({"/points": recorded(kit, [sweep])}, compression=compression)
    assert_scan(next(open_recording(path).scans()), sweep, STAMP_NS)


def test_file_of_compressed_messages_asks_for_the_folder(make_bag_kit, velodyne_clouds):
    kit, compression = make_bag_kit("db3"), (CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    path = kit.write({"/points": velodyne_clouds(kit, 1)}, compression=compression)
    with pytest.raises(InputError, match=r"compressed, give the rosbag2 folder"):
        next(open_recording(kit.storage_file(path)).scans())


def test_skipped_messages_are_not_decoded(drive, monkeypatch):
    decoded, decode = [], BagFile.decode
    recording = open_recording(drive[0])
    next(recording.scans())  # the time field has been looked at
    spy = lambda bag, message, field=None: decoded.append(message.header_ns) or decode(bag, message, field)  # noqa: E731
    monkeypatch.setattr(BagFile, "decode", spy)
    assert len(list(recording.scans(1, None, 2))) == 3
    assert decoded == stamps_ns(6)[1::2]


def test_description(drive):
    path, sweeps = drive
    info = open_recording(path).describe()
    assert (info.reader, info.scans, info.first_stamp) == ("rosbag", 6, STAMP_NS / 10**9)
    assert info.duration_s == pytest.approx(0.5, abs=1e-6)
    assert info.rate_hz == pytest.approx(10.0, abs=1e-4)
    assert_scan(info.first, sweeps[0], STAMP_NS)
    assert info.point_time == PointTimeModel("time", "s", "relative")
    topics = (Topic("/imu", "sensor_msgs/msg/Imu", 0), Topic("/points", "sensor_msgs/msg/PointCloud2", 6))
    assert (info.topic, info.topics) == ("/points", topics)
    assert info.fields[4:] == (PointField("ring", "uint16"), PointField("time", "float32"))
    assert (info.ground_truth, info.notes) == (None, ())


def test_a_cloud_topic_that_ends_early_has_its_own_duration(ros2_kit, velodyne_clouds):
    late = (STAMP_NS + 500 * 10**9, ros2_kit.header(STAMP_NS))
    path = ros2_kit.write({"/points": velodyne_clouds(ros2_kit, 4), "/late": [late]})
    assert open_recording(path).describe().duration_s == pytest.approx(0.3, abs=1e-6)


def test_several_cloud_topics_are_listed(ros2_kit, velodyne_clouds):
    clouds = velodyne_clouds(ros2_kit, 2)
    path = ros2_kit.write({"/front": clouds, "/rear": clouds[:1], "/empty": "sensor_msgs/msg/PointCloud2"})
    with pytest.raises(InputError) as caught:
        open_recording(path)
    for told in ("--topic", "/front (sensor_msgs/msg/PointCloud2, 2 messages)", "/rear (sensor_msgs/msg/"):
        assert told in str(caught.value)
    assert "/empty" not in str(caught.value)


def test_a_topic_with_few_messages_beside_many_is_left_out(ros2_kit, velodyne_clouds):
    clouds = velodyne_clouds(ros2_kit, 20)
    path = ros2_kit.write({"/points": clouds, "/map_points": clouds[-1:]})
    told = "/points is read; /map_points (1) with few messages left out: choose with --topic."
    recording = open_recording(path)
    assert (len(recording), recording.describe().topic) == (20, "/points")
    assert told in recording.warnings
    assert told in describe_source(path, ReaderConfig())
    asked = open_recording(path, ReaderConfig(topic="/map_points"))
    assert (len(asked), asked.warnings) == (1, ())


@pytest.mark.parametrize("topic", ["/rear", "rear"])
def test_topic_that_is_asked_for(ros2_kit, velodyne_clouds, make_sweep, topic):
    rear = make_sweep("ouster", STAMP_NS)
    path = ros2_kit.write({"/front": velodyne_clouds(ros2_kit, 2), "/rear": recorded(ros2_kit, [rear])})
    recording = open_recording(path, ReaderConfig(topic=topic))
    (scan,) = recording.scans()
    assert_scan(scan, rear, STAMP_NS)
    assert recording.describe().topic == "/rear"


@pytest.mark.parametrize(("topic", "message"), [
    ("/nowhere", "no topic '/nowhere'"), ("/imu", r"/imu \(sensor_msgs/msg/Imu, 0 messages\), which is no point cloud"),
])  # fmt: skip
def test_topic_that_is_not_there(drive, topic, message):
    with pytest.raises(InputError, match=message) as caught:
        open_recording(drive[0], ReaderConfig(topic=topic))
    assert "/points (sensor_msgs/msg/PointCloud2, 6 messages)" in str(caught.value)


@pytest.mark.parametrize(
    ("topics", "said"),
    [((), "the bag is empty"), (("/header",), r"no point cloud topic.*/header \(std_msgs/msg/Header, 1 messages")],
)
def test_bag_without_clouds(bag_kit, topics, said):
    path = bag_kit.write({topic: [(STAMP_NS, bag_kit.header(STAMP_NS))] for topic in topics})
    with pytest.raises(InputError, match=said):
        open_recording(path)


def test_clouds_of_ros1_in_a_bag_of_ros2(ros2_kit):
    def add_clouds(writer):
        connection = writer.add_connection("/points", "sensor_msgs/PointCloud2", msgdef="uint8 a", rihs01="0")
        writer.write(connection, STAMP_NS, b"\0\1\0\0\0")

    with pytest.raises(InputError, match=r"those of ROS 1.*give the one it was converted from"):
        open_recording(ros2_kit.write({"/imu": "sensor_msgs/msg/Imu"}, extra=add_clouds))


def test_stamps_that_do_not_increase_are_skipped_and_counted(ros2_kit, sweep):
    in_order = stamps_ns(5)
    headers_ns = [in_order[step] for step in (0, 1, 1, 3, 2, 4)]
    clouds = [(ns, ros2_kit.cloud(sweep.records, of)) for ns, of in zip(stamps_ns(6), headers_ns, strict=True)]
    recording, faults = open_recording(ros2_kit.write({"/points": clouds})), Faults()
    assert len(recording) == 6
    kept = [scan.stamp for scan in recording.scans(faults=faults)]
    assert kept == [in_order[step] / 10**9 for step in (0, 1, 3, 4)]
    assert faults.warnings()[0].startswith("2 scans were left out: their stamps are not after")
    # Indices are those of the messages; only those asked for count, so that what follows a clock set back can be run.
    faults = Faults()
    kept = [scan.stamp for scan in recording.scans(4, faults=faults)]
    assert kept == [in_order[step] / 10**9 for step in (2, 4)]
    assert faults.left_out == 0


@pytest.mark.parametrize("reference", ["relative", "absolute"])
def test_simulated_time_from_zero(ros2_kit, reference):
    # In the first scan times from 0 to 0.1 s mean the same either way; a later one tells.
    seconds = np.linspace(0.0, 0.1, 64)
    clouds = []
    for i in range(25):
        records = point_table(np.ones((64, 3)), timestamp=seconds + (i / 10 if reference == "absolute" else 0.0))
        clouds.append((i * PERIOD_NS + 10, ros2_kit.cloud(records[None], i * PERIOD_NS)))
    recording = open_recording(ros2_kit.write({"/points": clouds}))
    scans = list(recording.scans())
    assert [scan.stamp for scan in scans] == [i / 10 for i in range(25)]
    for scan in scans:
        np.testing.assert_allclose(scan.time_offsets, seconds, rtol=0.0, atol=1e-9)
    assert recording.describe().point_time.reference == reference


def test_truth_files_by_name(tmp_path):
    inner = tmp_path / "drive"
    inner.mkdir()
    assert find_truth_file([inner, tmp_path], "drive") is None
    for path in (tmp_path / "groundtruth.txt", tmp_path / "ground_truth.tum", inner / "groundtruth.tum"):
        path.touch()
        assert find_truth_file([inner, tmp_path], "drive") == path
    (tmp_path / "drive.tum").touch()
    assert find_truth_file([inner, tmp_path], "drive") == tmp_path / "drive.tum"
    assert find_truth_file([inner, tmp_path]) == inner / "groundtruth.tum"


def test_index_that_promises_more_messages(make_bag_kit, velodyne_clouds, caplog):
    kit = make_bag_kit("db3")
    path = kit.write({"/points": velodyne_clouds(kit, 3)})
    recording = open_recording(path)
    execute(kit.storage_file(path), "DELETE FROM messages WHERE id = 3")
    with caplog.at_level(logging.WARNING):
        assert len(list(recording.scans(0, 2))) == 2
        assert not caplog.records
        assert len(list(recording.scans())) == 2
    assert "lists 3 scans, it holds 2" in caplog.text
    list(recording.scans(1, 3, 1, faults := Faults()))
    assert (faults.left_out, faults.unreadable_scans) == (1, 1)  # of those asked for
    list(recording.scans(0, 3, 5, faults := Faults()))
    assert not faults.warnings()
    execute(kit.storage_file(path), "DELETE FROM messages")
    with pytest.raises(InputError, match="lists 3 messages of /points, it holds none"):
        list(recording.scans())


def test_two_sensors_that_send_to_one_topic_in_turn_are_told_apart(ros2_kit, velodyne_clouds):
    messages = velodyne_clouds(ros2_kit, 8)
    for i, (_, cloud) in enumerate(messages):
        cloud.header.frame_id = "rear" if i % 2 else "front"
    path = ros2_kit.write({"/points": messages})

    def stamps(faults, **options):
        return [scan.stamp for scan in open_recording(path, ReaderConfig(**options)).scans(faults=faults)]

    faults = Faults()
    assert stamps(faults) == [ns / 10**9 for ns in stamps_ns(8)[::2]]
    assert faults.warnings() == (
        "4 scans were left out: they come from another sensor than 'front'; for that one set reader.frame_id;"
        " the first: 'rear'",
    )
    assert stamps(Faults(), frame_id="rear") == [ns / 10**9 for ns in stamps_ns(8)[1::2]]
    with pytest.raises(InputError, match=r"reader\.frame_id is 'left', but /points begins with 'front', 'rear'"):
        stamps(Faults(), frame_id="left")


def test_a_sensor_that_begins_later_can_be_named(ros2_kit, velodyne_clouds):
    messages = velodyne_clouds(ros2_kit, 24)
    for i, (_, cloud) in enumerate(messages):
        cloud.header.frame_id = "rear" if i > 20 else "front"
    recording = open_recording(ros2_kit.write({"/points": messages}), ReaderConfig(frame_id="rear"))
    assert len(list(recording.scans(faults=Faults()))) == 3


@pytest.mark.parametrize(("changes", "reason"), [
    ({"point_step": 4}, "beyond the 4 bytes"), ({"point_step": 0}, "beyond the 0 bytes"),
    ({"width": 10**6}, "needs 88000000 bytes"),
    ({"width": 2**32 - 1, "height": 2**32 - 1}, "bytes, the message holds 4400"),
    ({"height": 2, "row_step": 2**32 - 1}, "bytes, the message holds 4400"),
    ({"data": np.zeros(9, np.uint8)}, "the message holds 9"), ({"fields": []}, "need the fields x, y and z"),
])  # fmt: skip
def test_a_damaged_message_costs_no_other(ros2_kit, velodyne_clouds, sweep, changes, reason):
    messages = velodyne_clouds(ros2_kit, 5)
    for place in (0, 3):
        messages[place] = (messages[place][0], ros2_kit.cloud(sweep.records, stamps_ns(5)[place], **changes))
    recording, faults = open_recording(ros2_kit.write({"/points": messages})), Faults()
    scans = list(recording.scans(faults=faults))
    assert [scan.stamp for scan in scans] == [stamps_ns(5)[i] / 10**9 for i in (1, 2, 4)]
    assert all(scan.time_offsets is not None for scan in scans)
    (warning,) = faults.warnings()
    assert warning.startswith("2 scans were left out: not readable")
    assert reason in warning
    assert any("not readable" in note for note in recording.describe().notes)
    with pytest.raises(InputError, match=r"message holds|bytes of a point|x, y and z"):
        list(recording.scans())


@pytest.mark.parametrize("header_ns", [0, STAMP_NS])
def test_stamps_that_are_all_alike_give_way_to_the_times_of_recording(ros2_kit, sweep, header_ns):
    clouds = [(ns, ros2_kit.cloud(sweep.records, header_ns)) for ns in stamps_ns(5)]
    recording = open_recording(ros2_kit.write({"/points": clouds}))
    assert [scan.stamp for scan in recording.scans()] == [ns / 10**9 for ns in stamps_ns(5)]
    assert recording.warnings == ("The message headers have no stamps, so the times of recording are used.",)


@pytest.mark.parametrize("spoil", [np.nan, -1e30, 1e5])
def test_a_scan_whose_times_are_worth_nothing_keeps_its_points(ros2_kit, make_sweep, spoil):
    sweeps = [make_sweep("velodyne", ns) for ns in stamps_ns(4)]
    sweeps[2].records["time"] *= spoil
    recording, faults = open_recording(ros2_kit.write({"/points": recorded(ros2_kit, sweeps)})), Faults()
    scans = list(recording.scans(faults=faults))
    assert [scan.time_offsets is None for scan in scans] == [False, False, True, False]
    assert [len(scan) for scan in scans] == [200] * 4
    assert faults.warnings()[0].startswith("1 scan has no usable times of points")
