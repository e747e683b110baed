"""The formats of recordings: the table, KITTI's layout and folders of PLY files; bags are in `bag_writer`."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.core.point_files import Columns, write_ply
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import format_kitti
from lidarslam.datasets.imu_samples import COLUMNS, EXTRINSIC, IMU_FILE
from lidarslam.datasets.mounting import KITTI_DEG, correct_elevation
from lidarslam.simulation.recorder import CLOCK_START_NS, Rig, SimulatedScan, clock_s

Writer = Callable[[Path, Iterable[SimulatedScan], Rig], None]
"""Makes the folder, which does not exist yet, and writes the scans, holding one of them at a time."""


def write_ply_scans(folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:
    """Write scan_000000.ply and so on, timestamps.txt and, with an IMU, imu.csv; implements `Writer`."""
    folder.mkdir()
    if rig.imu is not None:
        write_imu(folder / IMU_FILE, rig.imu)
    with (folder / "timestamps.txt").open("w", encoding="utf-8") as stamps:
        for number, simulated in enumerate(scans):
            scan = simulated.scan
            columns: Columns = dict(zip("xyz", scan.points.T.astype(np.float32), strict=True))
            columns["intensity"] = simulated.intensities
            if scan.time_offsets is not None:
                columns["t"] = np.round(1e9 * scan.time_offsets).astype(np.uint32)
            if scan.rings is not None:
                columns["ring"] = scan.rings.astype(np.uint16)
            write_ply(folder / f"scan_{number:06d}.ply", columns)
            stamps.write(f"{clock_s(scan.stamp):.9f}\n")


def write_imu(path: Path, imu: ImuSamples) -> None:
    """Write samples, stamped in simulated seconds, as a table on the recording's clock."""
    with path.open("w", encoding="utf-8") as table:
        if imu.T_lidar_imu is not None:
            table.write(f"# {EXTRINSIC}: {' '.join(f'{value:.12g}' for value in imu.T_lidar_imu[:3].ravel())}\n")
        table.write(",".join(COLUMNS) + "\n")
        for stamp, values in zip(imu.stamps, np.hstack([imu.angular_velocities, imu.accelerations]), strict=True):
            table.write(f"{clock_s(stamp):.9f},{','.join(f'{value:.9g}' for value in values)}\n")


SEQUENCE = "00"
_FULL_INTENSITY = 255.0  # KITTI's reach from 0 to 1

# Camera axes: x to the right, y down, z forward. On KITTI's car the camera looks within a degree of straight ahead,
# and sits below and in front of the LiDAR.
_R_CAM_LIDAR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
T_CAM_LIDAR = exp([0.007, -0.015, 0.009, 0.0, 0.0, 0.0]) @ make_transform(_R_CAM_LIDAR, [-0.004, -0.076, -0.272])

# Two grey and two colour cameras, rectified: one focal length, one centre, and their offsets from the first.
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
            # KITTI's own scans are too low, and all readers raise them; exact points would come out too high.
            points = correct_elevation(compensate(scan, rig), -KITTI_DEG)
            rows = np.column_stack([points, simulated.intensities / _FULL_INTENSITY]).astype("<f4")
            (sequence / "velodyne" / f"{number:06d}.bin").write_bytes(rows.tobytes())
            times.write(f"{scan.stamp:.9f}\n")
            poses.write(format_kitti(T_CAM_LIDAR @ T_world_lidar @ inverse(T_CAM_LIDAR)))


def compensate(scan: Scan, rig: Rig) -> FloatArray:
    """The points (N, 3) as they would have been measured at the stamp, all at once, from the true motion.

    Exact for static surfaces.
    """
    if scan.time_offsets is None:
        return scan.points
    # Lasers fire together, so a sweep has far fewer instants than points.
    offsets, instant = np.unique(scan.time_offsets, return_inverse=True)
    T_world_lidar = rig.T_world_lidar_at(scan.stamp + np.concatenate([[0.0], offsets]))
    T_stamp_point = (inverse(T_world_lidar[0]) @ T_world_lidar[1:])[instant]
    rotated = np.einsum("nij,nj->ni", T_stamp_point[:, :3, :3], scan.points)
    return np.asarray(rotated + T_stamp_point[:, :3, 3])


def _format_calibration() -> str:
    """calib.txt: the projections P0 to P3 of the four rectified cameras, and Tr, which is T_cam_lidar."""
    lines = {"Tr": T_CAM_LIDAR[:3]}
    for camera, beside_m in enumerate(_BESIDE_M):
        focal_row, centre = [_FOCAL_PX, 0.0, _CENTRE_PX[0], _FOCAL_PX * beside_m], [0.0, _FOCAL_PX, _CENTRE_PX[1], 0.0]
        lines[f"P{camera}"] = np.array([focal_row, centre, [0.0, 0.0, 1.0, 0.0]])
    texts = {name: " ".join(f"{value:.12e}" for value in rows.reshape(-1)) for name, rows in lines.items()}
    return "".join(f"{name}: {texts[name]}\n" for name in sorted(texts))


@dataclass(frozen=True)
class Format:
    """One row of the table."""

    write: Writer
    layout: str  # of the files, for the recording's README
    files: tuple[str, ...]  # their names in the recording's folder, as patterns
    source: str = ""  # the one to give to `lidarslam run`; empty: the folder itself, which always works too
    imu: str = ""  # where an IMU's samples are; empty where the format has no place for them
    clock_start_ns: int = CLOCK_START_NS  # the clock's reading at the simulated time zero

    def source_in(self, folder: Path) -> Path:
        """The argument for `lidarslam run` of the recording in that folder."""
        return folder / self.source.format(name=folder.name)


_KITTI_LAYOUT = (
    "the layout of the KITTI odometry benchmark. As there, the scans are motion compensated, here exactly and to the"
    " stamp at the start of the sweep; there is no per-point time; every point lies 0.205 degrees too low, which"
    " readers of KITTI (this one too) correct; poses/00.txt is in the frame of the camera that calib.txt describes (Tr)"
)
_PLY_LAYOUT = (
    "one binary PLY file a scan, with x, y, z in metres, intensity, t in nanoseconds from the scan's stamp, and ring;"
    " timestamps.txt has a stamp a line, seconds since 1970"
)
_PLY_FILES = ("scan_*.ply", "timestamps.txt", "imu.csv")
_IMU_TABLE = "imu.csv has its samples, stamped by the same clock, and T_lidar_imu in its first line"
_IMU_MESSAGES = "its messages are sensor_msgs/Imu on the topic of the sensor's driver, and /tf_static has T_lidar_imu"


def _bag(
    kind: Literal["rosbag1", "rosbag2", "mcap"], what: str, files: tuple[str, ...], source: str = "", use: str = ""
) -> Format:
    def write(folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:
        from lidarslam.simulation.bag_writer import write_bag  # takes a while to load

        write_bag(folder, scans, rig, kind)

    messages = "with the messages of the sensor's own driver, stamped at the start of each sweep"
    return Format(write, f"{what} {messages}{use}", files, source, _IMU_MESSAGES)


_ROSBAG2_USE, _MCAP_USE = "; the folder is the bag", "; the folder is the bag, and its .mcap file can be read alone"
FORMATS: dict[str, Format] = {
    "kitti": Format(write_kitti, _KITTI_LAYOUT, ("sequences", "poses"), clock_start_ns=0),
    "ply": Format(write_ply_scans, _PLY_LAYOUT, _PLY_FILES, imu=_IMU_TABLE),
    "rosbag1": _bag("rosbag1", "a ROS 1 bag", ("*.bag",), source="{name}.bag"),
    "rosbag2": _bag("rosbag2", "a ROS 2 bag (SQLite)", ("metadata.yaml", "*.db3"), use=_ROSBAG2_USE),
    "mcap": _bag("mcap", "a ROS 2 bag (MCAP)", ("metadata.yaml", "*.mcap"), use=_MCAP_USE),
}
