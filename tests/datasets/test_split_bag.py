"""Bags in one folder, the parts of one recording or not."""

import shutil

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.datasets.registry import choose_reader, open_recording

from .conftest import STAMP_NS, stamps_ns


@pytest.fixture
def topics(bag_kit, velodyne_clouds):
    """Twelve scans, and an IMU that stops after them."""
    imu = [(ns, bag_kit.imu(ns, "lidar", np.full(3, ns % 7), np.full(3, 9.0))) for ns in stamps_ns(15)]
    return {"/points": velodyne_clouds(bag_kit, 12), "/imu": imu}


def write_part(kit, topics, name):
    file = kit.storage_file(kit.write(topics, name=name))
    (kit.folder / "parts").mkdir(exist_ok=True)
    return file.rename(kit.folder / "parts" / file.name)


def scan_by_scan(topics):
    """By name the part 10 comes before 2; the last parts have no scan."""
    return [{topic: messages[i : i + 1] for topic, messages in topics.items() if messages[i:]} for i in range(15)]


def by_topic(topics):
    """With two scans at a seam out of order."""
    points, imu = topics.values()
    return [{"/imu": imu}, {"/points": [*points[:6], points[7]]}, {"/points": [points[6], *points[8:]]}]


@pytest.mark.parametrize("divided", [scan_by_scan, by_topic])
def test_the_parts_of_a_recording_are_the_recording(bag_kit, topics, divided):
    whole = open_recording(bag_kit.write(topics))
    files = [write_part(bag_kit, part, f"x_{number}") for number, part in enumerate(divided(topics))]
    parts = open_recording(files[0].parent)
    for chosen in ((), (3, 11, 4)):
        for scan, expected in zip(parts.scans(*chosen), whole.scans(*chosen), strict=True):
            assert scan.stamp == expected.stamp
            np.testing.assert_array_equal(scan.points, expected.points)
    np.testing.assert_array_equal(parts.imu.angular_velocities, whole.imu.angular_velocities)
    info, expected = parts.describe(), whole.describe()
    assert (info.scans, info.topics, info.duration_s) == (12, expected.topics, expected.duration_s)


def test_a_damaged_part_costs_no_other(bag_kit, topics):
    files = [write_part(bag_kit, part, f"x_{number}") for number, part in enumerate(scan_by_scan(topics)[:9])]
    files[2].write_bytes(b"")
    files[5].write_bytes(files[5].read_bytes()[: files[5].stat().st_size // 2])
    recording = open_recording(files[0].parent)
    assert len(list(recording.scans())) == len(recording) == 7
    assert [file for file in files if str(file) in " ".join(recording.warnings)] == [files[2], files[5]]


@pytest.mark.parametrize("other", ["copy", "another drive", "another ROS"])
def test_bags_of_several_recordings_are_refused_by_their_names(bag_kit, make_bag_kit, topics, other):
    first = write_part(bag_kit, topics, "x_0")
    kit = make_bag_kit("mcap" if bag_kit.kind == "bag" else "bag") if other == "another ROS" else bag_kit
    second = write_part(kit, {"/header": [(STAMP_NS + 10**12, kit.header(STAMP_NS))]}, "y_0")
    if other == "copy":
        shutil.copy(first, second)
    with pytest.raises(InputError) as caught:
        open_recording(first.parent)
    assert all(file.name in str(caught.value) for file in (first, second))


def test_bags_beside_more_scans_are_not_read(tmp_path):
    for name in ("0.bag", "1.bag.active", "2.pcd", "map.ply"):
        (tmp_path / name).touch()
    assert choose_reader(tmp_path) == "rosbag"
    (tmp_path / "3.pcd").touch()
    assert choose_reader(tmp_path) == "scan-folder"
