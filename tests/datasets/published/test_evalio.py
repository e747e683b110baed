"""evalio's own readers over bags, binary scans and truth written in the layouts of some of its data sets."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

import lidarslam
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp, inverse, log, make_transform
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.registry import choose_reader, is_recording, open_recording

from ...conftest import succeeds

START_NS = 1_640_000_000 * 10**9
PERIOD_NS, IMU_PERIOD_NS = 10**8, 2_500_000
# The published calibration of Hilti 2022.
HILTI_T_IMU_LIDAR = make_transform(Rotation.from_quat([1.0, -1.0, 0.0, 0.0]).as_matrix(), [-0.001, -0.00855, 0.055])
TRUTH = exp([0.1, 0.2, 0.3, 4.0, 5.0, 6.0])
SPIRES_BAG = "1710406700_2024-03-14-08-58-21_0_blurred_filtered_compressed"


def _T_world_imu(seconds: ArrayLike) -> np.ndarray:
    return exp([0.1, -0.2, 0.4, 3.0, 2.0, 1.0]) @ exp(np.multiply.outer(seconds, [0.2, -0.1, 0.5, 1.0, 0.3, -0.1]))


def _imu_messages(kit: Any, samples: int) -> tuple[list[tuple[int, Any]], np.ndarray]:
    """Messages, and their content (N, 6): angular velocity, acceleration."""
    content = np.random.default_rng(3).normal(size=(samples, 6))
    stamps = [START_NS + index * IMU_PERIOD_NS for index in range(samples)]
    return [(ns, kit.imu(ns, "imu", row[:3], row[3:])) for ns, row in zip(stamps, content, strict=True)], content


def _one_scan(kit: Any, sweep: Any, lidar: str, imu: str) -> dict[str, list[tuple[int, Any]]]:
    return {lidar: [(START_NS, kit.cloud(sweep.records, START_NS))], imu: _imu_messages(kit, 3)[0]}


def _quaternion(T: np.ndarray) -> str:
    return " ".join(f"{value:.9f}" for value in Rotation.from_matrix(T[:3, :3]).as_quat())


@pytest.fixture
def evalio_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("evalio")
    monkeypatch.setenv("EVALIO_DATA", str(tmp_path / "published"))
    return tmp_path / "published"


@pytest.fixture
def make_sequence(evalio_data: Path, make_bag_kit: Callable[[str], Any]) -> Callable[..., tuple[Path, Any]]:
    """The folder DATASET/SEQUENCE, and a kit that writes bags to it."""

    def make(name: str, kind: str = "bag") -> tuple[Path, Any]:
        kit = make_bag_kit(kind)
        kit.folder = evalio_data / name
        kit.folder.mkdir(parents=True)
        return kit.folder, kit

    return make


@pytest.fixture
def hilti(make_sequence: Callable[..., tuple[Path, Any]], make_sweep: Callable[..., Any]) -> SimpleNamespace:
    """Three scans of basement_2; its columns hold the returns alone, in the order of firing."""
    folder, kit = make_sequence("hilti_2022/basement_2")
    sweeps, clouds = [], []
    for index in range(3):
        stamp = START_NS + index * PERIOD_NS
        sweep = make_sweep("hesai", stamp, height=32, width=40)
        sweeps.append(sweep)
        clouds.append((stamp + PERIOD_NS, kit.cloud(sweep.records.T.copy().reshape(1, -1), stamp)))
    imu, content = _imu_messages(kit, 100)
    kit.write({"/hesai/pandar": clouds, "/alphasense/imu": imu}, name="exp14_basement_2")
    times = 0.05 * np.arange(8)
    rows = [(START_NS * 1e-9 + time, _T_world_imu(time)) for time in times]
    text = "".join(f"{t:.6f} {' '.join(map(repr, T[:3, 3].tolist()))} {_quaternion(T)}\n" for t, T in rows)
    (folder / "exp14_basement_2_imu.txt").write_text(text)
    return SimpleNamespace(folder=folder, sweeps=sweeps, imu=content, times=times)


def test_scans_have_their_points_times_rings_and_intensities(hilti: SimpleNamespace) -> None:
    recording = open_recording(Path("evalio:hilti_2022/basement_2"))
    assert recording.name == "hilti_2022_basement_2"
    scans = list(recording.scans())
    stamps = [scan.stamp for scan in scans]
    assert stamps == pytest.approx([START_NS * 1e-9 + 0.1 * index for index in range(3)])
    for scan, sweep in zip(scans, hilti.sweeps, strict=True):
        order, expected = np.lexsort(scan.points.T), np.lexsort(sweep.points.T)
        np.testing.assert_allclose(scan.points[order], sweep.points[expected], atol=1e-6)
        np.testing.assert_array_equal(scan.rings[order], sweep.rings[expected])
        np.testing.assert_allclose(scan.time_offsets[order], sweep.offsets[expected], atol=1e-6)
        np.testing.assert_allclose(scan.intensities[order], sweep.records["intensity"].reshape(-1)[expected])
    for chosen in ((1, None, 1), (0, 9, 2), (3, None, 1)):
        assert [scan.stamp for scan in recording.scans(*chosen)] == stamps[slice(*chosen)]


def test_truth_and_imu_come_with_their_calibration(hilti: SimpleNamespace) -> None:
    recording = open_recording(hilti.folder)
    truth, imu = recording.ground_truth, recording.imu
    assert truth.stamps - START_NS * 1e-9 == pytest.approx(hilti.times, abs=1e-6)
    expected = _T_world_imu(hilti.times) @ HILTI_T_IMU_LIDAR
    assert log(inverse(expected) @ truth.T_world_lidar) == pytest.approx(0.0, abs=1e-6)
    assert imu.stamps == pytest.approx(START_NS * 1e-9 + 0.0025 * np.arange(100), abs=1e-6)
    np.testing.assert_allclose(np.hstack([imu.angular_velocities, imu.accelerations]), hilti.imu)
    np.testing.assert_allclose(imu.T_lidar_imu @ HILTI_T_IMU_LIDAR, np.eye(4), atol=1e-6)


def test_info_and_python_know_the_name_of_a_sequence_in_the_default_place(hilti, tmp_path, monkeypatch) -> None:
    monkeypatch.delenv("EVALIO_DATA")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "published").rename("evalio_data")
    known = json.loads(succeeds("info", "evalio:hilti_2022/basement_2", "--json"))
    source = tmp_path / "evalio_data" / "hilti_2022" / "basement_2"
    assert (known["reader"], known["scans"], known["source"]) == ("evalio", 3, str(source))
    assert known["first_scan"]["has_rings"]
    assert known["point_time"]["last_s"] == pytest.approx(0.1, abs=1e-3)
    recording = lidarslam.open("evalio:hilti_2022/basement_2", stop=2)
    assert len(list(recording)) == len(recording) == 2
    assert recording.ground_truth is not None


def test_newer_college_2021(make_sequence: Any, make_sweep: Callable[..., Any]) -> None:
    """Organised clouds with holes; the truth is of a frame of its own, in a table with seconds and nanoseconds."""
    folder, kit = make_sequence("newer_college_2021/stairs")
    sweep = make_sweep("ouster", START_NS, height=16, width=50, holes=True)
    sweep.records["x"][~np.isfinite(sweep.records["x"])] = 0.0  # the driver marks no return by zeros
    for axis in "yz":
        sweep.records[axis][sweep.records["x"] == 0.0] = 0.0
    messages = _one_scan(kit, sweep, "/os_cloud_node/points", "/os_cloud_node/imu")
    kit.write(messages, name="2021-07-01-10-40-50_0-stairs")
    values = ",".join([*map(repr, TRUTH[:3, 3].tolist()), *_quaternion(TRUTH).split()])
    (folder / "gt-nc-stairs.csv").write_text(f"#sec,nsec,x,y,z,qx,qy,qz,qw\n1640000000,500000000,{values}\n")

    recording = open_recording(folder)
    (scan,) = recording.scans()
    np.testing.assert_allclose(scan.points, sweep.points[sweep.returns], atol=1e-6)
    np.testing.assert_array_equal(scan.rings, sweep.rings[sweep.returns])
    np.testing.assert_allclose(scan.time_offsets, sweep.offsets[sweep.returns], atol=1e-9)
    # Published positions of the LiDAR and of the truth's frame in that of the IMU, turned alike.
    shift = np.subtract([0.013801, -0.012207, -0.01514], [0.013642, -0.011607, -0.10583])
    R = Rotation.from_quat([0.0032925, -0.004627, -0.0024302, 0.99998]).as_matrix()
    T_truth_lidar = make_transform(np.eye(3), R.T @ shift)
    assert recording.ground_truth.stamps == pytest.approx([1640000000.5])
    np.testing.assert_allclose(recording.ground_truth.T_world_lidar[0], TRUTH @ T_truth_lidar, atol=1e-5)


def test_enwide_has_true_positions_alone_and_there_may_be_no_truth_and_no_times(make_sequence, make_sweep, monkeypatch):
    folder, kit = make_sequence("enwide/field_d")
    sweep = make_sweep("ouster", START_NS, height=16, width=50)
    sweep.records["t"] = 0
    kit.write(_one_scan(kit, sweep, "/ouster/points", "/ouster/imu"), name="2023-08-09-19-25-45-field_d")
    (folder / "gt-field_d.csv").write_text("".join(f"{1640000000 + k}.0 {k} 0 0 0 0 0 1\n" for k in range(3)))
    recording = open_recording(folder)
    (scan,) = recording.scans()
    np.testing.assert_allclose(scan.points, sweep.points, atol=1e-6)
    assert scan.time_offsets is None
    assert recording.ground_truth.length_m == pytest.approx(2.0)
    assert "The truth has positions alone" in recording.describe().notes[-1]
    monkeypatch.setattr("evalio.datasets.EnWide.ground_truth", lambda _: None)
    assert open_recording(folder).ground_truth is None


def test_mcd_stamps_the_end_of_a_sweep(make_sequence: Any, make_sweep: Callable[..., Any]) -> None:
    """The LiDAR and the IMU are in a bag each."""
    folder, kit = make_sequence("multi_campus/ntu_day_01")
    sweep = make_sweep("ouster", START_NS, height=16, width=50)
    clouds = [(START_NS, kit.cloud(sweep.records, START_NS + PERIOD_NS))]
    imu, content = _imu_messages(kit, 3)
    kit.write({"/os_cloud_node/points": clouds}, name="ntu_day_01_os1_128")
    kit.write({"/vn100/imu": imu}, name="ntu_day_01_vn100")
    rows = "".join(f"{k},{1640000000 + k}.0,{k},0,0,0,0,0,1\n" for k in range(3))
    (folder / "pose_inW.csv").write_text(f"num,t,x,y,z,qx,qy,qz,qw\n{rows}")
    recording = open_recording(folder)
    (scan,) = recording.scans()
    assert scan.stamp == pytest.approx(START_NS * 1e-9, abs=1e-6)
    np.testing.assert_allclose(scan.time_offsets, sweep.offsets, atol=1e-9)
    np.testing.assert_allclose(recording.imu.accelerations, content[:, 3:])
    assert recording.ground_truth.length_m == pytest.approx(2.0)


def test_oxford_spires(make_sequence: Any, make_sweep: Callable[..., Any]) -> None:
    """A rosbag2, which the reader of bags would take too."""
    folder, kit = make_sequence("oxford_spires/blenheim_palace_01", "db3")
    sweep = make_sweep("hesai", START_NS, height=64, width=10)
    imu, _ = _imu_messages(kit, 5)
    clouds = [(START_NS, kit.cloud(sweep.records.T.copy().reshape(1, -1), START_NS))]
    written = kit.write({"/hesai/pandar": clouds, "/alphasense_driver_ros/imu": imu}, name=SPIRES_BAG)
    for file in written.iterdir():
        file.rename(folder / file.name)
    rows = [f"{1640000000 + 0.1 * index:.3f} {index} 0 0 0 0 0 1\n" for index in range(3)]
    (folder / "gt-tum.txt").write_text("# timestamp x y z qx qy qz qw\n" + "".join(rows))

    assert choose_reader(folder) == "evalio"
    recording = open_recording(folder)
    assert [len(scan) for scan in recording.scans()] == [len(sweep.points)]
    assert recording.ground_truth.length_m == pytest.approx(1.0, abs=1e-3)  # evalio drops the first pose
    assert len(recording.imu) == 5


def test_boreas(make_sequence: Any, rng: np.random.Generator) -> None:
    """The IMU is there, without gravity, and is no IMU to us; the truth is of the car."""
    folder, _ = make_sequence("boreas/glen_2021_03_23_12_43")
    (folder / "lidar").mkdir()
    (folder / "applanix").mkdir()
    cloud = rng.uniform(1.0, 90.0, (256, 6)).astype("<f4")
    cloud[:, 4] = np.tile(np.arange(128), 2)
    cloud[:, 5] = np.repeat([0.0, 0.05], 128)
    cloud.tofile(folder / "lidar" / f"{START_NS // 1000}.bin")
    samples = "".join(f"{k}.5,0,0,0,0,0,0\n" for k in range(3))
    (folder / "applanix" / "imu_raw.csv").write_text(f"GPSTime,...\n{samples}")
    # The development kit turns by the negative angles.
    angles = -Rotation.from_matrix(TRUTH[:3, :3]).as_euler("XYZ")
    numbers = ",".join(map(repr, [*TRUTH[:3, 3].tolist(), 0.0, 0.0, 0.0, *angles.tolist()]))
    poses = "".join(f"1640000000.{place},{numbers},0,0,0\n" for place in (25, 35))
    (folder / "applanix" / "gps_post_process.csv").write_text(f"GPSTime,...\n{poses}")

    recording = open_recording(folder)
    (scan,) = recording.scans()
    order, expected = np.lexsort(scan.points.T), np.lexsort(cloud[:, :3].T)
    np.testing.assert_array_equal(scan.points[order], cloud[expected, :3])
    np.testing.assert_array_equal(scan.rings[order], cloud[expected, 4])
    np.testing.assert_allclose(scan.time_offsets[order], cloud[expected, 5], atol=1e-7)
    assert recording.imu is None
    # The published mounting of the LiDAR.
    c, s = 0.7360555651493133, 0.6769211217083996
    T_imu_lidar = make_transform([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], [0.0, 0.0, 0.13])
    expected_T = TRUTH @ T_imu_lidar
    assert log(inverse(expected_T) @ recording.ground_truth.T_world_lidar[0]) == pytest.approx(0.0, abs=1e-6)


def test_what_is_not_downloaded_names_the_command(evalio_data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is not downloaded: evalio dl hilti_2022/basement_2$"):
        open_recording(Path("evalio:hilti_2022/basement_2"))
    (evalio_data / "hilti_2022" / "basement_2").mkdir(parents=True)
    with pytest.raises(InputError, match=r"exp14_basement_2.bag is missing.*; evalio dl hilti_2022/basement_2$"):
        open_recording(Path("evalio:hilti_2022/basement_2"))
    with pytest.raises(InputError, match=rf"evalio -D {tmp_path} dl hilti_2022/basement_2$"):
        open_recording(tmp_path / "hilti_2022" / "basement_2")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("evalio:hilti_2022", "is no sequence of evalio; there are those of `lidarslam datasets hilti_2022`"),
        (
            "evalio:hilti_2022/exp99",
            "exp99: is no sequence of evalio; there are those of `lidarslam datasets hilti_2022`",
        ),
        ("evalio:kitty/04", "is no sequence of evalio; there are those of `lidarslam datasets`"),
    ],
)
def test_wrong_names(evalio_data: Path, name: str, message: str) -> None:
    assert not is_recording(Path(name))
    with pytest.raises(InputError, match=message):
        open_recording(Path(name))


def test_a_folder_of_somebody_else(evalio_data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "boreas" / "scans"
    folder.mkdir(parents=True)
    np.save(folder / "0.npy", np.ones((10, 3)))
    with pytest.raises(InputError, match="is read with --reader"):
        open_recording(folder)
    assert len(open_recording(folder, ReaderConfig(name="scan-folder"))) == 1


def test_a_bag_cut_short_ends_the_scans(hilti: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    from evalio.datasets import loaders

    converted = loaders.RosbagIter._lidar_conversion

    def fail_at_the_second(self: Any, message: Any) -> Any:
        if message.header.stamp.nanosec:
            raise ValueError("cut short")
        return converted(self, message)

    monkeypatch.setattr(loaders.RosbagIter, "_lidar_conversion", fail_at_the_second)
    faults = Faults()
    recording = open_recording(hilti.folder)
    assert len(list(recording.scans(faults=faults))) == 1
    assert faults.left_out == 2
    with pytest.raises(InputError, match=r"cannot read scan 1 \(cut short\)"):
        list(recording.scans())


def test_without_evalio_the_extra_is_named(evalio_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "evalio", None)
    (evalio_data / "hilti_2022" / "basement_2").mkdir(parents=True)
    with pytest.raises(InputError, match=r"evalio is not installed.*pip install 'lidarslam\[datasets\]'"):
        open_recording(Path("evalio:hilti_2022/basement_2"))
    with pytest.raises(InputError, match=r"is not downloaded: evalio dl .*pip install 'lidarslam\[datasets\]'"):
        open_recording(Path("evalio:hilti_2022/basement_3"))
