"""Whole runs on recordings that are damaged: a result that says what was left out, or one line; never anything else."""

import csv
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from lidarslam.core.geometry import is_rigid
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import read_kitti_poses, read_tum
from lidarslam.datasets.folders.scan_files import read_ply
from lidarslam.datasets.ros.bag_message import POINT_CLOUD2_TYPE
from lidarslam.datasets.ros.made_messages import header, point_cloud
from lidarslam.storage.directory import UNFINISHED, About
from lidarslam.storage.finished_run import where_astray

from ..conftest import fuzzed, lidarslam
from .conftest import FAST, ends_well, summary_of

FIELDS = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", "u2"), ("time", "f8")]
STAMP_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
YEAR_NS = 365 * 86400 * 10**9


@pytest.fixture
def tables(room_scans: list[Scan]) -> list[np.ndarray]:
    tables = []
    for scan in room_scans[:8]:
        table = np.zeros(1500, FIELDS)
        points = scan.points[::6]
        table["x"], table["y"], table["z"] = points.T
        table["time"] = scan.time_offsets[::6]
        tables.append(table)
    return tables


def run(source: Path, *options: str, asked: int | None = None) -> tuple[int, dict[str, Any], str]:
    """Info and run; exit status, summary (empty without one) and what was said on standard error."""
    assert ends_well("info", source).exit_code in (0, 1)
    out = source.parent / "run"
    result = ends_well("run", source, "--out", out, "--overwrite", *FAST, *options)
    assert result.exit_code != 2
    summary = summary_of(out) if (out / "summary.json").exists() else {}
    if summary:
        check(out, summary)
        assert all(f"warning: {warning}" in result.stdout for warning in summary["warnings"])
        if asked is not None and result.exit_code != 1:
            assert summary["scans"] + left_out(summary) == asked
    else:
        assert result.exit_code == 1
        assert not out.exists()
    shutil.rmtree(out, ignore_errors=True)
    return result.exit_code, summary, result.stderr


def left_out(summary: dict[str, Any]) -> int:
    """How many scans its warnings say were left out."""
    return sum(int(found[1]) for w in summary["warnings"] if (found := re.match(r"(\d+) scans? w\w+ left out", w)))


def check(out: Path, summary: dict[str, Any]) -> None:
    """Everything in a run directory is finite and of one mind."""
    trajectory = read_tum(out / "trajectory.tum")  # refuses stamps that do not increase and what is no rotation
    assert len(trajectory) == summary["scans"]
    assert np.isfinite(trajectory.T_world_lidar).all()
    assert is_rigid(trajectory.T_world_lidar)
    assert (np.diff(trajectory.stamps) > 0.0).all()
    assert len(read_kitti_poses(out / "trajectory.kitti")) == len(read_tum(out / "odometry.tum")) == summary["scans"]
    rows = list(csv.DictReader((out / "scans.csv").open()))
    assert [float(row["stamp"]) for row in rows] == pytest.approx(trajectory.stamps, abs=1e-6)
    assert sum(row["status"] == "lost" for row in rows) == summary["lost_scans"]
    assert sum(row["status"] == "degraded" for row in rows) == summary["degraded_scans"]
    assert np.isfinite([summary["length_m"], summary["duration_s"]]).all()
    assert (out / "map.ply").exists() == (summary["map_points"] > 0)
    if summary["map_points"]:
        cloud = read_ply(out / "map.ply")
        assert len(cloud) == summary["map_points"]
        assert all(np.isfinite(cloud[axis]).all() for axis in ("x", "y", "z", "nx", "ny", "nz"))


# Faults in the numbers of one scan: the fields that are changed, and what they become, or what becomes of them.
FAULTS: dict[str, tuple[Sequence[str], Any]] = {
    "not a number": ("xyz", np.nan),
    "one place": ("xyz", 2.0),
    "millimetres": ("xyz", lambda values: 1000.0 * values),
    "absurd": ("xyz", lambda values: np.where(np.arange(1500) % 3, values, [1e30, np.inf, 1e7, -np.inf, np.nan] * 300)),
    "rings": (["ring"], lambda values: np.where(np.arange(1500) % 2, values, 65535)),
    "times of hours": (["time"], lambda values: 36_000.0 * values),
    "times not a number": (["time"], np.nan),
    "times reversed": (["time"], lambda values: values[::-1].copy()),
    "times alike": (["time"], 0.0),
}
SPOILT = ("good", "empty", "one point", *FAULTS)


def spoil(table: np.ndarray, how: str) -> np.ndarray:
    table = table[: {"empty": 0, "one point": 1}.get(how)].copy()
    names, change = FAULTS.get(how, ((), None))
    for name in names:
        table[name] = change(table[name]) if callable(change) else change
    return table


UNREADABLE = ("cut", "noise", "pickled", "no x", "gone", "folder")


@pytest.mark.long
@fuzzed(50)
@given(st.lists(st.sampled_from(SPOILT + UNREADABLE), min_size=1, max_size=8), st.integers(0, 2**32))
def test_any_sequence_of_damaged_files(tmp_path, tables, faults, seed):
    folder = tmp_path / "drive"
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.rmdir() if path.is_dir() else path.unlink()
    for index, how in enumerate(faults):
        write_scan(folder / f"{index:03d}.npy", tables[index], how, seed)
    asked = sum(how not in ("gone", "folder") for how in faults)
    (folder / "times.txt").write_text("".join(f"{1000 + 0.1 * i:.3f}\n" for i in range(max(asked, 2))[:asked]))
    code, summary, said = run(folder, asked=asked)
    readable = [how for how in faults if how not in UNREADABLE]
    if not any(how not in ("empty", "not a number") for how in readable):
        assert code == 1
    elif asked > 1:
        assert code in (0, 3), said
        assert summary["scans"] == len(readable)


def write_scan(path: Path, table: np.ndarray, how: str, seed: int) -> None:
    if how == "gone":
        path.symlink_to(path.with_name("nowhere"))
    elif how == "folder":
        path.mkdir()
    elif how == "noise":
        path.write_bytes(np.random.default_rng(seed).bytes(5000))
    elif how == "pickled":
        np.save(path, np.array([{"x": 1.0}], dtype=object))
    elif how == "no x":
        np.save(path, table[["y", "z", "time"]])
    else:
        np.save(path, spoil(table, how))
        if how == "cut":
            data = path.read_bytes()
            path.write_bytes(data[: seed % len(data)])


def write_bag(folder: Path, scans: list[tuple[int, str, np.ndarray]]) -> Path:
    """A bag of clouds: the stamp in ns, the sensor and the points of each."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    shutil.rmtree(folder, ignore_errors=True)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/points", POINT_CLOUD2_TYPE, typestore=store)
        for index, (stamp_ns, frame_id, table) in enumerate(scans):
            message = point_cloud(store, header(store, stamp_ns, frame_id), table)
            raw = store.serialize_cdr(message, message.__msgtype__)
            writer.write(connection, STAMP_NS + index * PERIOD_NS, bytes(raw))
    return folder


SHIFTS_NS = (0, 0, 0, 0, 0, -PERIOD_NS, 30_000_000, -YEAR_NS, YEAR_NS, -STAMP_NS, 5 * 10**9 - STAMP_NS, 4 * 10**9)


@pytest.mark.long
@fuzzed(50)
@given(
    st.lists(
        st.tuples(st.sampled_from(SPOILT), st.sampled_from(SHIFTS_NS), st.sampled_from("aaaab")),
        min_size=1,
        max_size=8,
    )
)
def test_any_sequence_of_odd_messages(tmp_path, tables, scans):
    messages = [
        (max(0, STAMP_NS + index * PERIOD_NS + shift_ns), frame, spoil(tables[index], how))
        for index, (how, shift_ns, frame) in enumerate(scans)
    ]
    _, summary, _ = run(write_bag(tmp_path / "drive", messages), asked=len(scans))
    stamps = {stamp for stamp, _, _ in messages}
    if all(shift == 0 and frame == "a" for _, shift, frame in scans) and summary:
        assert summary["scans"] == len(stamps)


def test_a_clock_that_jumps_a_year_ahead_for_good_is_followed_and_told(tmp_path, tables):
    stamps_ns = [STAMP_NS + i * PERIOD_NS + (YEAR_NS if i > 3 else 0) for i in range(8)]
    messages = [(stamp_ns, "lidar", table) for stamp_ns, table in zip(stamps_ns, tables, strict=True)]
    code, summary, _ = run(write_bag(tmp_path / "drive", messages), asked=8)
    assert (code, summary["scans"]) == (0, 8)
    assert any("1 gap in the stamps" in w and "31536000.1 s after scan 3" in w for w in summary["warnings"])


def write_folder(folder: Path, tables: list[np.ndarray], times: str = "") -> Path:
    """Scans as .npy files; times in a file of theirs."""
    folder.mkdir(exist_ok=True)
    for index, table in enumerate(tables):
        np.save(folder / f"{index:03d}.npy", table)
    if times:
        (folder / "times.txt").write_text(times)
    return folder


@pytest.mark.parametrize("first", [0.0, -9e10, 2.5e9])
def test_no_fault_no_warning_whatever_the_clock(tmp_path, tables, first):
    folder = write_folder(tmp_path / "drive", tables, "".join(f"{first + 0.1 * i:.3f}\n" for i in range(8)))
    code, summary, said = run(folder, asked=8)
    assert (code, summary["scans"], summary["warnings"], said) == (0, 8, [], "")


def test_scans_that_vanish_while_it_runs_are_counted_and_too_many_are_no_success(tmp_path, tables, monkeypatch):
    from lidarslam.datasets.folders import scan_folder

    folder = write_folder(tmp_path / "drive", tables)
    table_reader = scan_folder.table_reader

    def vanishing(files: Any) -> Any:
        read = table_reader(files)

        def reader(path: Path) -> Any:
            if path.stem == "002":
                for name in ("005.npy", "006.npy"):
                    (folder / name).unlink(missing_ok=True)
            return read(path)

        return reader

    monkeypatch.setattr(scan_folder, "table_reader", vanishing)
    out = tmp_path / "run"
    assert lidarslam("run", folder, "--out", out, *FAST).exit_code == 3
    summary = summary_of(out)
    assert (summary["scans"], left_out(summary), summary["unreadable_scans"]) == (6, 2, 2)
    assert where_astray(summary) in " ".join(summary["warnings"])


def test_links_that_lead_nowhere_or_in_a_circle_are_counted(tmp_path, tables):
    folder = write_folder(tmp_path / "drive", tables)
    for name, target in (("003.npy", "nowhere.npy"), ("005.npy", "005.npy")):
        (folder / name).unlink()
        (folder / name).symlink_to(folder / target)
    _, summary, _ = run(folder)
    assert summary["scans"] == 6
    assert "2 scans are no files that can be opened, such as 003.npy." in summary["warnings"]
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    assert run(tmp_path / "circle")[0] == 1


def test_pipes_are_not_waited_for(tmp_path, tables):
    folder = kitti_drive(tmp_path / "drive", tables)
    for make, name in ((os.mkfifo, "000003.bin"), (os.mkdir, "000004.bin")):
        (folder / "velodyne" / name).unlink()
        make(folder / "velodyne" / name)
    _, summary, _ = run(folder, asked=8)
    assert (summary["scans"], left_out(summary)) == (6, 2)


def test_a_run_of_a_name_that_no_terminal_can_show_can_be_resumed(tmp_path):
    about = About({"source": os.fsdecode(b"drive \xff")}, "stopped", (2,))
    (tmp_path / UNFINISHED).mkdir()
    about.write(tmp_path)
    assert About.read(tmp_path) == about


@pytest.mark.skipif(os.geteuid() == 0, reason="permissions do not bind the superuser")
def test_what_may_not_be_read(tmp_path, tables):
    folder = write_folder(tmp_path / "drive", tables)
    (folder / "003.npy").chmod(0)
    _, summary, _ = run(folder, asked=8)
    assert (summary["scans"], left_out(summary)) == (7, 1)
    folder.chmod(0)
    code, _, said = run(folder)
    folder.chmod(0o700)
    assert code == 1
    assert "check its permissions" in said


IDENTITY_ROW = "1 0 0 0 0 1 0 0 0 0 1 0"


def kitti_drive(folder: Path, tables: list[np.ndarray]) -> Path:
    """A sequence of KITTI's odometry with these scans, without poses and times."""
    (folder / "velodyne").mkdir(parents=True)
    for index, table in enumerate(tables):
        points = np.stack([table["x"], table["y"], table["z"], table["x"]], axis=1)
        points.astype("<f4").tofile(folder / "velodyne" / f"{index:06d}.bin")
    (folder / "calib.txt").write_text(f"Tr: {IDENTITY_ROW}\n")
    return folder


def test_poses_of_which_some_are_missing_are_counted(tmp_path, tables):
    folder = kitti_drive(tmp_path / "drive", tables[:4])
    for poses, times, told in ((2, 4, "has 2 poses"), (9, 7, "has 9 poses")):
        (folder / "poses.txt").write_text(f"{IDENTITY_ROW}\n" * poses)
        (folder / "times.txt").write_text("".join(f"{i / 10}\n" for i in range(times)))
        warnings = " ".join(run(folder, asked=4)[1]["warnings"])
        assert f"{told} for the scans up to number 3" in warnings
        assert ("times.txt has 7 lines and" in warnings) == (times == 7)
        assert warnings.count("poses for the scans up to") == 1
