"""Bags of ROS 1 and ROS 2 with the point clouds of the sensor's own driver and, if asked for, those of an IMU."""

import heapq
import sqlite3
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from lidarslam.core.errors import OutputError
from lidarslam.core.imu import ImuSamples
from lidarslam.datasets.ros import bag_message
from lidarslam.datasets.ros import made_messages as made
from lidarslam.simulation.recorder import CLOCK_START_NS, Rig, SimulatedScan, clock_ns

Records = NDArray[np.void]
_FIRST_RETURN = 0x10
_CUSTOM_MESSAGE = "livox_ros_driver2/msg/CustomMsg"


@dataclass(frozen=True)
class DriverCloud:
    """A driver's topic and point layout."""

    topic: str  # the driver's defaults
    frame_id: str
    record: np.dtype[np.void]  # type of a point, padding included
    imu_topic: str = "/imu/data"  # of the IMU in the sensor, or of one next to it
    imu_frame_id: str = "imu_link"
    message_type: str = bag_message.POINT_CLOUD2_TYPE

    def records(self, simulated: SimulatedScan, stamp_ns: int) -> Records:
        """The points (N,) of a sweep whose message is stamped `stamp_ns`."""
        scan = simulated.scan
        offsets = np.zeros(len(scan)) if scan.time_offsets is None else scan.time_offsets
        rings = 0 if scan.rings is None else scan.rings
        columns: dict[str, ArrayLike] = {
            **dict(zip("xyz", scan.points.T, strict=True)),
            "intensity": simulated.intensities,  # whole numbers from 0 to 255, the scale of all four drivers
            "reflectivity": simulated.intensities,
            "ring": rings,
            "line": rings,
            "tag": _FIRST_RETURN,
            "time": offsets,
            "timestamp": stamp_ns / 10**9 + offsets,
            "t": np.round(1e9 * offsets),
            "offset_time": np.round(1e9 * offsets),
            "range": np.round(1e3 * np.linalg.norm(scan.points, axis=1)),
            "ambient": 0,  # sunlight: the simulated night is dark
        }
        records = np.zeros(len(scan), self.record)
        for name in self.record.names or ():
            records[name] = columns[name]
        return records


_XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
# velodyne_pointcloud, PointXYZIRT: packed
_VELODYNE_POINT = np.dtype([*_XYZ, ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
# ouster-ros, point type "original": laid out by PCL, which keeps 16 bytes for the coordinates
_OUSTER_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "<u2", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
        "itemsize": 48,
    }
)
# HesaiLidar_ROS_2.0: packed
_HESAI_POINT = np.dtype([*_XYZ, ("intensity", "<f4"), ("ring", "<u2"), ("timestamp", "<f8")])
# livox_ros_driver2, CustomPoint: 19 bytes
_LIVOX_POINT = np.dtype([("offset_time", "<u4"), *_XYZ, ("reflectivity", "|u1"), ("tag", "|u1"), ("line", "|u1")])

DRIVERS: dict[str, DriverCloud] = {
    "velodyne": DriverCloud("/velodyne_points", "velodyne", _VELODYNE_POINT),
    "ouster": DriverCloud("/ouster/points", "os_lidar", _OUSTER_POINT, "/ouster/imu", "os_imu"),
    "hesai": DriverCloud("/lidar_points", "hesai_lidar", _HESAI_POINT),
    "livox": DriverCloud("/livox/lidar", "livox_frame", _LIVOX_POINT, "/livox/imu", "livox_imu", _CUSTOM_MESSAGE),
}

_IMU_TYPE = "sensor_msgs/msg/Imu"
_STATIC_TRANSFORMS = "/tf_static"

_LIDAR_ID = 192  # the last byte of the sensor's address
_CDR_ALIGNMENT = 4
# The newest version that ROS 2 Humble still reads.
_ROSBAG2_VERSION: Literal[8] = 8


def write_bag(
    folder: Path, scans: Iterable[SimulatedScan], rig: Rig, kind: Literal["rosbag1", "rosbag2", "mcap"]
) -> None:
    """Write a `.bag` named like the folder in it, or a rosbag2 folder with an SQLite or an MCAP file."""
    bag: Rosbag1Writer | Rosbag2Writer
    if kind == "rosbag1":
        folder.mkdir()
        bag = Rosbag1Writer(folder / f"{folder.name}.bag")
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        bag = Rosbag2Writer(folder, version=_ROSBAG2_VERSION, storage_plugin=plugin)
    topics = _Topics(bag, DRIVERS[rig.driver], ros2=kind != "rosbag1")
    messages = (topics.clouds(scans, rig.sweep_s), topics.imu(rig.imu))
    try:
        with bag:
            for message in heapq.merge(*messages, key=lambda message: message[1]):
                bag.write(*message)
    except sqlite3.Error as error:
        raise OutputError(f"{bag.path}: cannot be written ({error}); is the disk full?") from error


Messages = Iterator[tuple[Any, int, bytes]]  # connection, time of recording in nanoseconds, bytes; in order of time


class _Topics:
    """The messages of a driver for a bag, serialised for ROS 1 (packed) or ROS 2 (CDR)."""

    def __init__(self, bag: Rosbag1Writer | Rosbag2Writer, driver: DriverCloud, ros2: bool) -> None:
        self._bag, self._driver, self._ros2, self._store = bag, driver, ros2, bag_message.typestore(ros2)

    def _connection(self, topic: str, message_type: str) -> Any:
        return self._bag.add_connection(topic, message_type, typestore=self._store)

    def clouds(self, scans: Iterable[SimulatedScan], sweep_s: float) -> Messages:
        """A message per scan, published, and recorded, when its last point has been measured."""
        connection = self._connection(self._driver.topic, self._driver.message_type)
        latency_ns = round(1e9 * sweep_s)
        for number, simulated in enumerate(scans):
            stamp_ns = clock_ns(simulated.scan.stamp)
            header = made.header(self._store, stamp_ns, self._driver.frame_id, number)
            records = self._driver.records(simulated, stamp_ns)
            if self._driver.message_type == _CUSTOM_MESSAGE:
                raw = self._custom_message(header, stamp_ns, records)
            else:
                raw = bag_message.serialize(made.point_cloud(self._store, header, records), self._ros2)
            yield connection, stamp_ns + latency_ns, raw

    def _custom_message(self, header: Any, stamp_ns: int, records: Records) -> bytes:
        """Livox's own message with these points (N,)."""
        rsvd, size = np.zeros(3, np.uint8), records.dtype.itemsize
        message = self._store.types[_CUSTOM_MESSAGE](header, stamp_ns, len(records), _LIDAR_ID, rsvd, [])
        # Twenty thousand point objects would take longer than casting their rays: the bytes are put in place of the
        # empty list, which ends the message with its length.
        without_points = bag_message.serialize(message, self._ros2)[:-4]
        padding = -size % _CDR_ALIGNMENT if self._ros2 else 0  # of all points but the last
        rows = np.pad(np.frombuffer(records.tobytes(), np.uint8).reshape(-1, size), ((0, 0), (0, padding)))
        return without_points + len(records).to_bytes(4, "little") + rows.tobytes()[: rows.size - padding]

    def imu(self, imu: ImuSamples | None) -> Messages:
        """The extrinsic calibration of the IMU, then a message per sample."""
        if imu is None:
            return
        store, frame_id = self._store, self._driver.imu_frame_id
        if imu.T_lidar_imu is not None:
            placed = self._connection(_STATIC_TRANSFORMS, bag_message.TRANSFORMS_TYPE)
            parent = made.header(store, CLOCK_START_NS, self._driver.frame_id)
            message = made.transforms(store, (parent, frame_id, imu.T_lidar_imu))
            yield placed, CLOCK_START_NS, bag_message.serialize(message, self._ros2)
        connection = self._connection(self._driver.imu_topic, _IMU_TYPE)
        orientation, unknown = store.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0), np.zeros(9)
        no_orientation = np.array([-1.0, *[0.0] * 8])  # as the message's definition requires
        for number, stamp in enumerate(imu.stamps):
            stamp_ns = clock_ns(stamp)
            sample = store.types[_IMU_TYPE](
                header=made.header(store, stamp_ns, frame_id, number),
                orientation=orientation,
                orientation_covariance=no_orientation,
                angular_velocity=made.vector(store, imu.angular_velocities[number]),
                angular_velocity_covariance=unknown,
                linear_acceleration=made.vector(store, imu.accelerations[number]),
                linear_acceleration_covariance=unknown,
            )
            yield connection, stamp_ns, bag_message.serialize(sample, self._ros2)
