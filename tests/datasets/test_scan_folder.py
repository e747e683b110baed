"""The reader of scan folders: every format with every type of field, stamps, truth, and damaged files."""

import logging
from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.folders.scan_files import read_pcd, read_ply
from lidarslam.datasets.info_text import describe_source
from lidarslam.datasets.registry import choose_reader, open_recording
from lidarslam.datasets.times.stamps import read_stamps, stamps_from_names

from .conftest import pcd_bytes, ply_bytes, point_table

EPOCH = 1583836591.25


def _rich(rng: np.random.Generator, count: int = 200) -> np.ndarray:
    numbers = np.arange(count)
    return point_table(
        rng.uniform(1.0, 30.0, (count, 3)),
        intensity=rng.uniform(0.0, 255.0, count).astype("<f4"),
        t=np.linspace(0, 99_000_000, count).astype("<u4"),  # nanoseconds of a sweep of 0.1 s
        ring=(numbers % 16 + 300).astype("<u2"),
        label=-(numbers % 100).astype("i1"),
        clock=EPOCH + 1e-6 * numbers,
    )


def _write(folder: Path, name: str, table: np.ndarray) -> None:
    suffix = name.rpartition(".")[2]
    folder.mkdir(parents=True, exist_ok=True)
    if suffix == "npy":
        np.save(folder / name, table)
    elif suffix == "pcd":
        (folder / name).write_bytes(pcd_bytes(table, "binary"))
    elif suffix == "ply":
        (folder / name).write_bytes(ply_bytes(table, "binary_little_endian"))
    else:
        np.column_stack([table[n] for n in ("x", "y", "z", "intensity")]).astype("<f4").tofile(folder / name)


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_pcd_keeps_every_field_and_type(tmp_path, rng, data):
    table = _rich(rng)
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(table, data))
    read = read_pcd(tmp_path / "a.pcd")
    assert read.dtype == table.dtype
    np.testing.assert_array_equal(read, table)


def test_pcd_with_padding_and_vector_fields(tmp_path, rng):
    normals = rng.uniform(size=(5, 3)).astype("<f4")
    table = point_table(rng.uniform(1.0, 9.0, (5, 3)), _=np.zeros((5, 4), "u1"), normal=normals)
    for data in ("binary", "binary_compressed"):
        (tmp_path / "a.pcd").write_bytes(pcd_bytes(table, data))
        read = read_pcd(tmp_path / "a.pcd")
        np.testing.assert_array_equal(read["x"], table["x"])
        np.testing.assert_array_equal(read["normal"], normals)
    twice = pcd_bytes(table, "binary").replace(b"FIELDS x y z _ normal", b"FIELDS x y z _ _")
    (tmp_path / "a.pcd").write_bytes(twice)
    np.testing.assert_array_equal(read_pcd(tmp_path / "a.pcd")["x"], table["x"])


def test_pcd_as_other_programs_write_it(tmp_path):
    """Without COUNT and WIDTH, with tabs and blanks at the ends of lines, and a single point."""
    header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA ascii\n"
    (tmp_path / "a.pcd").write_text(header + "1.5\t 2.5  3.5 \n")
    assert read_pcd(tmp_path / "a.pcd").tolist() == [(1.5, 2.5, 3.5)]


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_keeps_every_property_and_type(tmp_path, rng, encoding):
    table = _rich(rng)
    (tmp_path / "a.ply").write_bytes(ply_bytes(table, encoding, faces=True))
    read = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(read, table)
    assert read.dtype.newbyteorder("<") == table.dtype


def test_open3d_agrees_on_pcd(tmp_path, rng):
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    table = _rich(rng, 3000)  # repeats, so that Open3D's compressor writes short, long and overlapping copies
    table["intensity"] = 7.0
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(table, "binary"))
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "a.pcd"))
    for compressed in (True, False):
        o3d.t.io.write_point_cloud(str(tmp_path / "b.pcd"), cloud, write_ascii=False, compressed=compressed)
        read = read_pcd(tmp_path / "b.pcd")
        for name in ("x", "y", "z", "intensity", "t", "ring", "clock"):
            np.testing.assert_array_equal(read[name], table[name])


@pytest.mark.parametrize("suffix", ["bin", "pcd", "ply", "npy"])
def test_reads_every_format_with_times_and_rings(tmp_path, rng, suffix):
    folder = tmp_path / "scans"
    tables = [_rich(rng, 150 + i) for i in range(3)]
    for index, table in enumerate(tables):
        _write(folder, f"scan_{index}.{suffix}", table)
    assert choose_reader(folder) == "scan-folder"
    recording = open_recording(folder)
    assert len(recording) == 3
    assert recording.name == "scans"
    assert recording.T_cam_lidar is None
    for scan, table in zip(recording.scans(), tables, strict=True):
        np.testing.assert_array_equal(scan.points.T, [table[axis] for axis in "xyz"])
        np.testing.assert_array_equal(scan.intensities, table["intensity"])
        if suffix == "bin":
            assert scan.time_offsets is None
            assert scan.rings is None
        else:
            np.testing.assert_allclose(scan.time_offsets, table["t"] * 1e-9, atol=1e-12)
            np.testing.assert_array_equal(scan.rings, table["ring"])
    info = recording.describe()
    assert (info.reader, info.scans, len(info.first)) == ("scan-folder", 3, 150)
    assert info.rate_hz == pytest.approx(10.0)
    if suffix != "bin":  # which has no times
        assert (info.point_time.field, info.point_time.unit, info.point_time.reference) == ("t", "ns", "relative")
        assert info.first.time_offsets.max() == pytest.approx(0.099)
        assert [(f.name, f.type_name) for f in info.fields][4:6] == [("t", "uint32"), ("ring", "uint16")]
        assert info.first.rings is not None


def test_time_options(tmp_path, rng):
    table = _rich(rng)
    _write(tmp_path, "scan_0.npy", table)
    assert next(open_recording(tmp_path, ReaderConfig(time_reference="none")).scans()).time_offsets is None
    table["t"] //= 1000  # microseconds, as their span says; a given unit is not questioned
    _write(tmp_path, "scan_0.npy", table)
    for config, factor in ((ReaderConfig(), 1e-6), (ReaderConfig(time_unit="ns", time_reference="relative"), 1e-9)):
        scan = next(open_recording(tmp_path, config).scans())
        np.testing.assert_allclose(scan.time_offsets, table["t"] * factor, atol=1e-15)
    with pytest.raises(InputError, match="no time field 'when'"):
        next(open_recording(tmp_path, ReaderConfig(time_field="when")).scans())


def _absolute(rng, start: float, count: int = 100) -> np.ndarray:
    return point_table(rng.uniform(1.0, 30.0, (count, 3)), timestamp=start + np.linspace(0.0, 0.0625, count))


def test_absolute_times_give_the_stamps_where_there_are_none(tmp_path, rng):
    for index in range(3):
        table = _absolute(rng, EPOCH + 0.05 * index)
        table["timestamp"][7] = 0.0  # a missing return
        _write(tmp_path, f"scan_{index}.ply", table)
    recording = open_recording(tmp_path)
    scans = list(recording.scans())
    np.testing.assert_allclose([s.stamp for s in scans], EPOCH + 0.05 * np.arange(3), rtol=0.0, atol=1e-6)
    assert [(len(scan), scan.untimed) for scan in scans] == [(100, 1)] * 3
    assert scans[2].time_offsets.min() == pytest.approx(0.0, abs=1e-6)
    assert scans[2].time_offsets.max() == pytest.approx(0.0625, abs=1e-6)
    info = recording.describe()
    assert info.rate_hz == pytest.approx(20.0, rel=1e-3)
    assert info.first_stamp == pytest.approx(EPOCH, abs=1e-6)


def test_points_on_another_clock_than_times_txt_are_one_warning(tmp_path, rng, caplog):
    """A clock that begins at zero is ambiguous, so that several scans are looked at; 1.7 s are 1.7e9 s read as ns."""
    for index in range(40):
        _write(tmp_path, f"scan_{index}.npy", _absolute(rng, 1.7e9 + 0.1 * index, 20))
    (tmp_path / "times.txt").write_text("".join(f"{0.1 * index:.3f}\n" for index in range(40)))
    with caplog.at_level(logging.WARNING):
        recording = open_recording(tmp_path)
        for index, scan in enumerate(recording.scans()):
            assert scan.stamp == pytest.approx(0.1 * index)
            np.testing.assert_allclose([scan.time_offsets.min(), scan.time_offsets.max()], [0.0, 0.0625], atol=1e-6)
        info = recording.describe()
    assert caplog.records == []
    (warning,) = recording.warnings
    assert "'timestamp' reads another clock" in warning
    assert [note for note in info.notes if "clock" in note] == [warning]


def _write_numbered(folder: Path, rng, names: list[str]) -> None:
    """Scans whose number of points is 10, 11, ... in the order given."""
    for place, name in enumerate(names):
        _write(folder, name, _rich(rng, 10 + place))


def _sizes(recording) -> list[int]:
    return [len(scan) for scan in recording.scans()]


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        ([f"scan_{n}.bin" for n in (0, 2, 10, 11, 100)], [0.0, 0.1, 0.2, 0.3, 0.4]),
        (["1311868164.36.ply", "1311868164.4.ply", "1311868165.0.ply"], [1311868164.36, 1311868164.4, 1311868165.0]),
        (["9.9.ply", "10.05.ply"], [9.9, 10.05]),
        (["1311868164360000000.bin", "1311868164460000000.bin"], [1311868164.36, 1311868164.46]),
        (["1311868164360000.npy", "1311868164460000.npy"], [1311868164.36, 1311868164.46]),
        (["cloud_1583836591_82590976.pcd", "cloud_1583836591_182590976.pcd"], [1583836591.082591, 1583836591.182591]),
        (["1583836591.90000000.pcd", "1583836591.190000000.pcd"], [1583836591.09, 1583836591.19]),
        (["1583836591_082590.pcd", "1583836591_182590.pcd"], [1583836591.08259, 1583836591.18259]),
        (["1_1583836591182590976.pcd", "2_1583836591282590976.pcd"], [1583836591.182591, 1583836591.282591]),
        (["scan_1583836591.25.pcd", "scan_1583836591.3.pcd"], [1583836591.25, 1583836591.3]),
    ],
)
def test_stamps_from_names(tmp_path, rng, names, stamps):
    _write_numbered(tmp_path, rng, names)
    recording = open_recording(tmp_path)
    assert _sizes(recording) == [10 + i for i in range(len(names))]
    np.testing.assert_allclose([scan.stamp for scan in recording.scans()], stamps, rtol=0.0, atol=3e-7)
    assert ("The stamps are the file names." in recording.describe().notes) == (names[0] != "scan_0.bin")


@pytest.mark.parametrize(
    "stems", [["000000", "000001"], ["20240131120000", "20240131120001"], ["a1.5", "a2.5"], ["a_1_5", "a_1_6"]]
)
def test_names_that_are_no_stamps(stems):
    assert stamps_from_names(stems) is None


@pytest.mark.parametrize(("names", "numbers", "missing"), [
    (["000000", "000001", "000004", "000005"], [0, 1, 4, 5], 2), (["scan_8", "scan_10", "scan_14"], [0, 1, 3], 1),
    (["a10", "a20", "a30"], [0, 1, 2], 0), (["1", "7001", "29002"], [0, 1, 2], 0), (["a", "b1", "c2"], [0, 1], 0),
])  # fmt: skip
def test_missing_numbers_are_gaps_in_the_assumed_stamps(tmp_path, rng, names, numbers, missing):
    _write_numbered(tmp_path, rng, [f"{name}.bin" for name in names])
    recording = open_recording(tmp_path)
    np.testing.assert_allclose([scan.stamp for scan in recording.scans()], np.array(numbers) / 10.0)
    said = [warning for warning in recording.warnings if "missing among the names of the scans" in warning]
    assert [warning.split()[0] for warning in said] == ([str(missing)] if missing else [])


@pytest.mark.parametrize("others", [1, 3])
def test_scans_of_another_format_are_a_warning(tmp_path, rng, others):
    _write_numbered(tmp_path, rng, [f"{number:06d}.bin" for number in range(10)])
    for number in range(others):
        np.save(tmp_path / f"{10 + number:06d}.npy", np.ones((5, 3)))
    recording = open_recording(tmp_path)
    said = f"{others} other file{'s' if others > 1 else ''} not taken for scans, such as 000010.npy."
    assert (said in recording.warnings) == (others == 3)
    assert said in recording.describe().notes


@pytest.mark.parametrize(
    ("config", "rate_hz", "told"),
    [(ReaderConfig(), 10.0, "--set reader.rate_hz=5"), (ReaderConfig(rate_hz=20.0), 20.0, "as set")],
)
def test_without_stamps_an_assumed_rate_gives_them_and_is_a_warning(tmp_path, rng, config, rate_hz, told):
    _write_numbered(tmp_path, rng, ["000000.bin", "000001.bin", "000002.bin"])
    recording = open_recording(tmp_path, config)
    np.testing.assert_allclose([scan.stamp for scan in recording.scans()], np.arange(3) / rate_hz)
    (warning,) = (said for said in recording.warnings if f"{rate_hz:.0f} scans a second are assumed" in said)
    assert told in warning
    assert f"at an assumed {rate_hz:.2f} Hz" in describe_source(tmp_path, config)
    (tmp_path / "times.txt").write_text("0.0\n0.5\n1.0\n")
    assert open_recording(tmp_path).warnings == ()
    assert "at 2.00 Hz" in describe_source(tmp_path, ReaderConfig())


@pytest.mark.parametrize("name", ["timestamps.txt", "times.txt"])
@pytest.mark.parametrize("above", [False, True])
def test_a_stamp_file_comes_first(tmp_path, rng, name, above):
    folder = tmp_path / "scans"
    _write_numbered(folder, rng, ["5.5.bin", "6.5.bin", "7.5.bin"])
    (tmp_path / name if above else folder / name).write_text("0.5\n0.75\n1.5\n")
    recording = open_recording(folder)
    assert [scan.stamp for scan in recording.scans()] == [0.5, 0.75, 1.5]


def test_stamps_of_another_number_beside_the_folder_are_those_of_a_camera(tmp_path, rng):
    _write_numbered(tmp_path / "lidar", rng, ["5.5.bin", "6.5.bin", "7.5.bin"])
    (tmp_path / "times.txt").write_text("0.0\n0.25\n0.5\n0.75\n")
    assert [scan.stamp for scan in open_recording(tmp_path / "lidar").scans()] == [5.5, 6.5, 7.5]


@pytest.mark.parametrize(
    ("names", "lines", "stamps", "warning"),
    [
        (["a1", "a2", "a3"], "0.5\n0.75\n", [0.5, 0.75, 1.0], "2 stamps for 3 scans; those of the last 1 continue"),
        (["a1", "a2", "a3"], "0.5\n1.5\n2.5\n3.5\n", [0.5, 1.5, 2.5], "4 stamps for 3 scans; the first are taken."),
        (["000001", "000003"], "0.0\n0.1\n0.25\n0.35\n0.45\n", [0.1, 0.35], "5 stamps for 2 scans; each takes"),
        (["a1", "a2", "a3"], "0\n100\n200\n", [0.0, 100.0, 200.0], "100 s apart"),
        (["a1", "a2", "a3", "a4"], "1.0\n1.5\n1.5\n2.5\n", [1.0, 1.5, 2.0, 2.5], "1 stamp of times.txt interpolated"),
    ],
    ids=["too few", "too many", "numbered scans", "milliseconds", "repeated"],
)
def test_stamps_that_do_not_go_with_the_scans_are_a_warning(tmp_path, rng, names, lines, stamps, warning):
    _write_numbered(tmp_path, rng, [f"{name}.bin" for name in names])
    (tmp_path / "times.txt").write_text(lines)
    recording = open_recording(tmp_path)
    assert [scan.stamp for scan in recording.scans()] == stamps
    (said,) = recording.warnings
    assert warning in said


def test_stamp_file_formats(tmp_path):
    numbers = "1311868164.36\n1311868164460000000\n1311868164560000\n"
    (tmp_path / "times.txt").write_text(f"# stamps\n{numbers}\n2011-07-28 15:49:24.6600000000000000000000")
    expected = [1311868164.36, 1311868164.46, 1311868164.56, np.nan, 1311868164.66]
    np.testing.assert_allclose(read_stamps(tmp_path / "times.txt"), expected, rtol=0.0, atol=3e-7)
    for wrong in ("0.1 0.2", "nan", "inf", "soon", "2011-99-28 15:49:24.66", "9999-07-28 15:49:24.66"):
        (tmp_path / "times.txt").write_text(f"0.0\n{wrong}\n")
        with pytest.raises(InputError, match="at line 2"):
            read_stamps(tmp_path / "times.txt")


@pytest.mark.parametrize("scans", [["0.bin", "1.bin"], ["scan_1.ply", "scan_2.ply"]])
def test_a_map_beside_the_scans_is_no_scan(tmp_path, rng, scans):
    _write_numbered(tmp_path, rng, [*scans, "map.ply", ".0.bin"])
    recording = open_recording(tmp_path)
    assert _sizes(recording) == [10, 11]
    assert any("map.ply" in note for note in recording.describe().notes)


def test_bin_with_other_numbers_of_columns(tmp_path, rng):
    """32 points of five are 40 of four by size; only the ring numbers tell them apart."""
    five, four, three = (rng.uniform(1.0, 20.0, shape).astype(np.float32) for shape in ((32, 5), (40, 4), (7, 3)))
    five[:, 4] = np.arange(32)
    for cloud in (five, four, three):
        cloud.tofile(tmp_path / "0.bin")
        scan = next(open_recording(tmp_path).scans())
        np.testing.assert_array_equal(scan.points, cloud[:, :3])
        assert (scan.rings is None) == (cloud is not five)
    five[0, 4] = 0.5
    for content, told in ((bytes(4 * 7 + 1), "16 bytes each"), (five[:31].tobytes(), "20 bytes with a ring")):
        (tmp_path / "0.bin").write_bytes(content)
        with pytest.raises(InputError, match=told):
            open_recording(tmp_path)


@pytest.mark.parametrize(("columns", "kind"), [(5, "f4"), (6, "f4"), (8, "f4"), (3, "f8"), (4, "f8")])
def test_bin_of_another_layout_is_refused_by_its_values(tmp_path, columns, kind):
    """Sizes fit: 480 points of six numbers are 960 of three. A room whose points are in the order of one turn."""
    azimuth = np.linspace(-np.pi, np.pi, 480)
    rings = np.arange(480) % 16
    further = np.column_stack([np.full(480, 90.0), np.linspace(0.0, 0.1, 480), rings, *np.zeros((2, 480))])
    table = np.column_stack([8.3 * np.cos(azimuth), 6.1 * np.sin(azimuth), np.full(480, -1.7), further])
    table[:, :columns].astype(kind).tofile(tmp_path / "0.bin")
    with pytest.raises(InputError, match=f"by its values they have {columns * int(kind[1])} bytes"):
        open_recording(tmp_path)
    table[:, :3].astype("f4").tofile(tmp_path / "0.bin")  # by its size it may be 360 points of four, too
    assert _sizes(open_recording(tmp_path)) == [480]


def test_organised_and_plain_npy(tmp_path, rng):
    cloud = rng.uniform(1.0, 9.0, size=(4, 16, 4))
    cloud[1, 3, :3] = 0.0
    np.save(tmp_path / "0.npy", cloud)
    scan = next(open_recording(tmp_path).scans())
    np.testing.assert_array_equal(scan.points, np.delete(cloud.reshape(-1, 4), 19, axis=0)[:, :3])
    for wrong in (np.zeros(9), np.zeros((3, 500)), np.zeros((5, 2)), np.array([["a", "b", "c"]])):
        np.save(tmp_path / "0.npy", wrong)
        with pytest.raises(InputError, match=r"0\.npy: expected an array \(N, 3\)"):
            next(open_recording(tmp_path).scans())


def test_ply_with_other_elements_before_the_vertices_is_refused(tmp_path, rng):
    content = ply_bytes(_rich(rng), "ascii").replace(b"element vertex", b"element face 0\nelement vertex")
    (tmp_path / "0.ply").write_bytes(content)
    with pytest.raises(InputError, match="`vertex` before any others"):
        next(open_recording(tmp_path).scans())
