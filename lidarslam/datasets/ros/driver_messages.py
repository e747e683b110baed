"""Messages of LiDARs' own drivers: Livox's CustomMsg, and velodyne_msgs/VelodyneScan, the packets of a sweep."""

import struct
from typing import Literal

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import TimeUnit
from lidarslam.datasets.folders.point_table import coordinates
from lidarslam.datasets.packets.velodyne import decode_sweep, fields_of
from lidarslam.datasets.recording import PointField
from lidarslam.datasets.ros.point_cloud2 import DecodedCloud

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
TIME_FIELD = "offset_time"
TIME_UNIT: TimeUnit = "ns"

# livox_ros_driver2/msg/CustomPoint.msg, in its order; 19 bytes.
_NAMES = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_POINT = np.dtype({"names": _NAMES, "formats": ("u4", "f4", "f4", "f4", "u1", "u1", "u1")})
_FIELDS = tuple(PointField(name, str(_POINT[name])) for name in _NAMES)
_CDR_ALIGNED_POINT = 20
ByteOrder = Literal["<", ">"]
_PACKET_BYTES = 1206


def behind_header(raw: bytes, ros2: bool, alignment: int) -> tuple[ByteOrder, int]:
    """Byte order of a serialised message, and where its first field behind the std_msgs/Header begins.

    ROS 1: seq, stamp, length of frame_id and its characters, packed. ROS 2 (CDR): four bytes of encapsulation, the same
    without seq; a field is aligned to its own size, counted from behind the encapsulation.
    """
    order: ByteOrder = ">" if ros2 and raw[1:2] != b"\x01" else "<"
    (characters,) = struct.unpack_from(f"{order}I", raw, 12)
    return order, 4 + -(-(12 + characters) // alignment) * alignment if ros2 else 16 + characters


def decode_custom_message(raw: bytes, ros2: bool) -> DecodedCloud:
    """Decode a serialised CustomMsg; the times are nanoseconds of a clock, `timebase + offset_time`, as uint64.

    Args:
        raw: the message as it stands in the bag.
        ros2: serialised by ROS 2 (CDR: aligned, of either byte order) rather than by ROS 1 (packed).

    Raises:
        InputError: the bytes are not such a message.
    """
    try:
        # timebase, point_num, lidar_id, rsvd[3], number of points, points
        order, start = behind_header(raw, ros2, 8)
        timebase, count = struct.unpack_from(f"{order}Q8xI", raw, start)
    except struct.error as error:
        raise InputError(f"a Livox CustomMsg of {len(raw)} bytes ends too early ({error})") from error
    return _points(raw, start + 20, count, timebase, order, packed=not ros2)


def _points(raw: bytes, start: int, count: int, timebase: int, order: ByteOrder, packed: bool) -> DecodedCloud:
    record = _POINT.newbyteorder(order)
    step = record.itemsize if packed else _CDR_ALIGNED_POINT
    # The last point of an aligned message may or may not be followed by its byte of padding.
    needed = (count - 1) * step + record.itemsize if count else 0
    if len(raw) - start < needed:
        raise InputError(f"a Livox CustomMsg of {count} points needs {start + needed} bytes, it has {len(raw)}")
    cloud = np.ndarray((count,), record, raw, offset=start, strides=(step,))
    times = cloud[TIME_FIELD].astype(np.uint64) + np.uint64(timebase)
    reflectivity = cloud["reflectivity"].astype(np.float32)
    return DecodedCloud(coordinates(cloud), TIME_FIELD, times, cloud["line"].copy(), _FIELDS, reflectivity)


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
    # The number of packets, and the packets; in CDR all are aligned to four bytes.
    try:
        order, start = behind_header(raw, ros2, 4)
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
