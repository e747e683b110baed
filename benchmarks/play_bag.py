"""Simulated robot: publishes the clouds of a ROS 2 bag over DDS at a fixed rate, as `ros2 bag play` does.

    python benchmarks/play_bag.py RECORDING --topic /points [--domain 0] [--rate 10] [--restamp] [--pad 65536]

Needs the extra `live`. Publishing begins with the first subscriber. --restamp stamps each message with its due time;
--pad adds points at the origin, as organised clouds have without a return.
"""

import argparse
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, types
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

TYPE = "sensor_msgs/msg/PointCloud2"
_STAMP_AT = 4  # after the encapsulation


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: types.int32
    nanosec: types.uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class PointField(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    name: str
    offset: types.uint32
    datatype: types.uint8
    count: types.uint32


@dataclass
class PointCloud2(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    """A cloud, as ROS 2 names it on the wire."""

    header: Header
    height: types.uint32
    width: types.uint32
    fields: types.sequence[PointField]  # type: ignore[type-arg]
    is_bigendian: bool
    point_step: types.uint32
    row_step: types.uint32
    data: types.sequence[types.uint8]  # type: ignore[type-arg]
    is_dense: bool

    raw = b""

    def serialize(self, *_: Any, **__: Any) -> bytes:
        """The message, which is already serialised."""
        return self.raw


def read_messages(recording: Path) -> Iterator[bytes]:
    """The clouds of a bag, serialised."""
    with AnyReader([recording]) as bag:
        clouds = [connection for connection in bag.connections if connection.msgtype == TYPE]
        for _, _, raw in bag.messages(clouds):
            yield bytes(raw)


def pad(raw: bytes, points: int) -> bytes:
    """The cloud padded with points at the origin to a number of points in 64 rows."""
    store = get_typestore(Stores.ROS2_JAZZY)
    cloud: Any = store.deserialize_cdr(raw, TYPE)
    data = np.zeros(points * cloud.point_step, np.uint8)
    data[: len(cloud.data)] = cloud.data[: len(data)]
    width = points // 64
    padded = replace(cloud, height=64, width=width, row_step=width * cloud.point_step, data=data)
    return bytes(store.serialize_cdr(padded, TYPE))


def stamped(raw: bytes, stamp_ns: int) -> bytes:
    """The message with another stamp."""
    return raw[:_STAMP_AT] + struct.pack("<iI", stamp_ns // 10**9, stamp_ns % 10**9) + raw[_STAMP_AT + 8 :]


def make_writer(topic: str, domain: int, is_reliable: bool) -> Any:
    """Writer of clouds with the quality of service of sensor data, or reliable."""
    participant = DomainParticipant(domain)
    reliability = Policy.Reliability.Reliable(duration(seconds=1)) if is_reliable else Policy.Reliability.BestEffort
    representation = Policy.DataRepresentation(use_cdrv0_representation=True)
    qos = Qos(reliability, Policy.History.KeepLast(5), representation)
    return DataWriter(participant, Topic(participant, f"rt{topic}", PointCloud2), qos)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--topic", default="/points")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--rate", type=float, default=10.0, help="messages per second")
    parser.add_argument("--scans", type=int, help="number of scans")
    parser.add_argument("--restamp", action="store_true")
    parser.add_argument("--reliable", action="store_true")
    parser.add_argument("--pad", type=int, metavar="POINTS")
    parser.add_argument("--linger", type=float, default=1.0, help="seconds before exit")
    given = parser.parse_args()
    messages = list(zip(range(given.scans or 10**9), read_messages(given.recording), strict=False))
    writer = make_writer(given.topic, given.domain, given.reliable)
    print(f"{len(messages)} clouds on {given.topic}, waiting for a subscriber", flush=True)
    while not writer.get_matched_subscriptions():
        time.sleep(0.01)
    begin = time.time() + 0.5
    late = 0
    message = PointCloud2.__new__(PointCloud2)
    for number, raw in messages:
        padded = raw if given.pad is None else pad(raw, given.pad)
        due = begin + number / given.rate
        late += time.time() > due + 0.5 / given.rate
        time.sleep(max(0.0, due - time.time()))
        message.raw = stamped(padded, round(1e9 * due)) if given.restamp else padded
        writer.write(message)
    print(f"sent {len(messages)} clouds in {time.time() - begin:.1f} s, {late} of them late", flush=True)
    time.sleep(given.linger)


if __name__ == "__main__":
    main()
