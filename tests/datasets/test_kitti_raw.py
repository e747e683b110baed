"""The KITTI raw reader on little drives in the published layout, and on real ones."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp, inverse, is_rigid, log, make_transform
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import choose_reader, open_recording
from lidarslam.datasets.times.stamps import increasing_rows, mend_stamps

MIDNIGHT = np.datetime64("2011-09-26T13:04:32", "ns")
FIRST_STAMP = 1317042272.0  # the same instant, UTC
T_LIDAR_IMU = exp([0.01, -0.015, 0.002, -0.81, 0.32, -0.80])
T_CAM_LIDAR = make_transform([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], [0.0, -0.08, -0.27])
T_RECT_CAM = exp([0.004, -0.007, 0.01, 0.0, 0.0, 0.0])
SPEED, TURN = 8.0, 0.2  # of the simulated car: m/s, rad/s
MID_S, JITTER_S = 0.1037, 0.004


def _stamp_lines(seconds: np.ndarray) -> str:
    """Lines as KITTI writes them, nanoseconds included; NaN is a blank line."""
    lines = ["" if np.isnan(s) else str(MIDNIGHT + np.timedelta64(round(s * 1e9), "ns")) for s in seconds]
    return "\n".join(lines).replace("T", " ") + "\n"


def _T_enu_imu(time: float) -> np.ndarray:
    """A car on a circle that begins at the origin of the projection, 49 degrees north."""
    yaw = 0.3 + TURN * time
    radius = SPEED / TURN
    east, north = radius * (np.sin(yaw) - np.sin(0.3)), radius * (np.cos(0.3) - np.cos(yaw))
    position = [east, north, 112.0 + 0.1 * time]
    return make_transform(Rotation.from_euler("ZYX", [yaw, 0.02, -0.01]).as_matrix(), position)


def _oxts_line(time: float) -> str:
    T = _T_enu_imu(time)
    lat0, lon0, radius = np.deg2rad(49.0), np.deg2rad(8.4), 6378137.0
    scale = np.cos(lat0)  # the first row's latitude within 1e-8, for the car begins there
    mercator0 = scale * radius * np.log(np.tan(np.pi / 4 + lat0 / 2))
    latitude = 2 * np.arctan(np.exp((T[1, 3] + mercator0) / (scale * radius))) - np.pi / 2
    longitude = lon0 + T[0, 3] / (scale * radius)
    yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")
    values = np.zeros(30)
    values[:6] = np.rad2deg(latitude), np.rad2deg(longitude), T[2, 3], roll, pitch, yaw
    values[11:14] = Rotation.from_matrix(T[:3, :3]).inv().apply([0.0, 0.0, 9.81])
    values[12] += SPEED * TURN
    values[17:20] = T[:3, :3].T @ [0.0, 0.0, TURN]
    values[23] = 0.25
    return " ".join(repr(float(value)) for value in values)


def _calibration(T: np.ndarray) -> str:
    R, t = (" ".join(f"{v:.10e}" for v in part) for part in (T[:3, :3].reshape(-1), T[:3, 3]))
    return f"calib_time: 25-May-2012 16:47:16\nR: {R}\nT: {t}\n"


def _oxts_times(count: int) -> np.ndarray:
    rng = np.random.default_rng(7)
    return MID_S * np.arange(count) + 0.017 + rng.uniform(-JITTER_S, JITTER_S, count)


def write_drive(root: Path, rng: np.random.Generator, rows: int = 8, missing: tuple[int, ...] = ()) -> Path:
    date = root / "2011_09_26"
    drive = date / "2011_09_26_drive_0001_sync"
    data, oxts = drive / "velodyne_points" / "data", drive / "oxts" / "data"
    data.mkdir(parents=True)
    oxts.mkdir(parents=True)
    mids = MID_S * np.arange(rows)
    mids[list(missing)] = np.nan
    for row in range(rows):
        if row not in missing:
            cloud = rng.uniform(-20.0, 20.0, size=(60 + row, 4)).astype(np.float32)
            cloud.tofile(data / f"{row:010d}.bin")
        (oxts / f"{row:010d}.txt").write_text(_oxts_line(_oxts_times(rows)[row]))
    (data.parent / "timestamps.txt").write_text(_stamp_lines(mids))
    (data.parent / "timestamps_start.txt").write_text(_stamp_lines(mids - 0.050))
    (data.parent / "timestamps_end.txt").write_text(_stamp_lines(mids + 0.053))
    (oxts.parent / "timestamps.txt").write_text(_stamp_lines(_oxts_times(rows)))
    (date / "calib_imu_to_velo.txt").write_text(_calibration(T_LIDAR_IMU))
    (date / "calib_velo_to_cam.txt").write_text(_calibration(T_CAM_LIDAR))
    rectification = " ".join(f"{v:.10e}" for v in T_RECT_CAM[:3, :3].reshape(-1))
    (date / "calib_cam_to_cam.txt").write_text(f"calib_time: x\nR_rect_00: {rectification}\n")
    return drive


@pytest.fixture
def drive(tmp_path: Path, rng: np.random.Generator) -> Path:
    return write_drive(tmp_path, rng)


def test_reads_scans_at_the_mid_stamps(drive, uncorrected):
    assert choose_reader(drive) == "kitti-raw"
    recording = open_recording(drive)
    scans = list(recording.scans())
    assert recording.name == "2011_09_26_drive_0001_sync"
    assert [len(scan) for scan in scans] == [60 + row for row in range(8)]
    expected = FIRST_STAMP + MID_S * np.arange(8)
    np.testing.assert_allclose([scan.stamp for scan in scans], expected, rtol=0.0, atol=3e-7)
    stored = np.fromfile(drive / "velodyne_points" / "data" / "0000000003.bin", np.float32).reshape(-1, 4)
    np.testing.assert_array_equal(scans[3].points, stored[:, :3])
    assert recording.describe().notes[-1].endswith("0.25 m (median).")


def test_the_unit_is_an_imu(drive):
    recording = open_recording(drive)
    imu = recording.imu
    np.testing.assert_allclose(imu.stamps, FIRST_STAMP + _oxts_times(8), rtol=0.0, atol=3e-7)
    np.testing.assert_allclose(imu.T_lidar_imu, T_LIDAR_IMU, atol=1e-9)
    turning = _T_enu_imu(0.0)[:3, :3].T @ [0.0, 0.0, TURN]
    np.testing.assert_allclose(imu.angular_velocities, np.tile(turning, (8, 1)), atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(imu.accelerations, axis=1), np.hypot(9.81, SPEED * TURN), rtol=0.01)
    summary = recording.describe().imu
    assert (summary.name, summary.samples, round(summary.rate_hz), summary.has_extrinsic) == ("oxts", 8, 10, True)
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    assert open_recording(drive).imu.T_lidar_imu is None


def test_rows_of_missing_scans_are_skipped(tmp_path, rng):
    drive = write_drive(tmp_path, rng, missing=(2, 3))
    recording = open_recording(drive)
    scans = list(recording.scans())
    assert [len(scan) for scan in scans] == [60, 61, 64, 65, 66, 67]
    expected = FIRST_STAMP + MID_S * np.array([0, 1, 4, 5, 6, 7])
    np.testing.assert_allclose([scan.stamp for scan in scans], expected, rtol=0.0, atol=3e-7)
    assert len(recording.ground_truth) == 8
    assert any("0 to 7 only 6" in note for note in recording.describe().notes)


def test_a_point_has_its_own_sweeps_start_and_end(drive):
    # Sweep 2 is longer on its first half, still within what is plausible.
    stamps = MID_S * np.arange(8)
    starts = stamps - 0.050
    starts[2] = stamps[2] - 0.056
    (drive / "velodyne_points" / "timestamps_start.txt").write_text(_stamp_lines(starts))
    for row in (1, 2):
        points = [[-1.0, 1e-7, 0.0, 0.0], [0.0, 2.0, 0.5, 0.0], [0.0, -2.0, -1.0, 0.0]]
        np.array(points, np.float32).tofile(drive / "velodyne_points" / "data" / f"{row:010d}.bin")
    one, two = open_recording(drive).scans(1, 3)
    np.testing.assert_allclose(one.time_offsets, [-0.050, -0.025, 0.0265], atol=1e-6)
    np.testing.assert_allclose(two.time_offsets, [-0.056, -0.028, 0.0265], atol=1e-6)


def test_truth_is_the_lidars_pose_at_the_oxts_stamps(drive):
    recording = open_recording(drive)
    truth = recording.ground_truth
    times = _oxts_times(8)
    np.testing.assert_allclose(truth.stamps, FIRST_STAMP + times, rtol=0.0, atol=3e-7)
    T_enu_lidar = np.stack([_T_enu_imu(time) @ inverse(T_LIDAR_IMU) for time in times])
    np.testing.assert_allclose(truth.T_world_lidar, inverse(T_enu_lidar[0]) @ T_enu_lidar, atol=1e-6)
    np.testing.assert_allclose(truth.T_world_lidar[0], np.eye(4), atol=1e-12)
    # At the stamps of the scans, too, and far better than the rows taken as simultaneous with them would be.
    scan_times = MID_S * np.arange(1, 8)
    expected = np.stack([_T_enu_imu(time) @ inverse(T_LIDAR_IMU) for time in scan_times])
    at_scans = truth.at(FIRST_STAMP + scan_times)
    np.testing.assert_allclose(at_scans, inverse(T_enu_lidar[0]) @ expected, atol=1e-3)
    assert np.linalg.norm(truth.T_world_lidar[1:, :3, 3] - at_scans[:, :3, 3], axis=1).min() > 0.05


def test_truth_without_oxts_stamps_uses_those_of_the_scans(tmp_path, rng):
    drive = write_drive(tmp_path, rng, missing=(0, 3))
    (drive / "oxts" / "timestamps.txt").unlink()
    truth = open_recording(drive).ground_truth
    np.testing.assert_allclose(truth.stamps, FIRST_STAMP + MID_S * np.array([1, 2, 4, 5, 6, 7]), rtol=0.0, atol=3e-7)
    T_enu_lidar = np.stack([_T_enu_imu(time) @ inverse(T_LIDAR_IMU) for time in _oxts_times(8)[[1, 2, 4, 5, 6, 7]]])
    np.testing.assert_allclose(truth.T_world_lidar, inverse(T_enu_lidar[0]) @ T_enu_lidar, atol=1e-6)


def test_times_that_cannot_be_are_mended_or_left_out_and_told(drive):
    """A scan's stamp that repeats is interpolated, an odd start of a sweep replaced, an earlier pose left out."""
    stamps, starts, times = MID_S * np.arange(8), MID_S * np.arange(8) - 0.050, _oxts_times(8)
    stamps[5], starts[3], times[4] = stamps[4], starts[3] - 5.0, times[1]
    (drive / "velodyne_points" / "timestamps.txt").write_text(_stamp_lines(stamps))
    (drive / "velodyne_points" / "timestamps_start.txt").write_text(_stamp_lines(starts))
    (drive / "oxts" / "timestamps.txt").write_text(_stamp_lines(times))
    recording = open_recording(drive)
    scans = list(recording.scans())
    expected = FIRST_STAMP + MID_S * np.arange(8)
    np.testing.assert_allclose([scan.stamp for scan in scans], expected, rtol=0.0, atol=1e-6)
    assert all(-0.053 < scan.time_offsets.min() < -0.04 for scan in scans)
    np.testing.assert_allclose(recording.ground_truth.stamps, FIRST_STAMP + np.delete(times, 4), rtol=0.0, atol=3e-7)
    notes = recording.describe().notes
    for told in ("1 stamp of timestamps.txt", "1 start and 0 ends", "1 oxts rows"):
        assert any(told in note for note in notes)


def test_without_stamps_the_rate_gives_scans_truth_and_offsets(tmp_path, rng):
    drive = write_drive(tmp_path, rng, missing=(3,))
    for path in (drive / "velodyne_points").glob("*.txt"):
        path.unlink()
    recording = open_recording(drive, ReaderConfig(rate_hz=5.0))
    np.testing.assert_allclose([s.stamp for s in recording.scans()], 0.2 * np.array([0, 1, 2, 4, 5, 6, 7]))
    np.testing.assert_allclose(recording.ground_truth.stamps, 0.2 * np.arange(8))
    offsets = next(recording.scans()).time_offsets
    assert -0.1 <= offsets.min() < -0.08
    assert 0.08 < offsets.max() <= 0.1
    assert any("5 scans a second" in note for note in recording.describe().notes)


def test_without_starts_and_ends_sweeps_are_seamless(drive):
    for which in ("start", "end"):
        (drive / "velodyne_points" / f"timestamps_{which}.txt").unlink()
    offsets = next(open_recording(drive).scans(2)).time_offsets
    assert -MID_S / 2 <= offsets.min() < -0.045
    assert 0.045 < offsets.max() <= MID_S / 2


def test_camera_calibration_is_rectified(drive):
    np.testing.assert_allclose(open_recording(drive).T_cam_lidar, T_RECT_CAM @ T_CAM_LIDAR, atol=1e-9)
    (drive.parent / "calib_cam_to_cam.txt").unlink()
    assert open_recording(drive).T_cam_lidar is None


def test_without_calibration_or_oxts_there_is_no_truth(drive):
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    recording = open_recording(drive)
    assert recording.ground_truth is None
    assert any("calib_imu_to_velo.txt" in note for note in recording.describe().notes)
    (drive / "oxts").rename(drive / "elsewhere")
    recording = open_recording(drive)
    assert recording.ground_truth is None
    assert recording.describe().ground_truth is None


def test_damaged_and_foreign_files_are_named(tmp_path, rng):
    drive = write_drive(tmp_path / "a", rng)
    scan = drive / "velodyne_points" / "data" / "0000000001.bin"
    scan.write_bytes(scan.read_bytes() + b"1")
    with pytest.raises(InputError, match=r"0000000001\.bin: expected points"):
        list(open_recording(drive).scans())
    (drive / "oxts" / "data" / "0000000002.txt").write_text("49.0 8.4 112.0\n")
    with pytest.raises(InputError, match=r"0000000002\.txt:1: expected 30 numbers"):
        _ = open_recording(drive).ground_truth
    (drive / "oxts" / "data" / "0000000002.txt").write_text("490.0 8.4" + " 0.0" * 28 + "\n")
    with pytest.raises(InputError, match=r"0000000002\.txt: .* begins with a latitude"):
        _ = open_recording(drive).ground_truth
    (drive / "velodyne_points" / "timestamps.txt").write_text("2011-09-26 13:04:32.1\nyesterday\n")
    with pytest.raises(InputError, match="'yesterday' at line 2"):
        open_recording(drive)
    extract = tmp_path / "b" / "2011_09_26_drive_0001_extract"
    (extract / "velodyne_points" / "data").mkdir(parents=True)
    (extract / "velodyne_points" / "data" / "0000000000.txt").write_text("1 2 3 0.5\n")
    with pytest.raises(InputError, match=r"use the \.\.\._sync drive"):
        open_recording(extract)


def test_one_stray_stamp_costs_no_other():
    early, late = np.array([1.0, 2.0, 0.5, 4.0, 5.0]), np.array([1.0, 99.0, 3.0, 4.0, np.nan])
    np.testing.assert_array_equal(increasing_rows(early), [True, True, False, True, True])
    np.testing.assert_array_equal(increasing_rows(late), [True, False, True, True, False])
    for stamps in (early, late):
        mended, count = mend_stamps(stamps, np.arange(5.0))
        np.testing.assert_allclose(mended, [1.0, 2.0, 3.0, 4.0, 5.0])
        assert count == (~increasing_rows(stamps)).sum()
    with pytest.raises(ValueError, match="fewer than two"):
        mend_stamps(np.array([3.0, 2.0, 1.0]), np.arange(3.0))


@pytest.mark.real_data
@pytest.mark.parametrize(("name", "scans", "poses"), [("0005", 154, 154), ("0009", 51, 447)])
def test_real_drives(real_data, name, scans, poses):
    recording = open_recording(real_data / f"kitti_raw_{name}" / "2011_09_26" / f"2011_09_26_drive_{name}_sync")
    info = recording.describe()
    assert info.scans == scans
    assert 9.5 < info.rate_hz < 10.0
    assert -0.053 < info.first.time_offsets.min() < -0.05 < 0.05 < info.first.time_offsets.max() < 0.053
    truth = recording.ground_truth
    assert len(truth) == poses
    assert is_rigid(truth.T_world_lidar, tolerance=1e-9)
    # Along the car's own axis: the calibration and the order of the rotations are right.
    steps = truth.relative_motions()[:, :3, 3]
    assert np.abs(np.median(steps[:, 1:], axis=0)).max() < 0.02
    assert np.median(steps[:, 0]) > 0.2
    np.testing.assert_allclose(recording.T_cam_lidar[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], atol=0.03)
    # The angular velocities are those of the poses.
    imu = recording.imu
    turns = log(inverse(imu.T_lidar_imu) @ truth.relative_motions() @ imu.T_lidar_imu)[:, :3]
    measured = 0.5 * (imu.angular_velocities[1:] + imu.angular_velocities[:-1]) * np.diff(imu.stamps)[:, None]
    assert np.rad2deg(np.std(turns - measured, axis=0)).max() < 0.1  # a tenth of the turns about z
    assert np.rad2deg(np.std(turns, axis=0)[2]) > 0.5
    assert np.median(imu.accelerations[:, 2]) == pytest.approx(9.81, abs=0.2)
