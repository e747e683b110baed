"""Messages of ROS 1 and ROS 2, made of poses and points; the store of types decides which ROS it is."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.ros.bag_message import POINT_CLOUD2_TYPE, TRANSFORMS_TYPE

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
# Rotation first, as errors and velocities have it here, to translation first, as ROS has it.
_ROS_ORDER = (3, 4, 5, 0, 1, 2)


def header(store: Typestore, stamp_ns: int, frame_id: str, sequence: int = 0) -> Any:
    """A std_msgs/Header; ROS 1 counts messages in it."""
    stamp = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    message_type: Any = store.types["std_msgs/msg/Header"]
    counted = {"seq": sequence} if "seq" in message_type.__annotations__ else {}
    return message_type(stamp=stamp, frame_id=frame_id, **counted)


def vector(store: Typestore, values: FloatArray) -> Any:
    """A geometry_msgs/Vector3 of (3,)."""
    return store.types["geometry_msgs/msg/Vector3"](*values.tolist())


def pose(store: Typestore, T: FloatArray) -> Any:
    """A geometry_msgs/Pose of (4, 4)."""
    point = store.types["geometry_msgs/msg/Point"](*T[:3, 3].tolist())
    return store.types["geometry_msgs/msg/Pose"](position=point, orientation=_quaternion(store, T))


def transforms(store: Typestore, *poses: tuple[Any, str, FloatArray]) -> Any:
    """A tf2_msgs/TFMessage; of each transform the parent's header, the child's frame and T_parent_child (4, 4)."""
    stamped_type, stamped = store.types["geometry_msgs/msg/TransformStamped"], []
    for parent_header, child, T_parent_child in poses:
        transform = store.types["geometry_msgs/msg/Transform"](
            translation=vector(store, T_parent_child[:3, 3]), rotation=_quaternion(store, T_parent_child)
        )
        stamped.append(stamped_type(header=parent_header, child_frame_id=child, transform=transform))
    return store.types[TRANSFORMS_TYPE](transforms=stamped)


def odometry(
    store: Typestore,
    fixed_header: Any,
    child_frame_id: str,
    T_fixed_child: FloatArray,
    covariance: FloatArray | None,
    velocity: FloatArray | None,
) -> Any:
    """A nav_msgs/Odometry; covariance (6, 6) and velocity (6,) are in the frame of the body, rotation first."""
    types = store.types
    ros_covariance = np.zeros(36) if covariance is None else in_fixed_frame(covariance, T_fixed_child).ravel()
    angular, linear = np.zeros((2, 3)) if velocity is None else velocity.reshape(2, 3)
    twist = types["geometry_msgs/msg/Twist"](linear=vector(store, linear), angular=vector(store, angular))
    return types[ODOMETRY_TYPE](
        header=fixed_header,
        child_frame_id=child_frame_id,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose(store, T_fixed_child), covariance=ros_covariance),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )


def in_fixed_frame(covariance: FloatArray, T_fixed_child: FloatArray) -> FloatArray:
    """The covariance (6, 6) as ROS has it: along and about the axes of the fixed frame, translation first."""
    rotate = np.kron(np.eye(2), T_fixed_child[:3, :3])
    return np.asarray((rotate @ covariance @ rotate.T)[np.ix_(_ROS_ORDER, _ROS_ORDER)])


def point_cloud(store: Typestore, cloud_header: Any, records: NDArray[np.void]) -> Any:
    """A sensor_msgs/PointCloud2 of structured records (N,)."""
    point_field: Any = store.types["sensor_msgs/msg/PointField"]
    # The message names its constants FLOAT32, UINT16 and so on, as NumPy names its types.
    fields = [
        point_field(name=name, offset=offset, datatype=getattr(point_field, kind.name.upper()), count=1)
        for name, (kind, offset, *_) in (records.dtype.fields or {}).items()
    ]
    step, count = records.dtype.itemsize, len(records)
    return store.types[POINT_CLOUD2_TYPE](
        header=cloud_header,
        height=1,
        width=count,
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * count,
        data=np.frombuffer(records.tobytes(), np.uint8),
        is_dense=True,
    )


def _quaternion(store: Typestore, T: FloatArray) -> Any:
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return store.types["geometry_msgs/msg/Quaternion"](*quaternion.tolist())
