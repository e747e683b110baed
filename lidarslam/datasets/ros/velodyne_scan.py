"""velodyne_msgs/VelodyneScan: the packets of a sweep in one message."""

import struct
from typing import Literal

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.datasets.packets.velodyne import decode_sweep, fields_of
from lidarslam.datasets.ros.point_cloud2 import DecodedCloud, coordinates

_PACKET_BYTES = 1206


def decode_scan_message(raw: bytes, ros2: bool) -> DecodedCloud:
    """Decode a serialised velodyne_msgs/VelodyneScan; the times are nanoseconds of the host's clock, as int64.

    Args:
        raw: the message as it stands in the bag.
        ros2: serialised by ROS 2 (CDR: aligned, of either byte order) rather than by ROS 1 (packed).

    Raises:
        InputError: the bytes are no such message, or the library cannot decode them.
    """
    packets = _packets(raw, ros2)
    if not packets:
        return DecodedCloud(np.empty((0, 3)), "time", np.empty(0, np.int64), None, ())
    stamp, cloud = decode_sweep(packets)
    times = round(stamp * 1e9) + np.round(cloud["time"].astype(np.float64) * 1e9).astype(np.int64)
    return DecodedCloud(coordinates(cloud), "time", times, cloud["ring"].copy(), fields_of(cloud), cloud["intensity"])


def _packets(raw: bytes, ros2: bool) -> list[tuple[float, bytes]]:
    """Stamp in seconds and data of each packet of a message."""
    # ROS 1: seq, stamp, frame_id, number of packets, packets one behind the other. CDR: four bytes of encapsulation,
    # the same without seq, everything aligned to four bytes.
    order: Literal["<", ">"] = ">" if ros2 and raw[1:2] == b"\x00" else "<"
    try:
        (characters,) = struct.unpack_from(order + "I", raw, 12)
        start = 16 + (-(-characters // 4) * 4 if ros2 else characters)
        (count,) = struct.unpack_from(order + "I", raw, start)
    except struct.error as error:
        raise InputError(f"a VelodyneScan of {len(raw)} bytes ends too early ({error})") from error
    record = np.dtype([("sec", "u4"), ("nsec", "u4"), ("data", f"V{_PACKET_BYTES}")]).newbyteorder(order)
    step = record.itemsize + (-record.itemsize % 4 if ros2 else 0)
    needed = start + 4 + (count - 1) * step + record.itemsize if count else 0
    if len(raw) < needed:
        raise InputError(f"a VelodyneScan of {count} packets needs {needed} bytes, it has {len(raw)}")
    packets = np.ndarray((count,), record, raw, offset=start + 4, strides=(step,))
    return [(int(packet["sec"]) + int(packet["nsec"]) / 1e9, packet["data"].tobytes()) for packet in packets]
