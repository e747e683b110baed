"""Bags without an index, cut short or damaged in the middle: what there is is read, and the rest is told."""

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2.storage_mcap import zstd

from lidarslam.core.errors import InputError
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.registry import open_recording
from lidarslam.datasets.ros.bag_file import BagFile, recover, unpacked_message

from .conftest import COMPRESSIONS, PERIOD_NS, STAMP_NS, execute


def stamp_ns(index):
    return STAMP_NS + index * PERIOD_NS


@pytest.fixture
def write_drive(make_bag_kit, make_sweep):
    """Write a bag of velodyne scans of 2 000 points; gives the storage file, the folder or file, and the points."""

    def write(kind, count=6, width=125, kit=None, order=None, recorded_ns=stamp_ns, first=0, **options):
        kit = kit or make_bag_kit(kind)
        numbers = range(first, first + count)
        sweeps = {i: make_sweep("velodyne", stamp_ns(i), height=16, width=width) for i in numbers}
        clouds = [(recorded_ns(i), kit.cloud(sweeps[i].records, stamp_ns(i))) for i in order or numbers]
        path = kit.write({"/points": clouds, "/imu": "sensor_msgs/msg/Imu"}, in_order=order is None, **options)
        return kit.storage_file(path), path, [sweep.points for sweep in sweeps.values()]

    return write


def assert_first_scans(recording, points, count):
    assert len(recording) == count
    assert_all_but(recording, points[:count], [])


def assert_all_but(recording, points, missing, *warnings):
    """See that all scans are read but some, and that this is what is said of them."""
    faults = Faults()
    scans = list(recording.scans(faults=faults))
    left = [i for i in range(len(points)) if i not in missing]
    assert [scan.stamp for scan in scans] == [stamp_ns(i) / 10**9 for i in left]
    for scan, i in zip(scans, left, strict=True):
        np.testing.assert_array_equal(scan.points, points[i])
    assert faults.left_out == len(missing)
    for said, expected in zip(faults.warnings(), warnings, strict=True):
        assert said.startswith(expected)
        assert "\n" not in said


@pytest.mark.parametrize("part", [0.3, 0.6, 0.9, 1.0])
@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_bag_that_was_cut_short_is_read_up_to_there(write_drive, kind, part):
    file, _, points = write_drive(kind)
    file.write_bytes(file.read_bytes()[: int(part * file.stat().st_size) - 9])
    recording = open_recording(file)
    # The writers put all into one chunk; what a chunk without compression holds can be read up to its end.
    assert_first_scans(recording, points, 6 if part == 1.0 else int(6 * part - 0.05))
    (warning,) = recording.warnings
    assert f"{file}: has no index that can be read, so its {len(recording)} messages" in warning
    assert part == 1.0 or "breaks off at byte" in warning
    assert "\n" not in warning
    assert warning in recording.describe().notes


@pytest.mark.parametrize("compression", [None, *Rosbag1Writer.CompressionFormat])
def test_a_bag_that_was_never_indexed_is_read_whole(write_drive, compression):
    file, _, points = write_drive("bag", compression=compression and (compression,))
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


def test_a_cut_database_is_read_as_far_as_its_pages_go(write_drive):
    file, _, points = write_drive("db3", count=40)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(0.9 * len(whole))])
    recording = open_recording(file)
    assert 7 <= len(recording) < 40
    assert_first_scans(recording, points, len(recording))
    assert "sqlite3 recovered.db3" in recording.warnings[0]


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
    (folder / f"._{file.name}").write_bytes(b"-")  # macOS keeps attributes there
    recording = open_recording(folder)
    assert_first_scans(recording, points, 6)
    assert "metadata.yaml" in recording.warnings[0]


def test_a_part_of_a_bag_says_that_there_are_others(write_drive):
    file, folder, _ = write_drive("mcap")
    (folder / "drive_1.mcap").write_bytes(b"-")
    assert "one of 2 parts" in open_recording(file).warnings[0]


def test_a_bag_without_index_is_read_up_to_a_damaged_chunk(write_drive):
    file, _, _ = write_drive("mcap", count=2)
    data, ((begin, size),) = file.read_bytes(), chunks_of(file)
    header, chunk = data[: begin - 49], data[begin - 49 : begin + size]
    broken = chunk[:49] + b"\xff" * 9 + chunk[58:]  # the length of its first record
    file.write_bytes(header + chunk + broken + chunk[:-100])
    bag = BagFile(file)
    (topic,) = (topic for topic in bag.topics if topic.messages)
    assert topic.messages == len(list(bag.messages(topic))) == 2
    assert "breaks off at byte" in bag.damage


@pytest.mark.parametrize("data", ["text", 100, 4 * 10**12, 0.5])
@pytest.mark.parametrize("indexed", [True, False])
def test_a_database_whose_rows_are_no_messages(write_drive, data, indexed):
    """A number must not become as many zero bytes."""
    file, _, points = write_drive("db3")
    execute(file, "UPDATE messages SET data = ? WHERE id = 4", data)
    if indexed:
        told = f"1 scan was left out: not readable; the first: {file}: a message is damaged: a message that is no bytes"
        assert_all_but(open_recording(file), points, [3], told)
    else:
        assert len(list(recover(file, ".db3"))) == 5


@pytest.mark.parametrize("length", [0, 3, 15])
@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_a_message_that_is_too_short_costs_no_other(make_bag_kit, write_drive, kind, length):
    """Shorter than a header; the first and the last are those that most is learnt from."""
    kit = make_bag_kit(kind)
    serialize, numbers = kit.serialize, itertools.count()
    kit.serialize = lambda message: serialize(message)[: length if next(numbers) in (0, 5) else None]
    file, _, points = write_drive(kind, kit=kit)
    recording = open_recording(file)
    told = f"2 scans were left out: not readable; the first: {file}: a message is damaged: a message of {length} bytes"
    assert_all_but(recording, points, [0, 5], told)
    assert recording.describe().first_stamp == stamp_ns(1) / 10**9
    with pytest.raises(InputError, match=f"a message of {length} bytes"):
        list(recording.scans())


def chunks_of(file):
    """Where the chunks of a bag begin, behind their headers, and how long they are, by its index."""
    if file.suffix == ".bag":
        with Rosbag1Reader(file) as reader:
            return [(chunk.datapos, chunk.datasize) for chunk in reader.chunks.values()]
    with Rosbag2Reader(file) as reader:
        return [(c.chunk_start_offset + 49 + len(c.compression), c.compressed_size) for c in reader.storage.chunks]


def overwrite(file, begin, content):
    data = bytearray(file.read_bytes())
    data[begin : begin + len(content)] = content
    file.write_bytes(data)


BIG = {"count": 6, "width": 1500}  # two of these scans fill a chunk
KINDS = [("bag", None), ("bag", Rosbag1Writer.CompressionFormat.LZ4), ("mcap", None)]


@pytest.mark.parametrize("damaged", [0, 2])
@pytest.mark.parametrize(("kind", "compression"), KINDS)
def test_an_indexed_bag_is_read_up_to_a_damaged_chunk(write_drive, kind, compression, damaged):
    file, _, points = write_drive(kind, **BIG, **({} if compression is None else {"compression": (compression,)}))
    chunks = chunks_of(file)
    assert len(chunks) == 3
    begin, length = chunks[damaged]
    if kind == "mcap":  # the checksum of the chunk, which rosbags leaves out
        overwrite(file, begin - 49 + 9 + 24, b"\1\2\3\4")
    overwrite(file, begin, bytes(length))
    lost = list(range(2 * damaged, 6))
    if not damaged:  # nothing to learn from is left
        with pytest.raises(InputError, match="reading stopped after 0 messages"):
            list(open_recording(file).scans(faults=Faults()))
        return
    told = (
        f"1 damaged place in the bag was met, where reading its file stopped; the first: {file}: reading stopped after"
        f" {2 * damaged} messages of /points",
        f"{len(lost)} scans are missing that the index lists; the first: its index lists 6 scans, it holds",
    )
    assert_all_but(open_recording(file), points, lost, *told)
    assert open_recording(file).describe().duration_s > 0.0


@pytest.mark.long
def test_damage_in_one_file_of_a_folder_costs_no_other(write_drive):
    file, folder, _ = write_drive("mcap", **BIG)
    later, _, _ = write_drive("mcap", **BIG, name="later", first=6)
    begin, length = chunks_of(file)[1]
    overwrite(file, begin, bytes(length))
    shutil.copy(later, folder / "later.mcap")
    metadata = (folder / "metadata.yaml").read_text().replace("message_count: 6\n", "message_count: 12\n")
    metadata = metadata.replace("- drive.mcap\n", "- drive.mcap\n  - later.mcap\n", 1)
    (folder / "metadata.yaml").write_text(metadata)
    faults = Faults()
    scans = list(open_recording(folder).scans(faults=faults))
    assert [scan.stamp for scan in scans] == [stamp_ns(i) / 10**9 for i in (0, 1, *range(6, 12))]
    assert faults.warnings()[0].startswith("1 damaged place in the bag was met")


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_file_that_went_bad_since_its_index_was_read_is_an_error(write_drive, kind):
    file, _, _ = write_drive(kind)
    recording = open_recording(file)
    assert len(recording.warnings) == 0
    file.write_bytes(bytes(5000))
    with pytest.raises(InputError, match=r"cannot be opened|index cannot be read|reading stopped after 0"):
        list(recording.scans(faults=Faults()))


@pytest.mark.parametrize("damaged", [0, 2, 5])
@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_damaged_message_that_was_compressed_by_itself_costs_no_other(write_drive, kind, damaged):
    """The first ones are those that what is learnt of the recording is learnt from."""
    _, folder, points = write_drive(kind, compression=(CompressionMode.MESSAGE, CompressionFormat.ZSTD))
    file = folder / f"drive.{kind}"
    if kind == "db3":
        ((data,),) = execute(file, "SELECT data FROM messages WHERE id = ?", damaged + 1)
        data = data[:4] + b"\xff" * 40 + data[44:]
        execute(file, "UPDATE messages SET data = ? WHERE id = ?", data, damaged + 1)
    else:
        data, magic = file.read_bytes(), b"\x28\xb5\x2f\xfd"
        places = [at for at in range(len(data)) if data.startswith(magic, at)]
        assert len(places) == 6
        overwrite(file, places[damaged] + 4, b"\xff" * 40)
    recording = open_recording(folder)
    told = f"1 scan was left out: not readable; the first: {folder}: a message is damaged: "
    assert_all_but(recording, points, [damaged], told)
    assert recording.describe().first_stamp == stamp_ns(damaged == 0) / 10**9


def test_a_damaged_file_that_was_compressed_as_a_whole_is_told(write_drive):
    """And how to get at what lies before the damage."""
    _, folder, points = write_drive("mcap", compression=(CompressionMode.FILE, CompressionFormat.ZSTD))
    (file,) = folder.glob("*.zstd")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(InputError, match=r"cannot be opened .*`zstd -dc \S+\.zstd > \S+\.mcap` and give") as caught:
        open_recording(folder)
    assert "\n" not in str(caught.value)
    half = file.with_suffix("")
    half.write_bytes(zstd.ZstdDecompressor().decompress(file.read_bytes()))  # as zstd -d does
    recording = open_recording(half)
    assert len(recording) in (2, 3)
    assert_first_scans(recording, points, len(recording))


def test_frames_are_unpacked_one_after_the_other(rng):
    parts = rng.bytes(100_000), bytes(50_000)
    packed = b"".join(map(zstd.compress, parts))
    assert unpacked_message(packed) == b"".join(parts)
    with pytest.raises(ValueError, match="cut short"):
        unpacked_message(packed[:-10])


@pytest.mark.parametrize(("kind", "compression"), COMPRESSIONS)
@pytest.mark.parametrize("indexed", [True, False])
def test_chunks_and_messages_that_unpack_to_too_much_are_refused(write_drive, monkeypatch, kind, compression, indexed):
    """A scan has some kilobytes here."""
    monkeypatch.setattr("lidarslam.datasets.ros.bag_file.MOST_BYTES", 1_000)
    file, source, _ = write_drive(kind, compression=compression)
    if not indexed:
        file.write_bytes(file.read_bytes()[:-9])
    with pytest.raises(InputError) as caught:
        list(open_recording(source).scans())
    assert "\n" not in str(caught.value)


def test_a_file_compressed_as_a_whole_that_unpacks_to_too_much_is_refused(write_drive, monkeypatch):
    monkeypatch.setattr("lidarslam.datasets.ros.bag_file.MOST_BYTES", 1_000)
    _, folder, _ = write_drive("mcap", compression=(CompressionMode.FILE, CompressionFormat.ZSTD))
    (file,) = folder.glob("*.zstd")
    file.write_bytes(zstd.compress(bytes(10_000_000)))
    with pytest.raises(InputError, match="unpacks to more than 100 times its size"):
        open_recording(folder)


@pytest.mark.parametrize("table", ["messages", "topics"])
@pytest.mark.parametrize("is_whole", [True, False])
def test_a_database_with_a_view_for_a_table_is_refused(write_drive, table, is_whole):
    """Its query, which is part of the file, has no end."""
    file, folder, _ = write_drive("db3")
    ((columns,),) = execute(file, f"SELECT group_concat(name) FROM pragma_table_info('{table}')")
    zeros = ",".join("0" for _ in columns.split(","))
    endless = f"endless({columns}) AS (SELECT {zeros} UNION ALL SELECT {zeros} FROM endless)"
    execute(file, f"DROP TABLE {table}")
    execute(file, f"CREATE VIEW {table} AS WITH RECURSIVE {endless} SELECT * FROM endless")
    with pytest.raises(InputError, match="cannot be opened"):
        open_recording(folder if is_whole else file)


@pytest.mark.parametrize("is_whole", [True, False])
def test_messages_that_were_left_in_the_log_of_a_database_are_told(write_drive, is_whole):
    """A recorder that was killed leaves them there; there may be no others."""
    file, folder, points = write_drive("db3")
    Path(f"{file}-wal").write_bytes(b"-")
    recording = open_recording(folder if is_whole else file)
    assert_first_scans(recording, points, 6)
    assert "PRAGMA wal_checkpoint" in recording.warnings[0]
    (folder / "metadata.yaml").unlink()
    execute(file, "DELETE FROM messages")
    Path(f"{file}-wal").write_bytes(b"-")
    with pytest.raises(InputError, match="PRAGMA wal_checkpoint"):
        open_recording(folder if is_whole else file)
