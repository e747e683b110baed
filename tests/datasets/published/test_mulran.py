"""The MulRan reader on a little sequence written in the published layout."""

import numpy as np
import pytest
from numpy.typing import ArrayLike

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.registry import choose_reader, open_recording

FIRST_NS = 1_561_000_444_390_857_630
PERIOD_NS = 99_778_780
EAST, NORTH, SPEED, TURN = 353_067.5, 4_026_008.25, 9.0, 0.3  # UTM metres, m/s, rad/s
POSE_TIMES = -0.05 + 0.01 * np.arange(60)  # seconds from the first scan on

# On the roof, 1.7 m before the rear axle, facing backwards.
T_BASE_LIDAR = exp([0.0, 0.0, np.deg2rad(179.6654), 0.0, 0.0, 0.0])
T_BASE_LIDAR[:3, 3] = [1.7042, -0.021, 1.8047]


def T_utm_base(time: ArrayLike) -> FloatArray:
    """A car on a circle to the left."""
    return exp([0.0, 0.0, 0.0, EAST, NORTH, 25.5]) @ exp(np.multiply.outer(time, [0.0, 0.0, TURN, SPEED, 0.0, 0.0]))


def sweep(index):
    """Column after column of 64 lasers: range, azimuth and elevation name the column and the laser."""
    column, laser = np.divmod(np.arange(64 * 1024), 64)
    azimuth, elevation = 2.0 * np.pi * column / 1024, np.deg2rad(16.611 - 33.222 * laser / 63)
    reach, level = 5.0 + index + 0.01 * laser, np.cos(elevation)
    points = reach[:, None] * np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    points[(column + laser) % 7 == 0] = 0.0  # no return
    return np.column_stack([points, laser + 100.0]).astype("<f4")


@pytest.fixture
def sequence(tmp_path):
    folder = tmp_path / "KAIST01"
    (folder / "Ouster").mkdir(parents=True)
    stamps_ns = [FIRST_NS + k * PERIOD_NS for k in range(4)]
    for k, stamp_ns in enumerate(stamps_ns):
        sweep(k).tofile(folder / "Ouster" / f"{stamp_ns}.bin")
    (folder / "data_stamp.csv").write_text("".join(f"{stamp_ns},ouster\n" for stamp_ns in stamps_ns))
    poses = {FIRST_NS + round(1e9 * time): T_utm_base(time)[:3].ravel() for time in POSE_TIMES}
    imu = [0.0, 0.0, 0.0, 1.0, 0.1, 0.2, 0.3, 0.01, 0.02, TURN, 0.5, SPEED * TURN, 9.81, 1.0, 2.0, 3.0]
    samples = {FIRST_NS + k * 10_000_000: imu for k in range(50)}
    for name, rows in (("global_pose.csv", poses), ("xsens_imu.csv", samples)):
        lines = [f"{stamp_ns},{','.join(repr(float(v)) for v in row)}\n" for stamp_ns, row in rows.items()]
        (folder / name).write_text("".join(lines))
    return folder


def test_scans_with_columns_for_times_and_lasers_for_rings(sequence):
    assert choose_reader(sequence) == "mulran"
    recording = open_recording(sequence)
    assert (recording.name, len(recording)) == ("KAIST01", 4)
    for k, scan in enumerate(recording.scans()):
        assert scan.stamp == (FIRST_NS + k * PERIOD_NS) / 10**9
        rows = sweep(k)
        returned = rows[:, :3].any(axis=1)
        np.testing.assert_array_equal(scan.points, rows[returned, :3])
        np.testing.assert_array_equal(scan.intensities, rows[returned, 3])
        np.testing.assert_array_equal(scan.rings, scan.intensities - 100)
        azimuth = np.mod(np.arctan2(scan.points[:, 1], scan.points[:, 0]), 2.0 * np.pi)
        np.testing.assert_allclose(scan.time_offsets, 0.1 * np.mod((azimuth + 1e-4) / (2.0 * np.pi), 1.0), atol=1e-5)
    info = recording.describe()
    assert info.point_time.field == "column"
    assert any("start of its sweep" in note for note in info.notes)


def test_truth_is_that_of_the_lidar(sequence):
    truth = open_recording(sequence).ground_truth
    assert len(truth) == 60
    T_utm_lidar = T_utm_base(POSE_TIMES) @ T_BASE_LIDAR
    np.testing.assert_allclose(truth.T_world_lidar, inverse(T_utm_lidar[0]) @ T_utm_lidar, atol=1e-4)
    # The base is behind the LiDAR, which moves outwards in the bend: faster than the base by the lever arm.
    speed = truth.length_m / truth.duration_s
    assert speed == pytest.approx(np.hypot(SPEED + 0.021 * TURN, 1.7042 * TURN), rel=1e-4)
    assert open_recording(sequence).describe().ground_truth == sequence / "global_pose.csv"


@pytest.mark.parametrize("place", ["", "sensor_data"])
def test_imu(sequence, place):
    (sequence / place).mkdir(exist_ok=True)
    (sequence / "xsens_imu.csv").rename(sequence / place / "xsens_imu.csv")
    imu = open_recording(sequence).imu
    assert len(imu) == 50
    assert imu.stamps[0] == pytest.approx(FIRST_NS / 1e9, abs=1e-6)
    np.testing.assert_allclose(imu.angular_velocities[7], [0.01, 0.02, TURN])
    np.testing.assert_allclose(imu.accelerations[7], [0.5, SPEED * TURN, 9.81])
    assert imu.T_lidar_imu is None
    assert open_recording(sequence).describe().imu.rate_hz == pytest.approx(100.0, rel=1e-3)


def test_first_sequences_have_orientations_alone(sequence):
    (sequence / "xsens_imu.csv").write_text(f"{FIRST_NS},0,0,0,1,0.1,0.2,0.3\n")
    assert open_recording(sequence).imu is None


def test_a_broken_scan_has_no_times(sequence):
    broken = sequence / "Ouster" / f"{FIRST_NS + PERIOD_NS}.bin"
    broken.write_bytes(broken.read_bytes()[: 16 * 30_000])
    faults = Faults()
    scans = list(open_recording(sequence).scans(faults=faults))
    assert [scan.time_offsets is None for scan in scans] == [False, True, False, False]
    assert "1 scan" in faults.warnings()[0]


def test_without_anything_beside_the_scans(sequence):
    for name in ("global_pose.csv", "xsens_imu.csv", "data_stamp.csv"):
        (sequence / name).unlink()
    recording = open_recording(sequence, ReaderConfig(time_reference="none"))
    assert recording.ground_truth is None
    assert recording.imu is None
    assert next(recording.scans()).time_offsets is None
    (sequence / "Ouster" / "first.bin").write_bytes(b"")
    with pytest.raises(InputError, match="named by their stamps"):
        open_recording(sequence)
