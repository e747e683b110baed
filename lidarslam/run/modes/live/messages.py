"""ROS 2 messages: the definitions of those that are received, and odometry and transforms to be published."""

from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.ros import livox
from lidarslam.datasets.ros.bag_message import TRANSFORMS_TYPE

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
# Rotation first, as poses have their errors here, to translation first, as ROS has them.
_ROS_ORDER = (3, 4, 5, 0, 1, 2)


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
    types = message_types().types
    ros_covariance = np.zeros(36) if covariance is None else in_fixed_frame(covariance, T_frame_child).ravel()
    angular, linear = np.zeros((2, 3)) if velocity is None else velocity.reshape(2, 3)
    pose = types["geometry_msgs/msg/Pose"](position=_point(T_frame_child), orientation=_quaternion(T_frame_child))
    twist = types["geometry_msgs/msg/Twist"](linear=_vector(linear), angular=_vector(angular))
    message = types[ODOMETRY_TYPE](
        header=_header(stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=ros_covariance),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )
    return bytes(message_types().serialize_cdr(message, ODOMETRY_TYPE))


def serialize_transform(stamp_ns: int, frame_id: str, child_frame_id: str, T_frame_child: FloatArray) -> bytes:
    """A tf2_msgs/TFMessage with one transform, the pose (4, 4) of the child."""
    types = message_types().types
    transform = types["geometry_msgs/msg/Transform"](
        translation=_vector(T_frame_child[:3, 3]), rotation=_quaternion(T_frame_child)
    )
    stamped = types["geometry_msgs/msg/TransformStamped"](
        header=_header(stamp_ns, frame_id), child_frame_id=child_frame_id, transform=transform
    )
    return bytes(message_types().serialize_cdr(types[TRANSFORMS_TYPE](transforms=[stamped]), TRANSFORMS_TYPE))


def in_fixed_frame(covariance: FloatArray, T_frame_child: FloatArray) -> FloatArray:
    """The covariance (6, 6) as ROS has it: along and about the axes of the fixed frame, translation first."""
    rotate = np.kron(np.eye(2), T_frame_child[:3, :3])
    return np.asarray((rotate @ covariance @ rotate.T)[np.ix_(_ROS_ORDER, _ROS_ORDER)])


def _header(stamp_ns: int, frame_id: str) -> Any:
    types = message_types().types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def _vector(values: FloatArray) -> Any:
    x, y, z = map(float, values)
    return message_types().types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def _point(T: FloatArray) -> Any:
    x, y, z = map(float, T[:3, 3])
    return message_types().types["geometry_msgs/msg/Point"](x=x, y=y, z=z)


def _quaternion(T: FloatArray) -> Any:
    x, y, z, w = map(float, Rotation.from_matrix(T[:3, :3]).as_quat())
    return message_types().types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
