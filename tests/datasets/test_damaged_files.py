"""Files with bytes cut off, bytes changed or headers that lie: scans that make sense come out, or one line of error.

Nothing else may come out of any reader: no other exception, no warning of NumPy's, no scan with numbers that are none.
"""

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarslam.core.errors import InputError
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.registry import open_recording

from ..conftest import fuzzed
from .conftest import pcd_bytes, ply_bytes, point_table
from .test_kitti_odometry import write_sequence
from .test_kitti_raw import write_drive

POINTS = 120
SCANS = 4
HEADER_WORDS = (
    "", "0", "-1", "1", "3", "119", "121", "4294967295", "1000000000000", "9" * 30, "nan", "x y z", "x", "_", "F", "8",
    "ascii", "binary", "binary_compressed", "binary_big_endian", "vertex", "list", "float", "double", "\u00e9", "('x',",
)  # fmt: skip


def check(source: Path) -> int:
    """Describe a recording and read it all; how many scans make sense, -1 if it ended in one line of error."""
    faults, scans, error = Faults(), [], ""
    try:
        recording = open_recording(source)
        recording.describe()
        asked = len(recording)
        for scan in take_in(recording, range(asked), faults):
            scans.append(scan)
            assert np.isfinite(scan.points).all()
            assert np.abs(scan.points).max(initial=0.0) < 10_000.0
            assert scan.time_offsets is None or np.isfinite(scan.time_offsets).all()
            assert scan.rings is None or ((scan.rings >= 0) & (scan.rings < 4096)).all()
    except InputError as reason:
        error = str(reason)
    assert "\n" not in error
    stamps = [scan.stamp for scan in scans]
    assert np.isfinite(stamps).all()
    assert (np.diff(stamps) > 0.0).all()
    assert all("\n" not in line for line in faults.warnings())
    if error:
        return -1
    assert len(scans) + faults.left_out == asked
    return len(scans)


@st.composite
def damages(draw):
    """A function that damages bytes: cuts them off, changes some, or puts other words in the header."""
    how = draw(st.sampled_from(["cut", "flip", "flip in the header", "word", "insert"]))
    part = draw(st.floats(0.0, 1.0))
    values = draw(st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(0, 255)), min_size=1, max_size=12))
    word = draw(st.sampled_from(HEADER_WORDS)).encode()

    def damage(data: bytes, header: int) -> bytes:
        if how == "cut":
            return data[: int(part * len(data))]
        changed = bytearray(data)
        if how == "insert":
            place = int(part * len(data))
            return bytes(changed[:place]) + word + bytes(changed[place:])
        if how == "word":
            words = changed[:header].split(b" ")
            words[int(part * (len(words) - 1))] = word + b"\n" * (b"\n" in words[int(part * (len(words) - 1))])
            return b" ".join(bytes(each) for each in words) + bytes(changed[header:])
        extent = header if how == "flip in the header" else len(changed)
        for where, value in values:
            if extent:
                changed[int(where * (extent - 1))] = value
        return bytes(changed)

    return damage


@pytest.fixture(scope="module")
def table() -> np.ndarray:
    points = np.random.default_rng(3).uniform(-20.0, 20.0, (POINTS, 3))
    times = np.linspace(0, 100_000_000, POINTS).astype("<u4")
    return point_table(points, intensity=np.zeros(POINTS, "<f4"), t=times, ring=(np.arange(POINTS) % 16).astype("<u2"))


FORMATS = ("plain.bin", "structured.npy", "ascii.pcd", "binary.pcd", "binary_compressed.pcd", "ascii.ply",
           "binary_little_endian.ply", "binary_big_endian.ply")  # fmt: skip


def encode(name: str, points: np.ndarray) -> bytes:
    kind, _, suffix = name.partition(".")
    if suffix in ("pcd", "ply"):
        return (pcd_bytes if suffix == "pcd" else ply_bytes)(points, kind)
    if suffix == "bin":
        return np.column_stack([points[name] for name in ("x", "y", "z", "intensity")]).astype("<f4").tobytes()
    out = io.BytesIO()
    np.save(out, points)
    return out.getvalue()


@pytest.mark.parametrize("name", FORMATS)
@fuzzed(12)
@given(damage=damages(), place=st.integers(0, SCANS - 1))
def test_folder_of_damaged_scans(tmp_path, table, name, damage, place):
    data = encode(name, table)
    header = len(data) - len(encode(name, table[:0])) if name == "plain.bin" else len(encode(name, table[:0]))
    for index in range(SCANS):
        damaged = damage(data, min(header, len(data)))
        whole = encode(name, np.roll(table, index))
        (tmp_path / f"{index}{Path(name).suffix}").write_bytes(damaged if index == place else whole)
    (tmp_path / "times.txt").write_text("".join(f"{100 + index / 10}\n" for index in range(SCANS)))
    # A change may well make another valid scan; the other three are never lost.
    assert check(tmp_path) >= SCANS - 1


SEQUENCE_FILES = ("times.txt", "calib.txt", "../../poses/04.txt", "velodyne/000002.bin")
RAW_FILES = (
    "velodyne_points/timestamps.txt",
    "velodyne_points/timestamps_start.txt",
    "velodyne_points/data/0000000002.bin",
    "oxts/data/0000000001.txt",
    "oxts/timestamps.txt",
    "../calib_imu_to_velo.txt",
)


@pytest.mark.parametrize("name", [*SEQUENCE_FILES, *RAW_FILES])
@fuzzed(12)
@given(damage=damages())
def test_damaged_drives_of_kitti(tmp_path_factory, rng, name, damage):
    folder = tmp_path_factory.mktemp("kitti")
    source = folder / "sequences" / "04" if name in SEQUENCE_FILES else write_drive(folder, rng)
    if name in SEQUENCE_FILES:
        write_sequence(folder, rng)
    whole = (source / name).read_bytes()
    (source / name).write_bytes(damage(whole, len(whole)))
    assert check(source) >= 5 or name in ("times.txt", *RAW_FILES)
    try:
        truth = open_recording(source).ground_truth
        assert truth is None or np.isfinite(truth.T_world_lidar).all()
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017


@pytest.fixture
def bag(bag_kit, velodyne_clouds) -> dict[Path, bytes]:
    """The file of a bag and, if it is a folder, its metadata; what is in them."""
    file = bag_kit.storage_file(bag_kit.write({"/points": velodyne_clouds(bag_kit, SCANS)}))
    return {path: path.read_bytes() for path in (file, file.with_name("metadata.yaml")) if path.exists()}


@fuzzed(12)
@given(damage=damages(), what=st.sampled_from(["file", "metadata"]))
def test_damaged_bags(bag, damage, what):
    for path, content in bag.items():
        path.write_bytes(content)
    file, *metadata = bag
    if what == "metadata" and metadata:
        metadata[0].write_bytes(damage(bag[metadata[0]], len(bag[metadata[0]])))
        check(file.parent)
    else:
        file.write_bytes(damage(bag[file], min(len(bag[file]), 600)))
        check(file)


def assert_refused(file: Path, content: bytes, words: str) -> None:
    file.write_bytes(content)
    with pytest.raises(InputError, match=words):
        next(open_recording(file.parent).scans())


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "plain.bin"])
def test_a_header_that_promises_more_than_there_is(tmp_path, table, name):
    """One point more, and so many that making room for them would fill any memory."""
    data = encode(name, table)
    for promised in ("121", "1000000000000"):
        lie = data.replace(b"POINTS 120", f"POINTS {promised}".encode())
        lie = lie.replace(b"element vertex 120", f"element vertex {promised}".encode())
        if name.endswith(".npy"):  # whose header has a length of its own
            length = len(f"({promised},), ") - len("(120,), ")
            lie = data.replace(b"(120,), }" + b" " * length, f"({promised},), }}".encode())
        assert lie != data
        assert_refused(tmp_path / name, lie, "truncated")


def test_pickled_objects_are_never_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path(tmp_path / "sprung").touch, ())

    np.save(tmp_path / "0.npy", np.array([Trap()], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="allow_pickle=False"):
        next(open_recording(tmp_path).scans())
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("name", [name for name in FORMATS if name.endswith((".pcd", ".ply"))])
def test_a_header_that_promises_no_points_or_other_elements_than_there_are(tmp_path, table, name):
    whole = encode(name, table)
    none = whole.replace(b"POINTS 120", b"POINTS 0").replace(b"element vertex 120", b"element vertex 0")
    assert_refused(tmp_path / name, none, r"promises no points, and .* bytes follow|is truncated")
    for data in (whole, none) if name.endswith(".ply") else ():
        told = {b"element vertex": "`vertex` before any others", b"end_header": r"1,000,000,000,000 other .* truncated"}
        for place, said in told.items():
            lie = data.replace(place, b"element face 1000000000000\nproperty uchar n\n" + place)
            assert_refused(tmp_path / name, lie, said)
