"""Messages of LiDARs' own drivers: Livox's CustomMsg, and velodyne_msgs/VelodyneScan, the packets of a sweep."""

import struct
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import TimeUnit
from lidarslam.datasets.packets.velodyne import decode_sweep
from lidarslam.datasets.point_table import RawCloud, raw_cloud

CUSTOM_MESSAGE_TYPES = (
    "livox_ros_driver/msg/CustomMsg",
    "livox_ros_driver2/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)
# livox_ros_driver2's own definitions: their checksums name the types, so order and types are as there.
CUSTOM_MESSAGE_DEFINITION = """\
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""
CUSTOM_POINT_DEFINITION = """\
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
TIME_UNIT: TimeUnit = "ns"
# As above; 19 bytes, and in CDR one of padding.
_NAMES = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_POINT = np.dtype({"names": _NAMES, "formats": ("u4", "f4", "f4", "f4", "u1", "u1", "u1")})
_PACKET = np.dtype([("sec", "u4"), ("nsec", "u4"), ("data", "V1206")])
ByteOrder = Literal["<", ">"]


def behind_header(raw: bytes, ros2: bool, alignment: int) -> tuple[ByteOrder, int]:
    """Byte order of a serialised message, and where its first field behind the std_msgs/Header begins.

    ROS 1: seq, stamp, length of frame_id and its characters, packed. ROS 2 (CDR): four bytes of encapsulation, the same
    without seq; a field is aligned to its own size, counted from behind the encapsulation.
    """
    order: ByteOrder = ">" if ros2 and raw[1:2] != b"\x01" else "<"
    (characters,) = struct.unpack_from(f"{order}I", raw, 12)
    return order, 4 + -(-(12 + characters) // alignment) * alignment if ros2 else 16 + characters


def decode_custom_message(raw: bytes, ros2: bool) -> RawCloud:
    """Decode a serialised CustomMsg; the times are nanoseconds of a clock, `timebase + offset_time`, as uint64.

    Args:
        raw: the message as it stands in the bag.
        ros2: serialised by ROS 2 (CDR: aligned, of either byte order) rather than by ROS 1 (packed).
    """
    try:
        # timebase, point_num, lidar_id, rsvd[3], number of points, points
        order, start = behind_header(raw, ros2, 8)
        timebase, count = struct.unpack_from(f"{order}Q8xI", raw, start)
    except struct.error as error:
        raise InputError(f"a Livox CustomMsg of {len(raw)} bytes ends too early ({error})") from error
    cloud = raw_cloud(_records("a Livox CustomMsg", "points", raw, start + 20, count, _POINT.newbyteorder(order), ros2))
    offsets = np.asarray(cloud.times)
    return replace(cloud, times=offsets.astype(np.uint64) + np.uint64(timebase))


def decode_scan_message(raw: bytes, ros2: bool) -> RawCloud:
    """Decode a serialised velodyne_msgs/VelodyneScan; the times are nanoseconds of the host's clock, as int64."""
    # The number of packets, and the packets; in CDR all are aligned to four bytes.
    try:
        order, start = behind_header(raw, ros2, 4)
        (count,) = struct.unpack_from(order + "I", raw, start)
    except struct.error as error:
        raise InputError(f"a VelodyneScan of {len(raw)} bytes ends too early ({error})") from error
    packets = _records("a VelodyneScan", "packets", raw, start + 4, count, _PACKET.newbyteorder(order), ros2)
    if not count:
        return RawCloud(np.empty((0, 3)), "time", np.empty(0, np.int64))
    stamp, table = decode_sweep([(int(p["sec"]) + int(p["nsec"]) / 1e9, p["data"].tobytes()) for p in packets])
    times = round(stamp * 1e9) + np.round(table["time"].astype(np.float64) * 1e9).astype(np.int64)
    return replace(raw_cloud(table, "time"), times=times)


def _records(
    message: str, noun: str, raw: bytes, start: int, count: int, record: np.dtype[Any], ros2: bool
) -> NDArray[np.void]:
    """(count,) records of a message, in CDR aligned to four bytes each; the last may lack its padding."""
    step = record.itemsize + (-record.itemsize % 4 if ros2 else 0)
    needed = start + (count - 1) * step + record.itemsize if count else 0
    if len(raw) < needed:
        raise InputError(f"{message} of {count} {noun} needs {needed} bytes, it has {len(raw)}")
    return np.ndarray((count,), record, raw, offset=start, strides=(step,))
