"""The formats of recordings."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lidarslam.simulation.recorder import SimulatedScan
from lidarslam.simulation.world import choose
from lidarslam.simulation.writers import CLOCK_START_NS, Rig, Writer, write_kitti, write_ply_scans


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


_BAG_MESSAGES = "with the messages of the sensor's own driver, stamped at the start of each sweep"
_KITTI_LAYOUT = (
    "the layout of the KITTI odometry benchmark. As there, the scans are motion compensated, here exactly and to the"
    " stamp at the start of the sweep; there is no per-point time; every point lies 0.205 degrees too low, which"
    " readers of KITTI (this one too) correct; poses/00.txt is in the frame of the camera that calib.txt describes (Tr)"
)
_PLY_LAYOUT = (
    "one binary PLY file a scan, with x, y, z in metres, intensity, t in nanoseconds from the scan's stamp, and ring;"
    " timestamps.txt has a stamp a line, seconds since 1970"
)
_ROSBAG2_LAYOUT = f"a ROS 2 bag (SQLite) {_BAG_MESSAGES}; the folder is the bag"
_MCAP_LAYOUT = f"a ROS 2 bag (MCAP) {_BAG_MESSAGES}; the folder is the bag, and its .mcap file can be read alone"

_IMU_TABLE = "imu.csv has its samples, stamped by the same clock, and T_lidar_imu in its first line"
_IMU_MESSAGES = "its messages are sensor_msgs/Imu on the topic of the sensor's driver, and /tf_static has T_lidar_imu"


def _bag_writer(kind: Literal["rosbag1", "rosbag2", "mcap"]) -> Writer:
    def write(folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:
        from lidarslam.simulation.bag_writer import write_bag

        write_bag(folder, scans, rig, kind)

    return write


_PLY_FILES = ("scan_*.ply", "timestamps.txt", "imu.csv")
FORMATS: dict[str, Format] = {
    "kitti": Format(write_kitti, _KITTI_LAYOUT, ("sequences", "poses"), clock_start_ns=0),
    "ply": Format(write_ply_scans, _PLY_LAYOUT, _PLY_FILES, imu=_IMU_TABLE),
    "rosbag1": Format(
        _bag_writer("rosbag1"), f"a ROS 1 bag {_BAG_MESSAGES}", ("*.bag",), source="{name}.bag", imu=_IMU_MESSAGES
    ),
    "rosbag2": Format(_bag_writer("rosbag2"), _ROSBAG2_LAYOUT, ("metadata.yaml", "*.db3"), imu=_IMU_MESSAGES),
    "mcap": Format(_bag_writer("mcap"), _MCAP_LAYOUT, ("metadata.yaml", "*.mcap"), imu=_IMU_MESSAGES),
}


def find_format(name: str) -> Format:
    """The format of that name."""
    return choose("recording format", name, FORMATS)
