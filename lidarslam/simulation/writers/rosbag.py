"""Bags of ROS 1 and ROS 2 with one topic, the point clouds of the sensor's own driver."""

import sqlite3
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from lidarslam.core.errors import OutputError
from lidarslam.simulation.recording.recorder import SimulatedScan
from lidarslam.simulation.writers.bag_messages import MessageSerializer
from lidarslam.simulation.writers.driver_clouds import find_driver
from lidarslam.simulation.writers.interface import Rig, clock_ns

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


def _write(bag: Rosbag1Writer | Rosbag2Writer, scans: Iterable[SimulatedScan], rig: Rig) -> None:
    driver = find_driver(rig.driver)
    serializer = MessageSerializer(ros2=isinstance(bag, Rosbag2Writer))
    # A message is published, and recorded, when its last point has been measured.
    latency_ns = round(1e9 * rig.sweep_s)
    try:
        with bag:
            connection = bag.add_connection(driver.topic, serializer.message_type(driver), typestore=serializer.store)
            for number, simulated in enumerate(scans):
                stamp_ns = clock_ns(simulated.scan.stamp)
                records = driver.records(simulated, stamp_ns)
                bag.write(connection, stamp_ns + latency_ns, serializer.serialize(driver, records, stamp_ns, number))
    except sqlite3.Error as error:
        raise OutputError(f"{bag.path}: cannot be written ({error}); is the disk full?") from error
