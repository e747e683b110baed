"""Files damaged at random: every command ends with a status and at most one line of error, and writes nothing else."""

import contextlib
import os
import re
import resource
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from lidarslam.config.settings import Config, dump_yaml
from lidarslam.core.imu import ImuSamples
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map.point_cloud import PointCloud, write_cloud
from lidarslam.simulation.recorder import Rig, SimulatedScan
from lidarslam.simulation.writers import FORMATS, write_kitti, write_ply_scans
from lidarslam.storage.finished_run import load_map

from .. import conftest
from ..conftest import write_recording
from ..datasets.conftest import write_pcap
from .conftest import FAST, ends_well

pytestmark = pytest.mark.slow

fuzzed = conftest.fuzzed(int(os.environ.get("LIDARSLAM_FUZZ_EXAMPLES", "40")))
# More than all commands here take on the undamaged files, beyond what is loaded already.
MOST_MEMORY_KB = 1 << 20
NUMBERS = (0, 1, 2, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 10**12, 2**63 - 1, 2**64 - 1)
TEXTS = (b"-1", b"nan", b"inf", b"1e999", b"99999999999999999999", b"1e-320", b"x", b"", b"0x10", b"1 2")

# How a file is changed, where (more often near its beginning), and with what: a number, or all of the new content.
Change = tuple[str, float, int | bytes]
changes: st.SearchStrategy[list[Change]] = st.lists(
    st.tuples(
        st.sampled_from(["flip", "cut", "number", "u4", "u8", "f4", "insert", "repeat", "zero"]),
        st.floats(0.0, 1.0, exclude_max=True),
        st.one_of(st.sampled_from(NUMBERS), st.integers(0, 2**64 - 1)),
    ),
    min_size=1,
    max_size=4,
)


def changed(content: bytes, changes: list[Change]) -> bytes:
    for how, share, value in changes:
        at = int(share * share * len(content))
        if isinstance(value, bytes):
            content = value
        elif how == "cut":
            content = content[:at]
        elif how == "number":
            content = _with_number(content, share, value)
        elif how == "insert":
            content = content[:at] + value.to_bytes(8, "little") + content[at:]
        elif how == "repeat":
            content = content[: at + 1 + value % 4096] + content[at:]
        else:
            new = _new_bytes(how, value, content[at : at + 1])
            content = content[:at] + new + content[at + len(new) :]
    return content


def seed(content: str | bytes) -> list[Change]:
    """Content that was once a fault, for `example`."""
    return [("all", 0.0, content if isinstance(content, bytes) else content.encode())]


def _new_bytes(how: str, value: int, old: bytes) -> bytes:
    if how == "flip":
        return bytes(byte ^ (1 + value % 255) for byte in old)
    if how == "f4":
        return struct.pack("<f", (np.nan, np.inf, -1e38, 1e7, 1e-40)[value % 5])
    if how == "zero":
        return bytes(value % 512)
    return struct.pack("<Q", value)[: int(how[1])]


def _with_number(content: bytes, share: float, value: int) -> bytes:
    """With another number in place of one of those that are written as text."""
    found = list(re.finditer(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?", content[:8192]))
    if not found:
        return content
    begin, end = found[int(share * len(found))].span()
    return content[:begin] + (*TEXTS, str(value).encode())[value % (len(TEXTS) + 1)] + content[end:]


@pytest.fixture(scope="session")
def simulated(room, drive) -> list[SimulatedScan]:
    """Four sweeps of 1 125 points, stamped at their start."""
    scans = []
    for stamp in (0.1, 0.2, 0.3, 0.4):
        scan = room.sweep(drive, stamp, stamp_at=0.0)
        scan = scan.select(np.arange(0, len(scan), 8))
        scans.append(SimulatedScan(scan, np.full(len(scan), 7.0, dtype=np.float32)))
    return scans


def write_capture(folder: Path, scans: list[SimulatedScan], rig: Rig) -> None:
    """A third of a second of a VLP-16 that sees 5 m everywhere."""
    folder.mkdir()
    seconds, payloads = 24 * 55.296e-6 * np.arange(260), []
    for second in seconds:
        blocks = [
            struct.pack("<HH", 0xEEFF, round(36000 * (10 * second + block * 0.0011)) % 36000)
            + struct.pack("<HB", 2500 + 40 * block, 9) * 32
            for block in range(12)
        ]
        payloads.append(b"".join(blocks) + struct.pack("<IBB", round(1e6 * (123.25 + second)), 0x37, 0x22))
    write_pcap(folder / "drive.pcap", payloads, 1_700_000_123.25 + seconds)


def write_npy(folder: Path, scans: list[SimulatedScan], rig: Rig) -> None:
    stamps = np.array([simulated.scan.stamp for simulated in scans])
    truth = Trajectory(stamps, rig.T_world_lidar_at(stamps))
    write_recording(folder, [simulated.scan for simulated in scans], truth, is_timed=True)


# The writer, the source within its folder, and the files of it that are damaged.
RECORDINGS: dict[str, tuple[Callable[..., None], str, tuple[str, ...]]] = {
    "kitti": (write_kitti, ".", ("**/000001.bin", "**/times.txt", "**/calib.txt", "poses/*.txt")),
    "ply": (write_ply_scans, ".", ("*1.ply", "timestamps.txt", "imu.csv")),
    "npy": (write_npy, ".", ("*1.npy", "timestamps.txt", "ground_truth.tum")),
    "rosbag1": (FORMATS["rosbag1"].write, ".", ("*.bag",)),
    "rosbag2": (FORMATS["rosbag2"].write, ".", ("*.db3", "metadata.yaml")),
    "mcap": (FORMATS["mcap"].write, ".", ("*.mcap", "metadata.yaml")),
    "pcap": (write_capture, "drive.pcap", ("drive.pcap",)),
}


@pytest.fixture(scope="session")
def recordings(tmp_path_factory, simulated, drive) -> Path:
    """A folder with a folder of each kind."""
    root = tmp_path_factory.mktemp("whole")
    times = np.arange(0.0, 0.6, 0.01)
    imu = ImuSamples(times, np.tile([0.0, 0.0, 0.3], (len(times), 1)), np.tile([0.0, 0.0, 9.81], (len(times), 1)))
    for name, (write, _, _) in RECORDINGS.items():
        write(root / name, simulated, Rig("velodyne", 0.1, drive, imu))
    return root


def listing(folder: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
        if not path.is_relative_to(folder / "out")
    }


@contextlib.contextmanager
def nothing_else_changes(root: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whatever is called changes nothing in a folder but its `out`, and takes little memory."""
    (root / "here").mkdir(exist_ok=True)
    monkeypatch.chdir(root / "here")
    before, memory_kb = listing(root), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert listing(root) == before
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_kb < MOST_MEMORY_KB
    monkeypatch.undo()


def damage(folder: Path, patterns: tuple[str, ...], which: float, made: list[Change]) -> None:
    pattern = patterns[int(which * len(patterns))]
    files = sorted(path for path in folder.glob(pattern) if path.is_file())
    path = files[int(which * len(patterns) % 1.0 * len(files))]
    path.write_bytes(changed(path.read_bytes(), made))


DEEP = "[" * 100_000
# Faults of earlier days: the pattern of the file, as a share of them, and its content.
SEEDS: dict[str, list[tuple[float, list[Change]]]] = {
    "ply": [(0.4, seed("1e999\n" * 4))],
    "npy": [(0.4, seed(b"\xff" * 64))],
    "rosbag2": [(0.6, seed(DEEP)), (0.6, seed("rosbag2_bagfile_information: &a [*a]\n"))],
    "kitti": [(0.3, seed("nan\n" * 4))],
}


@pytest.mark.parametrize("kind", RECORDINGS)
def test_a_damaged_recording(tmp_path, recordings, monkeypatch, kind):
    if kind == "pcap":
        pytest.importorskip("velodyne_decoder", reason="needs the extra velodyne")
    _, source, patterns = RECORDINGS[kind]

    def check(which: float, made: list[Change]) -> None:
        folder = tmp_path / kind
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(recordings / kind, folder)
        damage(folder, patterns, which, made)
        with nothing_else_changes(tmp_path, monkeypatch):
            ends_well("info", folder / source)
            ends_well("run", folder / source, "--out", tmp_path / "out", "--overwrite", *FAST)

    for which, made in SEEDS.get(kind, []):
        check = example(which, made)(check)
    fuzzed(given(st.floats(0.0, 1.0, exclude_max=True), changes)(check))()


@pytest.fixture(scope="session")
def reference_maps(tmp_path_factory: pytest.TempPathFactory, whole_run: Path) -> Path:
    """The map of the run in each format of surveyors, by one point in eight."""
    folder = tmp_path_factory.mktemp("references")
    cloud = load_map(whole_run)
    cloud = PointCloud(cloud.points[::8], cloud.normals[::8])
    for name in ("map.ply", "map.pcd", "map.laz"):
        write_cloud(folder / name, cloud)
    laspy.read(folder / "map.laz").write(str(folder / "map.las"))
    return folder


@pytest.mark.parametrize("name", ["map.las", "map.laz", "map.ply", "map.pcd"])
def test_a_damaged_reference_map(tmp_path, whole_run, reference_maps, monkeypatch, name):
    @fuzzed
    @given(changes)
    def check(made: list[Change]) -> None:
        shutil.copytree(whole_run, tmp_path / "out", dirs_exist_ok=True)
        (tmp_path / name).write_bytes(changed((reference_maps / name).read_bytes(), made))
        with nothing_else_changes(tmp_path, monkeypatch):
            ends_well("evaluate", tmp_path / "out", "--reference-map", tmp_path / name)

    check()


def keys(settings: dict[str, object], prefix: str = "") -> Iterator[str]:
    for name, value in settings.items():
        yield f"{prefix}{name}"
        if isinstance(value, dict):
            yield from keys(value, f"{prefix}{name}.")


ODD = [*NUMBERS, "null", "true", "off", "[]", "{}", "[1, 2, 3]", "1e-9", "1e9", ".inf", "-0.0", "''", "~"]
values = st.one_of(st.sampled_from(ODD), st.integers(), st.floats(), st.text(max_size=20))


@fuzzed
@given(st.lists(st.tuples(st.sampled_from(list(keys(Config().model_dump()))), values), min_size=1, max_size=4))
def test_settings_of_any_value(chosen):
    ends_well("config", *(word for key, value in chosen for word in ("--set", f"{key}={value}")))


@fuzzed
@given(changes)
@example(seed(DEEP))
@example(seed("a: &a [*a, *a]\n"))
def test_a_damaged_configuration(tmp_path, made):
    (tmp_path / "config.yaml").write_bytes(changed(dump_yaml(Config()).encode(), made))
    ends_well("config", "--config", tmp_path / "config.yaml")


SCRIPT = Path(__file__).parents[2] / "benchmarks" / "fuzz_decoders.py"
DECODERS = ("ply", "pcd", "npy", "mcap", "bag", "db3", "message", "tum", "yaml", "summary", "about")


@pytest.mark.parametrize("decoder", DECODERS)
def test_no_input_of_a_decoder_ends_otherwise(decoder):
    pytest.importorskip("atheris", reason="needs the extra fuzz")
    command = [sys.executable, str(SCRIPT), decoder, "--runs", "2000", "--seconds", "60"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert "DONE" in ended.stderr
