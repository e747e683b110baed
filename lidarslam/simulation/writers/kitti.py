"""The layout of the KITTI odometry benchmark: `sequences/00/{velodyne/*.bin, times.txt, calib.txt}`, `poses/00.txt`."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform
from lidarslam.core.pose_text import format_kitti
from lidarslam.core.scan import Scan
from lidarslam.datasets.mounting.elevation import KITTI_DEG, correct_elevation
from lidarslam.simulation.recorder import SimulatedScan
from lidarslam.simulation.writers.interface import Rig

SEQUENCE = "00"
_FULL_INTENSITY = 255.0  # KITTI's reach from 0 to 1

# Camera axes: x to the right, y down, z forward. On KITTI's car the camera looks within a degree of straight ahead,
# and sits below and in front of the LiDAR.
_R_CAM_LIDAR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
T_CAM_LIDAR = exp([0.007, -0.015, 0.009, 0.0, 0.0, 0.0]) @ make_transform(_R_CAM_LIDAR, [-0.004, -0.076, -0.272])

# Two grey and two colour cameras, rectified: one focal length, one centre, and how far each sits beside the first.
_FOCAL_PX, _CENTRE_PX = 718.856, (607.193, 185.216)
_BESIDE_M = (0.0, -0.537, 0.063, -0.469)


def write_kitti(folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:
    """Write sequence 00; implements `Writer`.

    The LiDAR poses that a reader recovers from `poses/00.txt` and `Tr` are the true ones in the world of the
    simulation, so the first need not be the identity.
    """
    sequence = folder / "sequences" / SEQUENCE
    (sequence / "velodyne").mkdir(parents=True)
    (folder / "poses").mkdir()
    (sequence / "calib.txt").write_text(_format_calibration(), encoding="utf-8")
    with (
        (sequence / "times.txt").open("w", encoding="utf-8") as times,
        (folder / "poses" / f"{SEQUENCE}.txt").open("w", encoding="utf-8") as poses,
    ):
        for number, simulated in enumerate(scans):
            scan = simulated.scan
            T_world_lidar = rig.T_world_lidar_at(np.array([scan.stamp]))
            points = compensate(scan, rig)
            (sequence / "velodyne" / f"{number:06d}.bin").write_bytes(_rows(points, simulated).tobytes())
            times.write(f"{scan.stamp:.9f}\n")
            poses.write(format_kitti(T_CAM_LIDAR @ T_world_lidar @ inverse(T_CAM_LIDAR)))


def compensate(scan: Scan, rig: Rig) -> FloatArray:
    """The points (N, 3) as they would have been measured at the stamp, all at once, from the true motion.

    Exact for what stands still.
    """
    if scan.time_offsets is None:
        return scan.points
    # Lasers fire together, so a sweep has far fewer instants than points.
    offsets, instant = np.unique(scan.time_offsets, return_inverse=True)
    T_world_lidar = rig.T_world_lidar_at(scan.stamp + np.concatenate([[0.0], offsets]))
    T_stamp_point = (inverse(T_world_lidar[0]) @ T_world_lidar[1:])[instant]
    rotated = np.einsum("nij,nj->ni", T_stamp_point[:, :3, :3], scan.points)
    return np.asarray(rotated + T_stamp_point[:, :3, 3])


def _rows(points: FloatArray, simulated: SimulatedScan) -> FloatArray:
    # KITTI's own scans lie too low, and everybody who reads them raises them; exact points would come out too high.
    intensities = simulated.intensities / _FULL_INTENSITY
    return np.column_stack([correct_elevation(points, -KITTI_DEG), intensities]).astype("<f4")


def _format_calibration() -> str:
    """calib.txt: the projections P0 to P3 of the four rectified cameras, and Tr, which is T_cam_lidar."""
    lines = {"Tr": T_CAM_LIDAR[:3]}
    for camera, beside_m in enumerate(_BESIDE_M):
        focal_row, centre = [_FOCAL_PX, 0.0, _CENTRE_PX[0], _FOCAL_PX * beside_m], [0.0, _FOCAL_PX, _CENTRE_PX[1], 0.0]
        lines[f"P{camera}"] = np.array([focal_row, centre, [0.0, 0.0, 1.0, 0.0]])
    texts = {name: " ".join(f"{value:.12e}" for value in rows.reshape(-1)) for name, rows in lines.items()}
    return "".join(f"{name}: {texts[name]}\n" for name in sorted(texts))
