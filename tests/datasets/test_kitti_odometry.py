"""The KITTI odometry reader on little recordings in the published layout, and on a real one."""

from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp, inverse
from lidarslam.core.trajectory import format_kitti
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import choose_reader, open_recording

# The camera looks along the LiDAR's x: x_cam = -y, y_cam = -z, z_cam = x, a little tilted, and moved.
AXES = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
T_CAM_LIDAR = AXES @ exp([0.01, -0.02, 0.015, 0.1, -0.05, -0.3])


def _truth(count: int) -> np.ndarray:
    return np.stack([exp([0.01 * i, -0.004 * i, 0.03 * i, 1.1 * i, 0.1 * i, 0.02 * i]) for i in range(count)])


def write_sequence(
    root: Path, rng: np.random.Generator, name: str = "04", numbers=range(6), rows: int = 6, poses: int = 6
) -> list[np.ndarray]:
    folder = root / "sequences" / name
    (folder / "velodyne").mkdir(parents=True)
    clouds = []
    for number in numbers:
        cloud = rng.uniform(1.0, 30.0, size=(50 + number, 4)).astype(np.float32)
        cloud.tofile(folder / "velodyne" / f"{number:06d}.bin")
        clouds.append(cloud)
    (folder / "times.txt").write_text("".join(f"{0.1037 * row:.6e}\n" for row in range(rows)))
    line = " ".join(f"{value:.12e}" for value in T_CAM_LIDAR[:3].reshape(-1))
    (folder / "calib.txt").write_text(f"P0: {'0.0 ' * 12}\nTr: {line}\n")
    T_cam0_cam = T_CAM_LIDAR @ _truth(poses) @ inverse(T_CAM_LIDAR)
    (root / "poses").mkdir(exist_ok=True)
    (root / "poses" / f"{name}.txt").write_text(format_kitti(T_cam0_cam))
    return clouds


@pytest.fixture
def sequence(tmp_path, rng) -> Path:
    write_sequence(tmp_path, rng)
    return tmp_path / "sequences" / "04"


def test_reads_scans_stamps_and_truth_in_the_lidar_frame(tmp_path, rng, uncorrected):
    clouds = write_sequence(tmp_path, rng)
    assert choose_reader(tmp_path) == "kitti-odometry"
    recording = open_recording(tmp_path)
    scans = list(recording.scans())
    assert (recording.name, len(recording)) == ("kitti_04", 6)
    for row, (scan, cloud) in enumerate(zip(scans, clouds, strict=True)):
        np.testing.assert_array_equal(scan.points, cloud[:, :3])
        np.testing.assert_array_equal(scan.intensities, cloud[:, 3])
        assert scan.stamp == pytest.approx(0.1037 * row, abs=1e-6)
        assert scan.time_offsets is None
    np.testing.assert_allclose(recording.T_cam_lidar, T_CAM_LIDAR, atol=1e-11)
    np.testing.assert_allclose(recording.ground_truth.T_world_lidar, _truth(6), atol=1e-8)
    np.testing.assert_allclose(recording.ground_truth.stamps, [scan.stamp for scan in scans], atol=0.0)


def test_poses_beside_a_linked_sequence_are_found(tmp_path, rng, uncorrected):
    write_sequence(tmp_path / "kitti", rng)
    (tmp_path / "kitti/sequences/04").rename(tmp_path / "elsewhere")
    (tmp_path / "kitti/sequences/04").symlink_to(tmp_path / "elsewhere")
    recording = open_recording(tmp_path / "kitti/sequences/04")
    np.testing.assert_allclose(recording.ground_truth.T_world_lidar, _truth(6), atol=1e-8)


def test_a_single_sequence_folder_reads_the_same(tmp_path, sequence, monkeypatch):
    monkeypatch.chdir(sequence)
    whole = open_recording(tmp_path)
    for recording in (open_recording(sequence), open_recording(Path())):
        np.testing.assert_array_equal(next(recording.scans(2)).points, next(whole.scans(2)).points)
        np.testing.assert_allclose(recording.ground_truth.T_world_lidar, _truth(6), atol=1e-8)
        assert recording.name == "kitti_04"


def test_gaps_in_the_numbers_keep_stamps_and_truth_in_step(tmp_path, rng, uncorrected):
    clouds = write_sequence(tmp_path, rng, numbers=(1, 2, 4), rows=9, poses=7)
    recording = open_recording(tmp_path)
    scans = list(recording.scans())
    np.testing.assert_allclose([scan.stamp for scan in scans], [0.1037, 0.2074, 0.4148], atol=1e-6)
    np.testing.assert_array_equal(scans[2].points, clouds[2][:, :3])
    assert len(recording.ground_truth) == 7
    np.testing.assert_allclose(recording.ground_truth.at(np.array([scans[2].stamp]))[0], _truth(7)[4], atol=1e-8)
    assert any("only 3" in note for note in recording.describe().notes)


def test_the_correction_raises_every_point(sequence):
    recording, plain = open_recording(sequence), open_recording(sequence, ReaderConfig(elevation_correction_deg=0.0))
    points = [next(each.scans()).points for each in (plain, recording)]
    elevation = [np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in points]
    np.testing.assert_allclose(np.rad2deg(elevation[1] - elevation[0]), 0.205, atol=1e-9)
    assert any("0.205" in note for note in recording.describe().notes)


def test_points_of_another_layout_are_refused_by_their_values_and_names_that_are_no_numbers(sequence):
    azimuth = np.linspace(-np.pi, np.pi, 500)
    room = np.column_stack([8.3 * np.cos(azimuth), 6.1 * np.sin(azimuth), np.full(500, -1.7), np.full(500, 0.5)])
    room.tofile(min(sequence.rglob("*.bin")))
    with pytest.raises(InputError, match="by its values they have 32 bytes"):
        open_recording(sequence)
    (sequence / "velodyne" / "last.bin").write_bytes(b"")
    with pytest.raises(InputError, match=r"last\.bin: expected a name that is the scan's number"):
        open_recording(sequence)


@pytest.mark.parametrize(("chosen", "rows"), [((1, 100, 2), [1, 3, 5]), ((2, 4), [2, 3]), ((9,), [])])
def test_scans_follow_range(sequence, chosen, rows):
    assert [round(scan.stamp / 0.1037) for scan in open_recording(sequence).scans(*chosen)] == rows


@pytest.mark.parametrize("wrong", [(0, None, 0), (-1,), (0, -2), (5, 0, -1)])
def test_scans_are_not_counted_from_the_end(sequence, wrong):
    with pytest.raises(InputError, match="step >= 1"):
        open_recording(sequence).scans(*wrong)


def test_the_sequence_must_be_chosen_among_several(tmp_path, rng):
    for name in ("03", "07"):
        write_sequence(tmp_path, rng, name)
    (tmp_path / "sequences" / "11").mkdir()  # no scans: not available
    with pytest.raises(InputError, match="holds 2 sequences; choose one with --sequence: 03, 07"):
        open_recording(tmp_path)
    with pytest.raises(InputError, match=r"there are: 03, 07$"):
        open_recording(tmp_path, ReaderConfig(sequence="11"))
    for wanted in ("07", "7"):
        assert open_recording(tmp_path, ReaderConfig(sequence=wanted)).name == "kitti_07"
    with pytest.raises(InputError, match="is the sequence 03, not 07"):
        open_recording(tmp_path / "sequences" / "03", ReaderConfig(sequence="07"))


def test_without_times_the_rate_gives_the_stamps_of_scans_and_truth(tmp_path, rng):
    write_sequence(tmp_path, rng, numbers=(0, 1, 3))
    (tmp_path / "sequences" / "04" / "times.txt").unlink()
    recording = open_recording(tmp_path, ReaderConfig(rate_hz=20.0))
    np.testing.assert_allclose([scan.stamp for scan in recording.scans()], [0.0, 0.05, 0.15])
    np.testing.assert_allclose(recording.ground_truth.stamps, np.arange(6) / 20.0)
    assert any("20 scans a second" in note for note in recording.describe().notes)


@pytest.mark.parametrize("absent", ["calib.txt", "../../poses/04.txt"])
def test_without_calibration_or_poses_there_is_no_truth(sequence, absent):
    (sequence / absent).unlink()
    recording = open_recording(sequence)
    assert (recording.T_cam_lidar is None) == (absent == "calib.txt")
    assert recording.ground_truth is recording.describe().ground_truth is None
    assert any("calib.txt" in note for note in recording.describe().notes) == (absent == "calib.txt")


def test_a_line_that_is_no_stamp_is_an_error(sequence):
    (sequence / "times.txt").write_text("0.0\n0.1\nlater\n0.3\n0.4\n0.5\n")
    with pytest.raises(InputError, match="'later' at line 3"):
        open_recording(sequence)


def test_missing_and_repeated_stamps_follow_from_the_others_and_are_told_once(sequence):
    (sequence / "times.txt").write_text("0.0\n0.1\n0.1\n0.3\n")
    recording = open_recording(sequence)
    assert [scan.stamp for scan in recording.scans()] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    (warning,) = [line for line in recording.warnings if "times.txt" in line]
    assert "3 stamps of times.txt interpolated" in warning


@pytest.mark.parametrize("line", ["Tr: 1 2 3", "P0: 1", "Tr: 1 0 0 0 0 2 0 0 0 0 1 0", "Tr: 1 0 0 0 0 1 0 0 0 0 -1 0"])
def test_a_damaged_calibration_is_an_error(sequence, line):
    (sequence / "calib.txt").write_text(line)
    with pytest.raises(InputError, match=r"calib\.txt"):
        _ = open_recording(sequence).ground_truth
