"""Bags without an index, cut short or damaged in the middle: what there is is read, and the rest is told."""

import shutil
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer

from lidarslam.core.errors import InputError
from lidarslam.datasets.bag_file import BagFile
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.registry import open_recording

STAMP_NS = 1_700_000_000_250_000_000
PERIOD_NS = 100_000_000


@pytest.fixture
def write_drive(make_bag_kit, make_sweep):
    """Write a bag of velodyne scans of 2 000 points; gives the storage file, the folder or file, and the points."""

    def write(kind, count=6, **options):
        kit = make_bag_kit(kind)
        sweeps = [make_sweep("velodyne", STAMP_NS + i * PERIOD_NS, height=16, width=125) for i in range(count)]
        clouds = [
            (STAMP_NS + i * PERIOD_NS, kit.cloud(sweep.records, STAMP_NS + i * PERIOD_NS))
            for i, sweep in enumerate(sweeps)
        ]
        path = kit.write({"/points": clouds, "/imu": "sensor_msgs/msg/Imu"}, **options)
        return kit.storage_file(path), path, [sweep.points for sweep in sweeps]

    return write


def assert_first_scans(recording, points, count):
    faults = Faults()
    scans = list(recording.scans(faults=faults))
    assert len(scans) == len(recording) == count
    assert faults.warnings() == ()
    for i, (scan, expected) in enumerate(zip(scans, points, strict=False)):
        assert scan.stamp == (STAMP_NS + i * PERIOD_NS) / 10**9
        np.testing.assert_array_equal(scan.points, expected)


@pytest.mark.parametrize("part", [0.3, 0.6, 0.9])
@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_bag_that_was_cut_short_is_read_up_to_there(write_drive, kind, part):
    file, _, points = write_drive(kind)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(part * len(whole))])
    recording = open_recording(file)
    # The writers put all into one chunk; what a chunk without compression holds can be read up to its end.
    assert_first_scans(recording, points, int(6 * part - 0.05))
    (warning,) = recording.warnings
    assert f"{file}: has no index that can be read, so its {len(recording)} messages" in warning
    assert "breaks off at byte" in warning
    assert "\n" not in warning
    assert warning in recording.describe().notes


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_bag_of_which_only_the_end_is_missing_is_read_whole(write_drive, kind):
    file, _, points = write_drive(kind)
    file.write_bytes(file.read_bytes()[:-9])
    assert_first_scans(open_recording(file), points, 6)


def test_a_bag_that_was_never_indexed_is_read_whole(write_drive):
    file, _, points = write_drive("bag")
    data = bytearray(file.read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    data[place : place + 8] = bytes(8)
    active = file.with_name("drive.bag.active")
    active.write_bytes(data)
    for path in (active, file):
        path.write_bytes(data)
        recording = open_recording(path)
        assert_first_scans(recording, points, 6)
        assert f"rosbag reindex {path}" in recording.warnings[0]


@pytest.mark.parametrize("compression", [Rosbag1Writer.CompressionFormat.BZ2, Rosbag1Writer.CompressionFormat.LZ4])
def test_compressed_chunks_without_an_index(write_drive, compression):
    file, _, points = write_drive("bag", compression=(compression,))
    data = bytearray(file.read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    data[place : place + 8] = bytes(8)
    file.write_bytes(data)
    assert_first_scans(open_recording(file), points, 6)


def test_a_cut_database_is_read_as_far_as_its_pages_go(write_drive):
    file, _, points = write_drive("db3", count=40)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(0.9 * len(whole))])
    recording = open_recording(file)
    assert 7 <= len(recording) < 40
    assert_first_scans(recording, points, len(recording))
    assert "breaks off" in recording.warnings[0]


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
def test_a_bag_of_which_nothing_is_left_says_how_to_mend_it(write_drive, kind):
    file, _, _ = write_drive(kind)
    for size in (0, 5, 60):
        file.write_bytes(file.read_bytes()[:size])
        with pytest.raises(InputError, match=r"try `|copy the bag again") as caught:
            open_recording(file)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, b"", b"]]: : [\n", bytes(range(256)), b"rosbag2_bagfile_information: 5\n"])
@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_folder_without_usable_metadata_is_its_file(write_drive, kind, content):
    file, folder, points = write_drive(kind)
    (folder / "metadata.yaml").unlink()
    if content is not None:
        (folder / "metadata.yaml").write_bytes(content)
    recording = open_recording(folder)
    assert_first_scans(recording, points, 6)
    assert "metadata.yaml is missing or damaged, so drive" in recording.warnings[0]
    # Of several files only the metadata knows the order.
    shutil.copy(file, folder / f"another.{kind}")
    with pytest.raises(InputError, match=r"ros2 bag reindex.*or give one of its"):
        open_recording(folder)


def test_metadata_that_names_a_file_outside_reads_none_there(write_drive):
    file, folder, _ = write_drive("db3")
    file.rename(folder.parent / "elsewhere.db3")
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(file.name, "../elsewhere.db3"))
    with pytest.raises(InputError, match=r"missing.*ros2 bag reindex"):
        open_recording(folder)


def test_a_damaged_chunk_costs_no_other(write_drive):
    file, _, _ = write_drive("mcap", count=2)
    data = file.read_bytes()
    header, chunk = _mcap_chunk(data)
    broken = chunk[:49] + b"\xff" * 9 + chunk[58:]  # the length of its first record
    file.write_bytes(header + chunk + broken + chunk[:-100])
    bag = BagFile(file)
    (topic,) = (topic for topic in bag.topics if topic.messages)
    assert topic.messages == 3  # two of the first chunk, and one of the last, which breaks off
    assert "a chunk in it is damaged" in bag.damage
    assert len(list(bag.messages(topic))) == 3


def _mcap_chunk(data):
    """An MCAP file up to its first chunk, and that chunk."""
    at = 8
    while data[at] != 0x06:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return data[:at], data[at : at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")]


def test_a_record_that_claims_to_be_endless_is_not_read(write_drive):
    file, _, points = write_drive("mcap")
    header, chunk = _mcap_chunk(file.read_bytes())
    file.write_bytes(header + chunk + b"\x05" + (10**12).to_bytes(8, "little") + bytes(5000))
    recording = open_recording(file)
    assert_first_scans(recording, points, 6)
    assert "a record of 1,000,000,000,000 bytes" in recording.warnings[0]


def test_a_database_whose_rows_are_no_messages(write_drive):
    file, _, _ = write_drive("db3")
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("UPDATE messages SET data = 'text' WHERE id = 4")
    with pytest.raises(InputError, match=r"drive\.db3"):
        list(open_recording(file).scans(faults=Faults()))
