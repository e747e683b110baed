"""Bags of ROS 1 and ROS 2 with the point clouds of the sensor's own driver and, if asked for, those of an IMU."""

import heapq
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lidarslam.core.errors import OutputError
from lidarslam.datasets.ros.bag_message import TRANSFORMS_DEFINITION, TRANSFORMS_TYPE
from lidarslam.datasets.ros.livox import CUSTOM_MESSAGE_DEFINITION, CUSTOM_POINT_DEFINITION
from lidarslam.datasets.ros.made_messages import (
    POINT_CLOUD2_TYPE,
    header,
    point_cloud,
    transforms,
    write_chunk_checksums,
)
from lidarslam.simulation.recorder import SimulatedScan
from lidarslam.simulation.writers.driver_clouds import DriverCloud, Records, find_driver
from lidarslam.simulation.writers.imu_messages import IMU_TYPE, imu_messages
from lidarslam.simulation.writers.interface import CLOCK_START_NS, Rig, clock_ns

_STATIC_TRANSFORMS = "/tf_static"
_CUSTOM_MESSAGE = "livox_ros_driver2/msg/CustomMsg"
_CUSTOM_POINT = "livox_ros_driver2/msg/CustomPoint"

_LIDAR_ID = 192  # the last byte of the sensor's address
_CDR_ALIGNMENT = 4
# The newest version that ROS 2 Humble still reads.
_ROSBAG2_VERSION: Literal[8] = 8


def write_rosbag1(folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:
    """Write a `.bag` named like the folder; implements `Writer`."""
    folder.mkdir()
    _write(Rosbag1Writer(folder / f"{folder.name}.bag"), scans, rig)


def write_rosbag2(folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:
    """Write a rosbag2 folder with an SQLite file; implements `Writer`."""
    _write(Rosbag2Writer(folder, version=_ROSBAG2_VERSION, storage_plugin=StoragePlugin.SQLITE3), scans, rig)


def write_mcap(folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:
    """Write a rosbag2 folder with an MCAP file; implements `Writer`."""
    _write(Rosbag2Writer(folder, version=_ROSBAG2_VERSION, storage_plugin=StoragePlugin.MCAP), scans, rig)
    write_chunk_checksums(folder / f"{folder.name}.mcap")


def _write(bag: Rosbag1Writer | Rosbag2Writer, scans: Iterable[SimulatedScan], rig: Rig) -> None:
    serializer = MessageSerializer(ros2=isinstance(bag, Rosbag2Writer))
    try:
        with bag:
            for message in heapq.merge(
                _clouds(bag, serializer, scans, rig), _imu(bag, serializer, rig), key=lambda message: message[1]
            ):
                bag.write(*message)
    except sqlite3.Error as error:
        raise OutputError(f"{bag.path}: cannot be written ({error}); is the disk full?") from error


Messages = Iterator[tuple[Any, int, bytes]]
"""Connection, time of recording in nanoseconds, and bytes of messages in the order of time."""


def _clouds(
    bag: Rosbag1Writer | Rosbag2Writer, serializer: "MessageSerializer", scans: Iterable[SimulatedScan], rig: Rig
) -> Messages:
    driver = find_driver(rig.driver)
    connection = bag.add_connection(driver.topic, serializer.message_type(driver), typestore=serializer.store)
    # A message is published, and recorded, when its last point has been measured.
    latency_ns = round(1e9 * rig.sweep_s)
    for number, simulated in enumerate(scans):
        stamp_ns = clock_ns(simulated.scan.stamp)
        records = driver.records(simulated, stamp_ns)
        yield connection, stamp_ns + latency_ns, serializer.serialize(driver, records, stamp_ns, number)


def _imu(bag: Rosbag1Writer | Rosbag2Writer, serializer: "MessageSerializer", rig: Rig) -> Messages:
    """Where the IMU is on the LiDAR, then a message a sample."""
    driver, imu = find_driver(rig.driver), rig.imu
    if imu is None:
        return
    store = serializer.store
    if imu.T_lidar_imu is not None:
        placed = bag.add_connection(_STATIC_TRANSFORMS, TRANSFORMS_TYPE, typestore=store)
        parent = header(store, CLOCK_START_NS, driver.frame_id)
        message = transforms(store, (parent, driver.imu_frame_id, imu.T_lidar_imu))
        yield placed, CLOCK_START_NS, serializer.serialized(message, TRANSFORMS_TYPE)
    connection = bag.add_connection(driver.imu_topic, IMU_TYPE, typestore=store)
    for stamp_ns, sample in imu_messages(store, imu, driver.imu_frame_id):
        yield connection, stamp_ns, serializer.serialized(sample, IMU_TYPE)


class MessageSerializer:
    """Serialises clouds for ROS 1 (packed) or ROS 2 (CDR)."""

    def __init__(self, ros2: bool) -> None:
        self._ros2 = ros2
        self.store = get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)
        self.store.register(get_types_from_msg(CUSTOM_POINT_DEFINITION, _CUSTOM_POINT))
        self.store.register(get_types_from_msg(CUSTOM_MESSAGE_DEFINITION, _CUSTOM_MESSAGE))
        if not ros2:  # ROS 2's store has it
            self.store.register(get_types_from_msg(TRANSFORMS_DEFINITION, TRANSFORMS_TYPE))

    def message_type(self, driver: DriverCloud) -> str:
        """The name of the driver's message type."""
        return _CUSTOM_MESSAGE if driver.custom_message else POINT_CLOUD2_TYPE

    def serialize(self, driver: DriverCloud, records: Records, stamp_ns: int, sequence: int) -> bytes:
        """The message with these points (N,), stamped `stamp_ns`; `sequence` counts the messages, for ROS 1."""
        message_header = header(self.store, stamp_ns, driver.frame_id, sequence)
        message_type = self.message_type(driver)
        if not driver.custom_message:
            return self.serialized(point_cloud(self.store, message_header, records), message_type)
        rsvd = np.zeros(3, np.uint8)
        message = self.store.types[message_type](message_header, stamp_ns, len(records), _LIDAR_ID, rsvd, [])
        # Twenty thousand point objects would take longer than casting their rays: the bytes are put in place of the
        # empty list, which ends the message with its length.
        without_points = self.serialized(message, message_type)[:-4]
        return without_points + len(records).to_bytes(4, "little") + self._packed(records)

    def serialized(self, message: Any, message_type: str) -> bytes:
        """The bytes of a message."""
        serialize = self.store.serialize_cdr if self._ros2 else self.store.serialize_ros1
        return bytes(serialize(message, message_type))

    def _packed(self, records: Records) -> bytes:
        """Points one after the other; in CDR each begins at a multiple of four bytes."""
        size = records.dtype.itemsize
        if not self._ros2 or not len(records):
            return records.tobytes()
        aligned = np.zeros((len(records), -(-size // _CDR_ALIGNMENT) * _CDR_ALIGNMENT), np.uint8)
        aligned[:, :size] = np.frombuffer(records.tobytes(), np.uint8).reshape(-1, size)
        return aligned.tobytes()[: aligned.size - (aligned.shape[1] - size)]  # nothing follows that needs alignment
