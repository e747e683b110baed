"""Messages of the IMU: sensor_msgs/Imu, and the tf2_msgs/TFMessage that places it on the LiDAR."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.datasets.ros.bag_message import TRANSFORMS_TYPE
from lidarslam.simulation.writers.interface import clock_ns

IMU_TYPE = "sensor_msgs/msg/Imu"
STATIC_TRANSFORMS = "/tf_static"


def header(store: Typestore, stamp_ns: int, frame_id: str, sequence: int) -> Any:
    """A std_msgs/Header; ROS 1 counts messages in it."""
    stamp = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    message_type: Any = store.types["std_msgs/msg/Header"]
    counted = {"seq": sequence} if "seq" in message_type.__annotations__ else {}
    return message_type(stamp=stamp, frame_id=frame_id, **counted)


def imu_messages(store: Typestore, imu: ImuSamples, frame_id: str) -> Iterator[tuple[int, Any]]:
    """Stamps in nanoseconds of the clock and messages of samples stamped in simulated seconds."""
    types, vector = store.types, store.types["geometry_msgs/msg/Vector3"]
    orientation, unknown = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0), np.zeros(9)
    no_orientation = np.array([-1.0, *[0.0] * 8])  # as the message's definition has it
    for number, stamp in enumerate(imu.stamps):
        stamp_ns = clock_ns(stamp)
        yield (
            stamp_ns,
            types[IMU_TYPE](
                header=header(store, stamp_ns, frame_id, number),
                orientation=orientation,
                orientation_covariance=no_orientation,
                angular_velocity=vector(*imu.angular_velocities[number].tolist()),
                angular_velocity_covariance=unknown,
                linear_acceleration=vector(*imu.accelerations[number].tolist()),
                linear_acceleration_covariance=unknown,
            ),
        )


def static_transform(store: Typestore, stamp_ns: int, parent: str, child: str, T_parent_child: FloatArray) -> Any:
    """The message with one transform."""
    x, y, z, w = Rotation.from_matrix(T_parent_child[:3, :3]).as_quat().tolist()
    transform = store.types["geometry_msgs/msg/Transform"](
        translation=store.types["geometry_msgs/msg/Vector3"](*T_parent_child[:3, 3].tolist()),
        rotation=store.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
    )
    stamped = store.types["geometry_msgs/msg/TransformStamped"](
        header=header(store, stamp_ns, parent, 0), child_frame_id=child, transform=transform
    )
    return store.types[TRANSFORMS_TYPE](transforms=[stamped])
