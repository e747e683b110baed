"""ROS 2 messages: the definitions of those that are received, and odometry and transforms to be published."""

from functools import cache

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.ros import livox
from lidarslam.datasets.ros import made_messages as made
from lidarslam.datasets.ros.bag_message import TRANSFORMS_TYPE


@cache
def message_types() -> Typestore:
    """The definitions of all message types in use."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for message_type in livox.CUSTOM_MESSAGE_TYPES:
        point_type = message_type.replace("CustomMsg", "CustomPoint")
        store.register(get_types_from_msg(livox.CUSTOM_POINT_DEFINITION, point_type))
        store.register(get_types_from_msg(livox.CUSTOM_MESSAGE_DEFINITION, message_type))
    return store


def serialize_odometry(
    stamp_ns: int,
    frame_id: str,
    child_frame_id: str,
    T_frame_child: FloatArray,
    covariance: FloatArray | None,
    velocity: FloatArray | None,
) -> bytes:
    """A nav_msgs/Odometry.

    Args:
        stamp_ns: of the scan, nanoseconds.
        frame_id, child_frame_id: the fixed frame and that of the moving body.
        T_frame_child: (4, 4) the pose of the body.
        covariance: (6, 6) of its error in the frame of the body, rotation first; None where it is unknown.
        velocity: (6,) in the frame of the body, rotation first; None where it is unknown.
    """
    store = message_types()
    fixed = made.header(store, stamp_ns, frame_id)
    message = made.odometry(store, fixed, child_frame_id, T_frame_child, covariance, velocity)
    return bytes(store.serialize_cdr(message, made.ODOMETRY_TYPE))


def serialize_transform(stamp_ns: int, frame_id: str, child_frame_id: str, T_frame_child: FloatArray) -> bytes:
    """A tf2_msgs/TFMessage with one transform, the pose (4, 4) of the child."""
    store = message_types()
    message = made.transforms(store, (made.header(store, stamp_ns, frame_id), child_frame_id, T_frame_child))
    return bytes(store.serialize_cdr(message, TRANSFORMS_TYPE))
