"""Messages of ROS 1 and ROS 2, made of poses and points."""

from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import PointAttributes

ODOMETRY = "nav_msgs/msg/Odometry"
PATH = "nav_msgs/msg/Path"
POINT_CLOUD2 = "sensor_msgs/msg/PointCloud2"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"

_NS = 10**9


def nanoseconds(stamp: float) -> int:
    """A stamp in whole nanoseconds; `nanoseconds(stamp) / 10**9` is the stamp again."""
    return round(stamp * _NS)


class RosMessages:
    """Makes and serialises messages: for ROS 2 as CDR, for ROS 1 packed."""

    def __init__(self, ros2: bool) -> None:
        self._ros2 = ros2
        self.store = get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)
        if not ros2:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_MESSAGE))
        self._sequence = 0

    def serialize(self, message: Any) -> bytes:
        """The bytes of a message."""
        serialize = self.store.serialize_cdr if self._ros2 else self.store.serialize_ros1
        return bytes(serialize(message, message.__msgtype__))

    def odometry(
        self, stamp: float, frames: tuple[str, str], T: FloatArray, sigmas: FloatArray, velocity: FloatArray
    ) -> Any:
        """A pose (4, 4) of the second frame in the first, with standard deviations (6,) and body velocity (6,).

        Both have the rotation first and the axes of the second frame. ROS has translation first, and the covariance of
        the pose in the axes of the first frame. Unknown covariances are zero.
        """
        covariance = np.zeros((6, 6))
        if np.isfinite(sigmas).all():
            R = T[:3, :3]
            covariance[:3, :3] = R @ np.diag(sigmas[3:] ** 2) @ R.T
            covariance[3:, 3:] = R @ np.diag(sigmas[:3] ** 2) @ R.T
        pose = self._new("geometry_msgs/msg/PoseWithCovariance", self._pose(T), covariance.ravel())
        vector = "geometry_msgs/msg/Vector3"
        twist = self._new("geometry_msgs/msg/Twist", self._new(vector, *velocity[3:]), self._new(vector, *velocity[:3]))
        with_covariance = self._new("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
        return self._new(ODOMETRY, self._header(stamp, frames[0]), frames[1], pose, with_covariance)

    def transforms(self, stamp: float, *poses: tuple[str, str, FloatArray]) -> Any:
        """Parent frame, child frame and pose (4, 4) of the child in the parent, of each transform."""
        transforms = []
        for parent, child, T in poses:
            translation = self._new("geometry_msgs/msg/Vector3", *T[:3, 3])
            transform = self._new("geometry_msgs/msg/Transform", translation, self._quaternion(T))
            stamped = "geometry_msgs/msg/TransformStamped"
            transforms.append(self._new(stamped, self._header(stamp, parent), child, transform))
        return self._new(TF_MESSAGE, transforms)

    def path(self, stamps: FloatArray, frame: str, T: FloatArray) -> Any:
        """Poses (N, 4, 4) in a frame; the header has the last stamp."""
        poses = [
            self._new("geometry_msgs/msg/PoseStamped", self._header(float(stamp), frame), self._pose(each))
            for stamp, each in zip(stamps, T, strict=True)
        ]
        return self._new(PATH, self._header(float(stamps[-1]), frame), poses)

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
        kind: Any = self.store.types["sensor_msgs/msg/PointField"]
        fields = [
            kind(name, offset, getattr(kind, dtype.name.upper()), 1)
            for name, (dtype, offset, *_) in (records.dtype.fields or {}).items()
        ]
        step, count = records.dtype.itemsize, len(records)
        data = np.frombuffer(records.tobytes(), np.uint8)
        return self._new(
            POINT_CLOUD2, self._header(stamp, frame), 1, count, fields, False, step, step * count, data, True
        )

    def _new(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def _header(self, stamp: float, frame: str) -> Any:
        seconds, ns = divmod(nanoseconds(stamp), _NS)
        time = self._new("builtin_interfaces/msg/Time", seconds, ns)
        if self._ros2:
            return self._new("std_msgs/msg/Header", time, frame)
        self._sequence += 1
        return self._new("std_msgs/msg/Header", self._sequence - 1, time, frame)

    def _pose(self, T: FloatArray) -> Any:
        point = self._new("geometry_msgs/msg/Point", *T[:3, 3])
        return self._new("geometry_msgs/msg/Pose", point, self._quaternion(T))

    def _quaternion(self, T: FloatArray) -> Any:
        return self._new("geometry_msgs/msg/Quaternion", *Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True))
