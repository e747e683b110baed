"""Fixed transforms between frames, from the messages tf2_msgs/TFMessage on /tf_static, of a bag or others."""

from contextlib import suppress
from typing import Any

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, make_transform
from lidarslam.datasets.ros.bag_file import BagFile
from lidarslam.datasets.ros.bag_message import TRANSFORMS_TYPE, deserialize

_TOPIC = "tf_static"

Edges = dict[str, dict[str, FloatArray]]
"""T_from_to (4, 4) by the names of both frames, in both directions."""


def static_transform(bag: BagFile, target: str, source: str) -> FloatArray | None:
    """T_target_source (4, 4) along the chain of fixed transforms between two frames; None where there is no chain."""
    edges: Edges = {}
    for topic in bag.topics:
        if topic.message_type == TRANSFORMS_TYPE and topic.name.split("/")[-1] == _TOPIC:
            for message in bag.messages(topic):
                add_edges(edges, message.raw, bag.ros2)
    return chain(edges, target, source)


def add_edges(edges: Edges, raw: bytes, ros2: bool) -> None:
    """Add the transforms of a serialised message, as far as it is sound."""
    with suppress(Exception):  # damaged bytes make rosbags raise nearly anything; the others stand
        for stamped in deserialize(raw, TRANSFORMS_TYPE, ros2).transforms:
            parent, child = _name(stamped.header.frame_id), _name(stamped.child_frame_id)
            T_parent_child = _matrix(stamped.transform)
            edges.setdefault(parent, {})[child] = T_parent_child
            edges.setdefault(child, {})[parent] = inverse(T_parent_child)


def chain(edges: Edges, target: str, source: str) -> FloatArray | None:
    """T_target_source (4, 4) along the edges; None where they do not connect the two."""
    reached = {_name(target): np.eye(4)}
    waiting = [_name(target)]
    while waiting:
        frame = waiting.pop()
        for other, T_frame_other in edges.get(frame, {}).items():
            if other not in reached:
                reached[other] = reached[frame] @ T_frame_other
                waiting.append(other)
    return reached.get(_name(source))


def _name(frame_id: str) -> str:
    return frame_id.lstrip("/")


def _matrix(transform: Any) -> FloatArray:
    """(4, 4) of a geometry_msgs/Transform."""
    from scipy.spatial.transform import Rotation  # takes a while to load

    q, t = transform.rotation, transform.translation
    T = make_transform(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [t.x, t.y, t.z])
    if not np.isfinite(T).all():
        raise ValueError("a transform that is not finite")
    return T
