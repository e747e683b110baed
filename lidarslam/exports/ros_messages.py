"""Messages of a run, for ROS 1 or ROS 2."""

from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import PointAttributes
from lidarslam.datasets.ros import made_messages as made
from lidarslam.datasets.ros.bag_message import TRANSFORMS_DEFINITION, TRANSFORMS_TYPE


def nanoseconds(stamp: float) -> int:
    """A stamp in whole nanoseconds; `nanoseconds(stamp) / 10**9` is the stamp again."""
    return round(stamp * 10**9)


class RosMessages:
    """Makes and serialises messages: for ROS 2 as CDR, for ROS 1 packed."""

    def __init__(self, ros2: bool) -> None:
        self._ros2 = ros2
        self.store = get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)
        if not ros2:  # ROS 2's store has it
            self.store.register(get_types_from_msg(TRANSFORMS_DEFINITION, TRANSFORMS_TYPE))
        self._sequence = 0

    def serialize(self, message: Any) -> bytes:
        """The bytes of a message."""
        serialize = self.store.serialize_cdr if self._ros2 else self.store.serialize_ros1
        return bytes(serialize(message, message.__msgtype__))

    def odometry(
        self, stamp: float, frames: tuple[str, str], T: FloatArray, sigmas: FloatArray, velocity: FloatArray
    ) -> Any:
        """A pose (4, 4) of the second frame in the first, with standard deviations (6,) and body velocity (6,).

        Both have the rotation first and the axes of the second frame; standard deviations that are not finite are
        unknown.
        """
        covariance = np.diag(sigmas**2) if np.isfinite(sigmas).all() else None
        return made.odometry(self.store, self._header(stamp, frames[0]), frames[1], T, covariance, velocity)

    def transforms(self, stamp: float, *poses: tuple[str, str, FloatArray]) -> Any:
        """Parent frame, child frame and pose (4, 4) of the child in the parent, of each transform."""
        return made.transforms(self.store, *((self._header(stamp, parent), child, T) for parent, child, T in poses))

    def path(self, stamps: FloatArray, frame: str, T: FloatArray) -> Any:
        """Poses (N, 4, 4) in a frame; the header has the last stamp."""
        types, store = self.store.types, self.store
        poses = [
            types["geometry_msgs/msg/PoseStamped"](self._header(float(stamp), frame), made.pose(store, each))
            for stamp, each in zip(stamps, T, strict=True)
        ]
        return types["nav_msgs/msg/Path"](self._header(float(stamps[-1]), frame), poses)

    def cloud(self, stamp: float, frame: str, points: FloatArray, attributes: PointAttributes) -> Any:
        """Points (N, 3) with intensity, ring and colour as far as there are any."""
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
        return made.point_cloud(self.store, self._header(stamp, frame), records)

    def _header(self, stamp: float, frame: str) -> Any:
        self._sequence += 1
        return made.header(self.store, nanoseconds(stamp), frame, self._sequence - 1)
