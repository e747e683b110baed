"""A run as a bag of ROS 2 or ROS 1."""

import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from lidarslam.core.files import cannot_write, make_directory
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import PointAttributes
from lidarslam.datasets.ros import made_messages as made
from lidarslam.datasets.ros.bag_message import serialize, typestore
from lidarslam.exports.source import RunScans
from lidarslam.storage.finished_run import load_map

# REP 105.
_MAP_FRAME, _ODOM_FRAME = "map", "odom"
_PATH_TOPIC, _MAP_TOPIC = _LATCHED = ("/path", "/map_points")
# Of one file; without a suffix, a rosbag2 folder.
SUFFIXES = (".mcap", ".db3", ".bag", "")
# The newest version that ROS 2 Humble reads; for a lone .db3 the oldest with types and metadata in the file.
_VERSION: Literal[8] = 8
_LONE_SQLITE_VERSION: Literal[9] = 9
_LONGEST = QosTime(9223372036, 854775807)  # as ROS 2 writes infinity


def export_bag(
    run: RunScans, out: Path, lidar_frame: str, with_clouds: bool, count: Callable[[int, int], None]
) -> dict[str, int]:
    """Write odometry, tf, path and map of a run, and its deskewed clouds, for which the recording is read again.

    The file has one of `SUFFIXES`, of which none gives a folder; `count` is called with the number of scans done, and
    the total. The number of messages of each topic.
    """
    make_directory(out.parent)
    try:
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".partial-") as folder:
            place = Path(folder) / (out.name if out.suffix == ".bag" else out.stem)
            with _writer(place, out.suffix) as writer:
                topics = RosTopics(writer)
                _write(topics, run, lidar_frame, with_clouds, count)
            made = place / f"{place.name}{out.suffix}" if out.suffix in (".mcap", ".db3") else place
            made.replace(out)
    except (OSError, sqlite3.Error) as error:
        raise cannot_write(out, error) from error
    return topics.counts


def _writer(place: Path, suffix: str) -> Rosbag1Writer | Rosbag2Writer:
    if suffix == ".bag":
        return Rosbag1Writer(place)
    if suffix == ".db3":
        return Rosbag2Writer(place, version=_LONE_SQLITE_VERSION, storage_plugin=StoragePlugin.SQLITE3)
    return Rosbag2Writer(place, version=_VERSION, storage_plugin=StoragePlugin.MCAP)


def _write(
    topics: "RosTopics", run: RunScans, lidar_frame: str, with_clouds: bool, count: Callable[[int, int], None]
) -> None:
    """Everything, in the order of time; the whole path and the map come with the first stamp."""
    trajectory = run.trajectory
    first = float(trajectory.stamps[0])
    topics.write(_PATH_TOPIC, first, topics.path(trajectory.stamps, _MAP_FRAME, trajectory.T_world_lidar))
    cloud = load_map(run.run)
    if len(cloud):
        attributes = cloud.attributes.only(("intensity", "rgb"))
        topics.write(_MAP_TOPIC, first, topics.cloud(first, _MAP_FRAME, cloud.points, attributes))
    written = 0
    for index, scan in run.deskewed() if with_clouds else ():
        for number in range(written, index + 1):
            _write_pose(topics, run, number, lidar_frame)
        written = index + 1
        attributes = PointAttributes(intensity=scan.intensities, rgb=scan.colours, ring=scan.rings)
        topics.write("/points", scan.stamp, topics.cloud(scan.stamp, lidar_frame, scan.points, attributes))
        count(written, len(trajectory))
    for number in range(written, len(trajectory)):
        _write_pose(topics, run, number, lidar_frame)
    count(len(trajectory), len(trajectory))


def _write_pose(topics: "RosTopics", run: RunScans, number: int, lidar_frame: str) -> None:
    """Transforms and odometry of one scan; map -> odom is the correction of the odometry by mapping and graph."""
    stamp = float(run.trajectory.stamps[number])
    T_map_lidar, T_odom_lidar = run.trajectory.T_world_lidar[number], run.odometry.T_world_lidar[number]
    corrected = (_MAP_FRAME, _ODOM_FRAME, T_map_lidar @ inverse(T_odom_lidar))
    topics.write("/tf", stamp, topics.transforms(stamp, corrected, (_ODOM_FRAME, lidar_frame, T_odom_lidar)))
    known, sigmas = run.known_velocities(number), run.sigmas[number]
    covariance = np.diag(sigmas**2) if np.isfinite(sigmas).all() else None
    velocity = np.mean(known, axis=0) if known else None
    header = topics.header(stamp, _MAP_FRAME)
    odometry = made.odometry(topics.store, header, lidar_frame, T_map_lidar, covariance, velocity)
    topics.write("/odometry", stamp, odometry)


def _qos(latched: bool) -> Qos:
    """Reliable; latched, a subscriber that comes later gets the last message too."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_LONGEST,
        lifespan=_LONGEST,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_LONGEST,
        avoid_ros_namespace_conventions=False,
    )


class RosTopics:
    """The topics of a bag of ROS 2 (CDR) or ROS 1 (packed), opened with their first message; makes the messages."""

    def __init__(self, bag: Rosbag1Writer | Rosbag2Writer) -> None:
        self._bag: Any = bag
        self._ros2 = isinstance(bag, Rosbag2Writer)
        self.store = typestore(self._ros2)
        self._sequence = 0
        self._connections: dict[str, Any] = {}
        self.counts: dict[str, int] = {}

    def write(self, topic: str, stamp: float, message: Any) -> None:
        """Write a message, recorded at its stamp."""
        if topic not in self._connections:
            latched = topic in _LATCHED
            how = {"offered_qos_profiles": [_qos(latched)]} if self._ros2 else {"latching": int(latched)}
            self._connections[topic] = self._bag.add_connection(topic, message.__msgtype__, typestore=self.store, **how)
        self._bag.write(self._connections[topic], round(stamp * 10**9), serialize(message, self._ros2))
        self.counts[topic] = self.counts.get(topic, 0) + 1

    def transforms(self, stamp: float, *poses: tuple[str, str, FloatArray]) -> Any:
        """Parent frame, child frame and pose (4, 4) of the child in the parent, of each transform."""
        return made.transforms(self.store, *((self.header(stamp, parent), child, T) for parent, child, T in poses))

    def path(self, stamps: FloatArray, frame: str, T: FloatArray) -> Any:
        """Poses (N, 4, 4) in a frame; the header has the last stamp."""
        types, store = self.store.types, self.store
        poses = [
            types["geometry_msgs/msg/PoseStamped"](self.header(float(stamp), frame), made.pose(store, each))
            for stamp, each in zip(stamps, T, strict=True)
        ]
        return types["nav_msgs/msg/Path"](self.header(float(stamps[-1]), frame), poses)

    def cloud(self, stamp: float, frame: str, points: FloatArray, attributes: PointAttributes) -> Any:
        """Points (N, 3) with intensity, ring and colour where known."""
        columns: dict[str, Any] = {axis: points[:, n].astype(np.float32) for n, axis in enumerate("xyz")}
        if attributes.intensity is not None:
            columns["intensity"] = attributes.intensity.astype(np.float32)
        if attributes.rgb is not None:  # packed into the bits of a float, as the Point Cloud Library does
            red, green, blue = attributes.rgb.T.astype(np.uint32)
            columns["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
        if attributes.ring is not None:
            columns["ring"] = np.clip(attributes.ring, 0, np.iinfo(np.uint16).max).astype(np.uint16)
        records = np.empty(len(points), np.dtype([(name, values.dtype) for name, values in columns.items()]))
        for name, values in columns.items():
            records[name] = values
        return made.point_cloud(self.store, self.header(stamp, frame), records)

    def header(self, stamp: float, frame: str) -> Any:
        """Of the next message."""
        self._sequence += 1
        return made.header(self.store, round(stamp * 10**9), frame, self._sequence - 1)
