"""The IMU of a bag: its topic, its messages sensor_msgs/Imu, and its extrinsic from /tf_static."""

import re
from contextlib import suppress
from itertools import islice
from typing import Any

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.core.text import count, in_common
from lidarslam.datasets.imu_samples import usable_samples
from lidarslam.datasets.recording import Topic
from lidarslam.datasets.ros.bag_file import BagFile
from lidarslam.datasets.ros.bag_message import (
    TRANSFORMS_TYPE,
    StampSource,
    behind_header,
    deserialize,
    find_stamp_source,
)

_TOPIC = "tf_static"

Edges = dict[str, dict[str, FloatArray]]
"""T_from_to (4, 4) by the names of both frames, in both directions."""
IMU_TYPE = "sensor_msgs/msg/Imu"
# Behind the header, in float64: orientation 4, its covariance 9, angular velocity 3, covariance 9, acceleration 3, 9.
_NUMBERS = 37
ANGULAR_VELOCITY, ACCELERATION = slice(13, 16), slice(25, 28)


def static_transform(bag: BagFile, target: str, source: str) -> FloatArray | None:
    """T_target_source (4, 4) along the chain of fixed transforms between two frames; None where there is no chain."""
    edges: Edges = {}
    for topic in bag.topics:
        if topic.message_type == TRANSFORMS_TYPE and topic.name.split("/")[-1] == _TOPIC:
            for message in bag.messages(topic):
                add_edges(edges, message.raw, bag.ros2)
    return chain(edges, target, source)


def add_edges(edges: Edges, raw: bytes, ros2: bool) -> None:
    """Add the transforms of a serialised message, as far as it is intact."""
    with suppress(Exception):  # damaged bytes make rosbags raise nearly anything; the others remain
        for stamped in deserialize(raw, TRANSFORMS_TYPE, ros2).transforms:
            parent, child = stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")
            T_parent_child = _matrix(stamped.transform)
            edges.setdefault(parent, {})[child] = T_parent_child
            edges.setdefault(child, {})[parent] = inverse(T_parent_child)


def chain(edges: Edges, target: str, source: str) -> FloatArray | None:
    """T_target_source (4, 4) along the edges; None where they do not connect the two."""
    reached = {target.lstrip("/"): np.eye(4)}
    waiting = [target.lstrip("/")]
    while waiting:
        frame = waiting.pop()
        for other, T_frame_other in edges.get(frame, {}).items():
            if other not in reached:
                reached[other] = reached[frame] @ T_frame_other
                waiting.append(other)
    return reached.get(source.lstrip("/"))


def _matrix(transform: Any) -> FloatArray:
    from scipy.spatial.transform import Rotation  # takes a while to load

    q, t = transform.rotation, transform.translation
    T = make_transform(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [t.x, t.y, t.z])
    if not np.isfinite(T).all():
        raise ValueError("a transform that is not finite")
    return T


def read_imu(
    bag: BagFile, topic: Topic, lidar_frame: str, stamps: StampSource, most: int | None = None
) -> ImuSamples | None:
    """The samples of a topic, or the first of them; None where there are none. Frame and stamps are of the clouds."""
    messages = islice(bag.messages(topic), most)
    found = [(m, None if m.damage is not None else imu_numbers(m.raw, bag.ros2)) for m in messages]
    sound = [message for message, numbers in found if numbers is not None]
    if not sound:
        return None
    source = find_stamp_source(sound) if stamps.from_header else stamps
    times = np.array([source.stamp(message) for message in sound])
    times[times <= source.before_first] = np.nan
    notes: tuple[str, ...] = ()
    if sound[0].frame_id.lstrip("/") == lidar_frame.lstrip("/"):
        T_lidar_imu: FloatArray | None = np.eye(4)
        said = f"LiDAR and IMU share the frame {lidar_frame!r}"
        notes = (f"{said}, so the IMU is taken to have the LiDAR's axes and place.",)
    else:
        T_lidar_imu = static_transform(bag, lidar_frame, sound[0].frame_id)
    if damaged := len(found) - len(sound):
        notes = (*notes, f"{count(damaged, 'damaged IMU message')} left out.")
    table = np.stack([numbers for _, numbers in found if numbers is not None])
    return usable_samples(times, table[:, ANGULAR_VELOCITY], table[:, ACCELERATION], T_lidar_imu, notes)


def choose_imu(bag: BagFile, clouds: str, lidar_frame: str, wanted: str | None) -> Topic | None:
    """The wanted topic, or of several the nearest by the names of topic and frame, of these the fastest."""
    imus = [topic for topic in bag.topics if topic.message_type == IMU_TYPE and topic.messages]
    if wanted is not None:
        named = (topic for topic in imus if topic.name.lstrip("/") == wanted.lstrip("/"))
        if (found := next(named, None)) is None:
            listed = ", ".join(topic.name for topic in imus) or "none"
            raise InputError(f"{bag.path}: reader.imu_topic is {wanted!r}; its IMU topics: {listed}")
        return found
    if len(imus) < 2:
        return imus[0] if imus else None

    def nearness(topic: Topic) -> tuple[int, int]:
        message = next((one for one in bag.messages(topic) if one.damage is None), None)
        frame_id = "" if message is None else message.frame_id
        names = _shared(topic.name, clouds.rpartition("/")[0])
        return names + _shared(frame_id, lidar_frame, "[/_]"), topic.messages

    return max(imus, key=nearness)


def _shared(first: str, second: str, separator: str = "/") -> int:
    return in_common(*(re.split(separator, name.lstrip("/")) for name in (first, second)))


def imu_numbers(raw: bytes, ros2: bool) -> FloatArray | None:
    """The numbers (37,) of a serialised message, all of one size behind its header; None if it is cut off."""
    order, start = behind_header(raw, ros2, 8)
    if len(raw) < start + 8 * _NUMBERS:
        return None
    return np.frombuffer(raw, f"{order}f8", _NUMBERS, start).astype(np.float64)
