"""evalio's own readers over the binary scans of HeLiPR and Boreas, written as their players and devkits read them."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import exp, inverse, log, make_transform
from lidarslam.datasets.registry import open_recording

pytest.importorskip("evalio")

START_NS = 1_689_519_000_000_000_000
OUSTER = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "intensity")),
        ("t", "<u4"),
        *((name, "<u2") for name in ("reflectivity", "ring", "ambient")),
    ]
)
T = exp([0.1, 0.2, 1.3, 40.0, 50.0, 6.0])


@pytest.mark.slow
def test_helipr(tmp_path: Path, rng: np.random.Generator) -> None:
    """The truth is of the LiDAR already, with stamps in nanoseconds."""
    folder = tmp_path / "helipr" / "kaist_05"
    (folder / "Ouster").mkdir(parents=True)
    cloud = np.zeros(128 * 1024, OUSTER)
    for name in ("x", "y", "z", "intensity"):
        cloud[name] = rng.uniform(1.0, 90.0, len(cloud))
    cloud["t"] = np.tile(np.arange(1024) * 97_000, 128)
    cloud["ring"] = np.repeat(np.arange(128), 1024)
    cloud.tofile(folder / "Ouster" / f"{START_NS}.bin")
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    (folder / "Ouster_gt.txt").write_text(f"{START_NS} {' '.join(f'{v:.9f}' for v in [*T[:3, 3], *quaternion])}\n")
    sample = ",".join(["0"] * 11 + ["0.1", "0.2", "9.8", "0.01", "0.02", "0.03"])
    (folder / "xsens_imu.csv").write_text("".join(f"{START_NS + k * 10**7},{sample[2:]}\n" for k in range(4)))

    recording = open_recording(folder)
    (scan,) = recording.scans()
    assert scan.stamp == pytest.approx(START_NS * 1e-9, abs=1e-6)
    assert len(scan) == len(cloud)
    order, expected = np.lexsort(scan.points.T), np.lexsort([cloud["x"], cloud["y"], cloud["z"]])
    np.testing.assert_array_equal(scan.points[order, 0], cloud["x"][expected])
    np.testing.assert_array_equal(scan.rings[order], cloud["ring"][expected])
    np.testing.assert_allclose(scan.time_offsets[order], cloud["t"][expected] * 1e-9)
    np.testing.assert_allclose(recording.ground_truth.T_world_lidar, [T], atol=1e-6)
    assert len(recording.imu) == 4
    assert recording.imu.accelerations[0] == pytest.approx([0.1, 0.2, 9.8])


def test_boreas(tmp_path: Path, rng: np.random.Generator) -> None:
    """The IMU is there, without gravity, and is no IMU to us; the truth is of the car."""
    folder = tmp_path / "boreas" / "glen_2021_03_23_12_43"
    (folder / "lidar").mkdir(parents=True)
    (folder / "applanix").mkdir()
    cloud = rng.uniform(1.0, 90.0, (256, 6)).astype("<f4")
    cloud[:, 4] = np.tile(np.arange(128), 2)
    cloud[:, 5] = np.repeat([0.0, 0.05], 128)
    cloud.tofile(folder / "lidar" / f"{START_NS // 1000}.bin")
    (folder / "applanix" / "imu_raw.csv").write_text(
        "GPSTime,...\n" + "".join(f"{k}.5,0,0,0,0,0,0\n" for k in range(3))
    )
    # The development kit turns by the negative angles.
    roll, pitch, yaw = -Rotation.from_matrix(T[:3, :3]).as_euler("XYZ")
    numbers = ",".join(map(repr, [*T[:3, 3].tolist(), 0.0, 0.0, 0.0, float(roll), float(pitch), float(yaw)]))
    (folder / "applanix" / "gps_post_process.csv").write_text(
        "GPSTime,...\n" + "".join(f"1689519000.{place},{numbers},0,0,0\n" for place in (25, 35))
    )

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
    assert log(inverse(T @ T_imu_lidar) @ recording.ground_truth.T_world_lidar[0]) == pytest.approx(0.0, abs=1e-6)
