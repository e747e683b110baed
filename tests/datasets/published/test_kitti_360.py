"""The KITTI-360 reader on little drives written in the published layout."""

import numpy as np
import pytest
from numpy.typing import ArrayLike

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, inverse, transform_points
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import choose_reader, open_recording

DRIVES = ("2013_05_28_drive_0000_sync", "2013_05_28_drive_0003_sync")
PERIOD_S, SPEED, TURN = 0.104, 9.0, 0.5
T_LIDAR_CAM = exp([1.21, -1.23, 1.2, 0.77, 0.3, -0.84])
T_POSE_CAM = exp([1.2, -1.2, 1.2, 1.57, 0.26, -0.11])
T_POSE_LIDAR = T_POSE_CAM @ inverse(T_LIDAR_CAM)
FIRST = 3  # frames before have no pose, as the car stood still


def T_world_lidar(time: ArrayLike) -> FloatArray:
    """A car on a circle to the left, far from the origin of the world."""
    return exp([0.0, 0.0, 0.0, 800.0, 3900.0, 116.0]) @ exp(np.multiply.outer(time, [0.0, 0.0, TURN, SPEED, 0.0, 0.0]))


def row(T):
    return " ".join(f"{value:.10f}" for value in T[:3].ravel())


def put_back(points: FloatArray, times: FloatArray) -> FloatArray:
    """Points (N, 3) of the LiDAR in the world, each from the pose at its own time (N,)."""
    return transform_points(T_world_lidar(times), points[:, None])[:, 0]


def _sweep(stamp: float) -> tuple[FloatArray, FloatArray]:
    """What a laser measures that turns clockwise from the rear, and where that is in the world."""
    azimuth = np.linspace(np.pi, -np.pi, 721)[:-1] - 1e-4
    points = np.column_stack([10.0 * np.cos(azimuth), 10.0 * np.sin(azimuth), np.linspace(-2.0, 2.0, 720)])
    in_world = put_back(points, stamp - PERIOD_S * azimuth / (2.0 * np.pi))
    return np.column_stack([points, np.full(720, 0.25)]).astype("<f4"), in_world


@pytest.fixture
def root(tmp_path):
    root = tmp_path / "KITTI-360"
    for name in DRIVES:
        data = root / "data_3d_raw" / name / "velodyne_points" / "data"
        data.mkdir(parents=True)
        lines = []
        for frame in range(8):
            _sweep(PERIOD_S * frame)[0].tofile(data / f"{frame:010d}.bin")
            instant = np.datetime64("2013-05-28T08:46:02.9", "ns") + np.timedelta64(round(1e9 * PERIOD_S * frame), "ns")
            lines.append(str(instant).replace("T", " "))
        (data.parent / "timestamps.txt").write_text("\n".join(lines) + "\n")
        poses = root / "data_poses" / name
        poses.mkdir(parents=True)
        rows = [f"{k} {row(T_world_lidar(PERIOD_S * k) @ inverse(T_POSE_LIDAR))}\n" for k in range(FIRST, 8)]
        (poses / "poses.txt").write_text("".join(rows))
    calibration = root / "calibration"
    calibration.mkdir()
    (calibration / "calib_cam_to_velo.txt").write_text(row(T_LIDAR_CAM) + "\n")
    (calibration / "calib_cam_to_pose.txt").write_text(f"image_00: {row(T_POSE_CAM)}\nimage_01: {row(np.eye(4))}\n")
    return root


@pytest.mark.parametrize("wanted", ["3", "0003", DRIVES[1]])
def test_the_root_and_a_drive(root, wanted):
    drive = root / "data_3d_raw" / DRIVES[1]
    assert choose_reader(root) == choose_reader(drive) == "kitti-360"
    assert open_recording(root, ReaderConfig(sequence=wanted)).name == open_recording(drive).name == DRIVES[1]


def test_truth_is_that_of_the_lidar_at_the_scans_with_a_pose(root):
    recording = open_recording(root, ReaderConfig(sequence="0"))
    truth, stamps = recording.ground_truth, [scan.stamp for scan in recording.scans()]
    np.testing.assert_allclose(np.diff(stamps), PERIOD_S, atol=1e-6)
    np.testing.assert_array_equal(truth.stamps, stamps[FIRST:])
    expected = T_world_lidar(PERIOD_S * np.arange(FIRST, 8))
    np.testing.assert_allclose(truth.T_world_lidar, inverse(expected[0]) @ expected, atol=1e-6)


def test_points_by_their_times_lie_where_they_stand(root):
    recording = open_recording(root, ReaderConfig(sequence="0"))
    scan = next(recording.scans(start=5))
    _, in_world = _sweep(PERIOD_S * 5)
    as_measured = transform_points(T_world_lidar(PERIOD_S * 5), scan.points)
    compensated = put_back(scan.points, PERIOD_S * 5 + scan.time_offsets)
    assert np.linalg.norm(compensated - in_world, axis=1).max() < 1e-4
    assert np.linalg.norm(as_measured - in_world, axis=1).max() > 0.3
    info = recording.describe()
    assert (info.point_time.field, info.imu) == ("azimuth", None)
    assert not any("sweeps" in note for note in info.notes)


def test_without_calibration_there_is_no_truth(root):
    (root / "calibration" / "calib_cam_to_pose.txt").unlink()
    recording = open_recording(root / "data_3d_raw" / DRIVES[0])
    assert recording.ground_truth is None
    assert any("no calibration folder" in note for note in recording.describe().notes)


def test_a_damaged_calibration(root):
    (root / "calibration" / "calib_cam_to_velo.txt").write_text("1 2 3\n")
    with pytest.raises(InputError, match="expected 12 numbers"):
        _ = open_recording(root / "data_3d_raw" / DRIVES[0]).ground_truth
