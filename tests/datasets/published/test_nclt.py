"""The NCLT reader on a little session written in the published layout."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import inverse, make_transform, transform_points
from lidarslam.datasets.registry import choose_reader, open_recording

FIRST_US = 1_326_030_975_726_043
PERIOD_US = 200_000
TURN, SPEED = 0.2, 1.2
# In the frame of the body: x forward, y right, z down.
LIDAR, IMU = np.array([0.002, -0.004, -0.957]), np.array([-0.11, -0.18, -0.71])
UPRIGHT = np.diag([1.0, -1.0, -1.0, 1.0])
WALL = np.random.default_rng(1).uniform([-20.0, -20.0, -4.0], [20.0, 20.0, 0.5], (500, 3))  # in the world, z down


def pose(time):
    """T_down_body of a robot that turns to its right, and its x, y, z, roll, pitch and heading."""
    heading, pitch, roll = 0.4 + TURN * time, 0.03, -0.02
    radius = SPEED / TURN
    position = [radius * np.sin(heading), radius * (1.0 - np.cos(heading)), -0.1]
    T = make_transform(Rotation.from_euler("ZYX", [heading, pitch, roll]).as_matrix(), position)
    return T, [*position, roll, pitch, heading]


@pytest.fixture
def session(tmp_path):
    folder = tmp_path / "2012-01-08"
    (folder / "velodyne_sync").mkdir(parents=True)
    for k in range(5):
        T_down_body, _ = pose(0.2 * k)
        in_body = transform_points(inverse(T_down_body), WALL)
        points = np.zeros(len(WALL), [("steps", "<u2", 3), ("intensity", "u1"), ("ring", "u1")])
        points["steps"] = np.round((in_body + 100.0) / 0.005)  # of 5 mm from -100 m
        points["intensity"], points["ring"] = 50 + np.arange(len(WALL)) % 100, np.arange(len(WALL)) % 32
        points.tofile(folder / "velodyne_sync" / f"{FIRST_US + k * PERIOD_US}.bin")
    rows = [f"{FIRST_US + 10_000 * k}, {', '.join(repr(float(v)) for v in pose(0.01 * k)[1])}\n" for k in range(100)]
    unknown = f"{FIRST_US - 20_000}, nan, nan, nan, nan, nan, nan\n"
    (tmp_path / "groundtruth_2012-01-08.csv").write_text("".join([unknown, *rows]))
    sample = f"0.1,0.2,0.3,0.05,0.24,-9.80,0.001,0.002,{TURN}\n"
    (folder / "ms25.csv").write_text("".join(f"{FIRST_US + 20_000 * k},{sample}" for k in range(60)))
    return folder


def test_scans_by_the_truth_lie_on_the_wall(session):
    assert choose_reader(session) == "nclt"
    recording = open_recording(session)
    truth = recording.ground_truth
    assert len(truth) == 100
    wall = transform_points(UPRIGHT, WALL)
    for k, scan in enumerate(recording.scans()):
        assert scan.stamp == (FIRST_US + k * PERIOD_US) / 10**6
        assert scan.time_offsets is None
        np.testing.assert_array_equal(scan.rings, np.arange(len(WALL)) % 32)
        np.testing.assert_array_equal(scan.intensities, 50 + np.arange(len(WALL)) % 100)
        T_world_lidar = truth.at(np.array([scan.stamp]))[0]
        assert np.abs(transform_points(T_world_lidar, scan.points) - wall).max() < 0.005


def test_the_lidar_is_upright_and_at_its_own_centre(session):
    """The ray's origin is the sensor, 96 cm above the body's origin."""
    truth = open_recording(session).ground_truth
    T_down_body, _ = pose(0.0)
    origin = transform_points(T_down_body, LIDAR[None])[0]
    np.testing.assert_allclose(truth.T_world_lidar[0, :3, 3], origin * [1.0, -1.0, -1.0], atol=1e-9)
    assert truth.T_world_lidar[0, 2, 2] > 0.99
    # It turns to the right: negative about an axis that points up.
    assert np.arctan2(*truth.relative_motions()[0, [1, 0], 0]) == pytest.approx(-0.01 * TURN, rel=1e-2)


def test_imu(session):
    imu = open_recording(session).imu
    assert len(imu) == 60
    np.testing.assert_allclose(imu.angular_velocities[3], [0.001, 0.002, TURN])
    in_lidar = imu.T_lidar_imu[:3, :3] @ imu.accelerations[3]
    np.testing.assert_allclose(in_lidar, [0.05, -0.24, 9.80])
    np.testing.assert_allclose(imu.T_lidar_imu[:3, 3], (IMU - LIDAR) * [1.0, -1.0, -1.0])
    assert open_recording(session).describe().imu.has_extrinsic


@pytest.mark.parametrize("place", [".", "..", "../ground_truth"])
def test_places_of_the_truth(session, place):
    (session / place).mkdir(exist_ok=True)
    (session.parent / "groundtruth_2012-01-08.csv").rename(session / place / "groundtruth_2012-01-08.csv")
    assert len(open_recording(session).ground_truth) == 100


def test_a_cut_scan_and_no_truth(session):
    (session.parent / "groundtruth_2012-01-08.csv").unlink()
    (session / "ms25.csv").unlink()
    first = session / "velodyne_sync" / f"{FIRST_US}.bin"
    first.write_bytes(first.read_bytes()[:-3])
    recording = open_recording(session)
    assert (recording.ground_truth, recording.imu) == (None, None)
    with pytest.raises(InputError, match="points of 8 bytes"):
        next(recording.scans())
