"""Topics of a ROS 2 system over DDS, without ROS; the only file that imports cyclonedds.

ROS 2 maps the topic /points to rt/points, the type sensor_msgs/msg/PointCloud2 to sensor_msgs::msg::dds_::PointCloud2_,
and serialises messages as XCDR1. Messages stay serialised here: the library would make a list of three million numbers
of a cloud, which takes ten times as long as all our own decoding.
"""

import os
from collections.abc import Iterator
from functools import cache
from typing import Any, cast

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from lidarslam.core.errors import InputError
from lidarslam.datasets.ros.bag_message import typestore
from lidarslam.live.messages import Publish
from lidarslam.live.receiving import PublishedTopic, Received

# A cloud of 3 MB arrives as a burst of datagrams that the default buffer, 1 MB, does not hold; the kernel grants up to
# net.core.rmem_max.
_CONFIG = "<CycloneDDS><Domain><Internal><SocketReceiveBufferSize max='32MB'/></Internal></Domain></CycloneDDS>"
_MOST_ENDPOINTS = 10_000
_DEPTH = 10  # messages that are queued in a reader or for a slow subscriber
_NUMBERS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
_BASE_TYPES = {"bool": bool, "string": str, **dict.fromkeys(("byte", "octet", "char"), types.uint8)}
_BASE_TYPES |= {name: getattr(types, name) for name in _NUMBERS}


class DdsNode:
    """A participant in a domain; one at a time in a process.

    The environment variable CYCLONEDDS_URI chooses the network interface and other settings, as for ROS nodes.
    """

    def __init__(self, domain: int) -> None:
        self.domain = domain
        # Held, as the library deletes objects without a reference.
        self._domain = Domain(domain, f"{_CONFIG},{os.environ.get('CYCLONEDDS_URI', '')}".rstrip(","))
        self._participant = DomainParticipant(domain)
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)

    def published(self) -> tuple[PublishedTopic, ...]:
        """The topics of ROS that are published now, as far as they are discovered."""
        reliable: dict[tuple[str, str], bool] = {}
        for endpoint in self._publications.read(_MOST_ENDPOINTS):
            kind = _ros_type(endpoint.type_name or "")
            if endpoint.sample_info.instance_state != InstanceState.Alive or kind is None:
                continue
            if endpoint.topic_name.startswith("rt/"):
                key = (endpoint.topic_name.removeprefix("rt"), kind)
                reliable[key] = reliable.get(key, True) and _is_reliable(endpoint.qos)
        return tuple(sorted(PublishedTopic(*key, is_reliable) for key, is_reliable in reliable.items()))

    def subscribe(self, topic: PublishedTopic, is_kept: bool = False, depth: int = _DEPTH) -> "Subscription":
        """Receive a topic with a queue of this length; of a latched one, such as /tf_static, earlier messages too."""
        qos = _qos(topic.is_reliable, is_kept, depth)
        return Subscription(self._participant, DataReader(self._participant, self._topic(topic), qos), depth)

    def publisher(self, name: str, message_type: str, is_kept: bool = False) -> Publish:
        """Publish serialised messages of a topic, reliably, as ROS does; of a latched one also to later subscribers."""
        topic = self._topic(PublishedTopic(name, message_type))
        writer: Any = DataWriter(self._participant, topic, _qos(True, is_kept))
        return lambda raw: writer.write(writer.data_type.deserialize(raw))

    def _topic(self, topic: PublishedTopic) -> Any:
        return Topic(self._participant, f"rt{topic.name}", _struct(topic.message_type))


class Subscription:
    """The messages of a topic, in the order of arrival."""

    def __init__(self, participant: Any, reader: Any, depth: int) -> None:
        self._reader, self._depth = reader, depth
        self._any = ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any)
        self._waiting = WaitSet(participant)
        self._waiting.attach(self._any)

    def take(self, timeout_s: float) -> Iterator[Received]:
        """The messages that have arrived, after waiting for one at most this long."""
        self._waiting.wait(duration(seconds=timeout_s))
        for message in self._reader.take(self._depth, self._any):
            if message.sample_info.valid_data:  # else a notice that a publisher has gone
                yield Received(message.raw, message.sample_info.source_timestamp)


def open_node(domain: int) -> DdsNode:
    """A participant in the domain; InputError where it cannot join, as with a missing interface in CYCLONEDDS_URI."""
    try:
        return DdsNode(domain)
    except DDSException as error:
        raise InputError(
            f"DDS domain {domain} cannot be joined; CYCLONEDDS_URI has to name a network interface that is there"
        ) from error


def _qos(is_reliable: bool, is_kept: bool, depth: int = _DEPTH) -> Any:
    reliable = Policy.Reliability.Reliable(duration(milliseconds=100))
    return Qos(
        reliable if is_reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if is_kept else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def _is_reliable(qos: Any) -> bool:
    return Policy.Reliability in qos and qos[Policy.Reliability] != Policy.Reliability.BestEffort


def _ros_type(type_name: str) -> str | None:
    package, _, name = type_name.partition("::msg::dds_::")
    return f"{package}/msg/{name[:-1]}" if name.endswith("_") else None


@cache
def _struct(message_type: str) -> Any:
    """The library's type for a ROS message; its objects have the serialised message as `raw`, and nothing else."""
    package, _, name = message_type.split("/")
    _, fields = typestore(ros2=True).fielddefs[message_type]
    members = {field: _member(kind, of) for field, (kind, of) in fields}
    struct: Any = make_idl_struct(f"{name}_", f"{package}::msg::dds_::{name}_", members)

    def of_bytes(raw: bytes, **_: Any) -> Any:
        message = struct.__new__(struct)
        message.raw = raw
        return message

    struct.deserialize = struct.deserialize_key = staticmethod(of_bytes)
    struct.serialize = lambda message, **_: message.raw
    return struct


def _member(kind: int, of: Any) -> Any:
    match kind:
        case Nodetype.BASE:
            return _BASE_TYPES[of[0]]
        case Nodetype.NAME:
            return _struct(of)
    (element, length) = of
    array, sequence = cast(Any, types.array), cast(Any, types.sequence)  # made for annotations alone
    return array[_member(*element), length] if kind == Nodetype.ARRAY else sequence[_member(*element)]
