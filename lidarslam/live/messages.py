"""ROS 2 messages of a live run: their definitions, and odometry and transforms to be published."""

from collections.abc import Callable
from functools import cache

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lidarslam.core.geometry import FloatArray, adjoint, inverse
from lidarslam.core.tracking import Status
from lidarslam.datasets.ros import bag_message
from lidarslam.datasets.ros import made_messages as made
from lidarslam.datasets.ros.bag_message import TRANSFORMS_TYPE
from lidarslam.pipeline.estimates import ScanEstimate

Publish = Callable[[bytes], None]


@cache
def message_types() -> Typestore:
    """The definitions of all message types in use."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for message_type in bag_message.CUSTOM_MESSAGE_TYPES:
        point_type = message_type.replace("CustomMsg", "CustomPoint")
        store.register(get_types_from_msg(bag_message.CUSTOM_POINT_DEFINITION, point_type))
        store.register(get_types_from_msg(bag_message.CUSTOM_MESSAGE_DEFINITION, message_type))
    return store


def serialize_transform(stamp_ns: int, frame_id: str, child_frame_id: str, T_frame_child: FloatArray) -> bytes:
    """A tf2_msgs/TFMessage with one transform, the pose (4, 4) of the child."""
    store = message_types()
    message = made.transforms(store, (made.header(store, stamp_ns, frame_id), child_frame_id, T_frame_child))
    return bytes(store.serialize_cdr(message, TRANSFORMS_TYPE))


class PosePublisher:
    """Publishes the pose of a body that carries the LiDAR, relative to the pose of the body at the first scan.

    The pose of a lost scan is a prediction, and is not published. Messages are nav_msgs/Odometry and, where there is a
    publisher for them, tf2_msgs/TFMessage.
    """

    def __init__(
        self,
        odometry: Publish,
        transforms: Publish | None,
        fixed_frame: str,
        body_frame: str,
        T_body_lidar: FloatArray,
    ) -> None:
        self._odometry, self._transforms = odometry, transforms
        self._fixed_frame, self._body_frame = fixed_frame, body_frame
        self._T_body_lidar = T_body_lidar

    def publish(self, stamp_ns: int, estimate: ScanEstimate) -> None:
        """Publish the pose of a scan."""
        if estimate.status is Status.LOST:
            return
        # With A the adjoint of T_body_lidar, an error or velocity xi of the LiDAR is A xi of the body.
        T = self._T_body_lidar @ estimate.T_world_lidar @ inverse(self._T_body_lidar)
        A, store = adjoint(self._T_body_lidar), message_types()
        covariance = None if estimate.covariance is None else A @ estimate.covariance @ A.T
        velocity = None if estimate.velocity is None else A @ estimate.velocity
        header = made.header(store, stamp_ns, self._fixed_frame)
        message = made.odometry(store, header, self._body_frame, T, covariance, velocity)
        self._odometry(bytes(store.serialize_cdr(message, made.ODOMETRY_TYPE)))
        if self._transforms is not None:
            self._transforms(serialize_transform(stamp_ns, self._fixed_frame, self._body_frame, T))
