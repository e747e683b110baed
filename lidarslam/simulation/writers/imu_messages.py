"""Messages of the IMU: sensor_msgs/Imu."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from lidarslam.core.imu import ImuSamples
from lidarslam.datasets.ros.made_messages import header, vector
from lidarslam.simulation.writers.interface import clock_ns

IMU_TYPE = "sensor_msgs/msg/Imu"


def imu_messages(store: Typestore, imu: ImuSamples, frame_id: str) -> Iterator[tuple[int, Any]]:
    """Stamps in nanoseconds of the clock and messages of samples stamped in simulated seconds."""
    types = store.types
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
                angular_velocity=vector(store, imu.angular_velocities[number]),
                angular_velocity_covariance=unknown,
                linear_acceleration=vector(store, imu.accelerations[number]),
                linear_acceleration_covariance=unknown,
            ),
        )
