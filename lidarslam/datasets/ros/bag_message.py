"""Messages of ROS: their headers, which of two times is the scan's stamp, and points of PointCloud2 and of drivers."""

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointField as PointFieldMessage

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import TimeUnit
from lidarslam.datasets.packets.velodyne import decode_sweep
from lidarslam.datasets.point_table import PointField, RawCloud, find_time_field, raw_cloud

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
POINT_CLOUD2_TYPE = "sensor_msgs/msg/PointCloud2"
TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"
TRANSFORMS_DEFINITION = "geometry_msgs/TransformStamped[] transforms"
CLOUD_TYPES = (POINT_CLOUD2_TYPE, *CUSTOM_MESSAGE_TYPES)
# Packets of a sensor that can be decoded: a sweep in a message, a packet in a message.
VELODYNE_SCAN_TYPE = "velodyne_msgs/msg/VelodyneScan"
OUSTER_PACKET_TYPES = tuple(
    f"{package}/msg/PacketMsg" for package in ("ouster_ros", "ouster_sensor_msgs", "ouster_msgs")
)

# sensor_msgs/PointField, constants INT8 to FLOAT64.
_TYPES = {1: "int8", 2: "uint8", 3: "int16", 4: "uint16", 5: "int32", 6: "uint32", 7: "float32", 8: "float64"}
_LONGEST_FRAME_ID = 256
# Up to the end of a header's frame; a shorter message is none.
_SHORTEST_MESSAGE = 16
# If more stamps than this are equal among the first messages of a topic, they are no measurements.
_MESSAGES_LOOKED_AT, _FEW = 10, 3
# Stamps beyond this (1973) read a clock, and a zero among them was never set; simulated time starts at zero.
_CLOCK_NS = 10**17


@dataclass(frozen=True)
class BagMessage:
    """One message, not decoded."""

    record_ns: int  # time of recording, nanoseconds
    header_ns: int  # time stamp of its header, nanoseconds
    frame_id: str  # of its header, the sensor's frame
    message_type: str
    raw: bytes
    damage: str | None = None  # why it is no message; it has neither stamp nor frame then


def read_header(raw: bytes, ros2: bool) -> tuple[int, str]:
    """Time stamp in nanoseconds and frame of a serialised message that begins with a std_msgs/Header.

    They stand at fixed places, so that the message need not be decoded; ValueError where it is no such message.
    """
    if not isinstance(raw, bytes):  # a database may hold numbers and text too
        raise ValueError("a message that is no bytes")
    if len(raw) < _SHORTEST_MESSAGE:
        raise ValueError(f"a message of {len(raw)} bytes, too few for its header")
    if ros2 and raw[0] != 0:
        raise ValueError(
            "it is not plain CDR; if the bag's messages are compressed, give the rosbag2 folder with its metadata.yaml"
            " instead of the file"
        )
    order = ">" if ros2 and raw[1] != 1 else "<"
    seconds, nanoseconds, characters = struct.unpack_from(f"{order}{'i' if ros2 else 'I'}II", raw, 4)
    frame_id = raw[16 : 16 + min(characters, _LONGEST_FRAME_ID)].rstrip(b"\0").decode(errors="replace")
    return int(seconds) * 10**9 + int(nanoseconds), frame_id


def decode(message: BagMessage, ros2: bool, time_field: str | None) -> RawCloud:
    """Decode a message of one of the `CLOUD_TYPES`, or a sweep of packets, by fixed definitions.

    Those in the bag are not used: the definition of PointCloud2 has not changed, bags may lack definitions, and a
    damaged definition of some other topic must not matter.
    """
    if message.message_type in CUSTOM_MESSAGE_TYPES:
        return decode_custom_message(message.raw, ros2)
    if message.message_type == VELODYNE_SCAN_TYPE:
        return decode_scan_message(message.raw, ros2)
    cloud = cast(PointCloud2, deserialize(message.raw, POINT_CLOUD2_TYPE, ros2))
    return decode_point_cloud2(cloud, time_field)


def behind_header(raw: bytes, ros2: bool, alignment: int) -> tuple[ByteOrder, int]:
    """Byte order of a serialised message, and where its first field behind the std_msgs/Header begins.

    ROS 1: seq, stamp, length of frame_id and its characters, packed. ROS 2 (CDR): four bytes of encapsulation, the same
    without seq; a field is aligned to its own size, counted from behind the encapsulation.
    """
    order: ByteOrder = ">" if ros2 and raw[1:2] != b"\x01" else "<"
    (characters,) = struct.unpack_from(f"{order}I", raw, 12)
    return order, 4 + -(-(12 + characters) // alignment) * alignment if ros2 else 16 + characters


def decode_custom_message(raw: bytes, ros2: bool) -> RawCloud:
    """Decode a serialised CustomMsg; the times are nanoseconds of a clock, `timebase + offset_time`, as uint64."""
    # timebase, point_num, lidar_id, rsvd[3], number of points
    (timebase, _), points = _records("a Livox CustomMsg", "points", raw, ros2, "Q8xI", _POINT)
    cloud = raw_cloud(points)
    return replace(cloud, times=np.asarray(cloud.times).astype(np.uint64) + np.uint64(timebase))


def decode_scan_message(raw: bytes, ros2: bool) -> RawCloud:
    """Decode a serialised velodyne_msgs/VelodyneScan; the times are nanoseconds of the host's clock, as int64."""
    _, packets = _records("a VelodyneScan", "packets", raw, ros2, "I", _PACKET)
    if not len(packets):
        return RawCloud(np.empty((0, 3)), "time", np.empty(0, np.int64))
    stamp, table = decode_sweep([(int(p["sec"]) + int(p["nsec"]) / 1e9, p["data"].tobytes()) for p in packets])
    times = round(stamp * 1e9) + np.round(table["time"].astype(np.float64) * 1e9).astype(np.int64)
    return replace(raw_cloud(table, "time"), times=times)


def _records(
    message: str, noun: str, raw: bytes, ros2: bool, head: str, record: np.dtype[Any]
) -> tuple[tuple[int, ...], NDArray[np.void]]:
    """The values between a message's header and its records, in struct's letters, and the records (N,).

    The last of the values is N. In CDR records are aligned to four bytes each; the last may lack its padding.
    """
    try:
        order, start = behind_header(raw, ros2, struct.calcsize(head[0]))
        values = struct.unpack_from(order + head, raw, start)
    except struct.error as error:
        raise InputError(f"{message} of {len(raw)} bytes ends too early ({error})") from error
    start, count = start + struct.calcsize(order + head), values[-1]
    step = record.itemsize + (-record.itemsize % 4 if ros2 else 0)
    needed = start + (count - 1) * step + record.itemsize if count else 0
    if len(raw) < needed:
        raise InputError(f"{message} of {count} {noun} needs {needed} bytes, it has {len(raw)}")
    return values, np.ndarray((count,), record.newbyteorder(order), raw, offset=start, strides=(step,))


def decode_point_cloud2(message: PointCloud2, time_field: str | None = None) -> RawCloud:
    """Copy the points out of a message, organised or not, of either byte order, with any padding."""
    fields = {field.name: field for field in message.fields}
    if missing := [axis for axis in "xyz" if axis not in fields]:
        raise InputError(f"points need the fields x, y and z, {missing[0]} is missing; they have: {', '.join(fields)}")
    flaws = {name: flaw for name, field in fields.items() if (flaw := _flaw(field, message.point_step)) is not None}
    for name in ("x", "y", "z", find_time_field(list(fields), time_field)):
        if name in flaws:
            raise InputError(f"point field {name!r} {flaws[name]}")
    table = _view(message, [field for name, field in fields.items() if name not in flaws])
    return raw_cloud(table, time_field, tuple(PointField(field.name, _type_name(field)) for field in message.fields))


def _view(message: PointCloud2, wanted: Sequence[PointFieldMessage]) -> NDArray[np.void]:
    """The message's bytes as an array (height, width) of records with the wanted fields."""
    height, width, point_step = message.height, message.width, message.point_step
    row_step = max(message.row_step, width * point_step)  # some drivers leave it zero
    needed = (height - 1) * row_step + width * point_step if height and width else 0
    if len(message.data) < needed:
        raise InputError(
            f"a point cloud of {height} x {width} points of {point_step} bytes needs {needed} bytes,"
            f" the message holds {len(message.data)}"
        )
    record = np.dtype(
        {
            "names": [field.name for field in wanted],
            "formats": [_TYPES[field.datatype] for field in wanted],  # of several values the first is read
            "offsets": [field.offset for field in wanted],
            "itemsize": point_step,
        }
    ).newbyteorder(">" if message.is_bigendian else "<")
    return np.ndarray((height, width), record, np.ascontiguousarray(message.data), strides=(row_step, point_step))


def _flaw(field: PointFieldMessage, point_step: int) -> str | None:
    if field.datatype not in _TYPES:
        return f"has the unknown datatype {field.datatype}; known are 1 to 8"
    if field.offset + np.dtype(_TYPES[field.datatype]).itemsize > point_step:
        return f"reaches beyond the {point_step} bytes of a point"
    return None


def _type_name(field: PointFieldMessage) -> str:
    name = _TYPES.get(field.datatype, f"datatype {field.datatype}")
    return name if field.count <= 1 else f"{name}[{field.count}]"


def deserialize(raw: bytes, message_type: str, ros2: bool) -> Any:
    """A message of a type that ROS itself defines, by its fixed definition."""
    store = typestore(ros2)
    return (store.deserialize_cdr if ros2 else store.deserialize_ros1)(raw, message_type)


def serialize(message: Any, ros2: bool) -> bytes:
    """The bytes of a message made with `typestore`: CDR in ROS 2, packed in ROS 1."""
    store = typestore(ros2)
    return bytes((store.serialize_cdr if ros2 else store.serialize_ros1)(message, message.__msgtype__))


@cache
def typestore(ros2: bool) -> Typestore:
    """The definitions of all message types in use."""
    store = get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)
    if TRANSFORMS_TYPE not in store.types:  # ROS 1 has it in another package than rosbags knows
        store.register(get_types_from_msg(TRANSFORMS_DEFINITION, TRANSFORMS_TYPE))
    for message_type in CUSTOM_MESSAGE_TYPES:
        point_type = message_type.replace("CustomMsg", "CustomPoint")
        store.register(get_types_from_msg(CUSTOM_POINT_DEFINITION, point_type))
        store.register(get_types_from_msg(CUSTOM_MESSAGE_DEFINITION, message_type))
    return store


@dataclass(frozen=True)
class StampSource:
    """How the messages of one topic are stamped."""

    from_header: bool  # the stamps are those of the headers, else the times of recording
    before_first: float  # stamps up to this one, seconds, were never set

    def stamp(self, message: BagMessage) -> float:
        """The scan's stamp in seconds."""
        return (message.header_ns if self.from_header else message.record_ns) / 10**9


def find_stamp_source(messages: Iterable[BagMessage]) -> StampSource:
    """By the first few messages of a topic: those of the headers, unless the driver never updates them."""
    stamps_ns = [message.header_ns for message in islice(messages, _MESSAGES_LOOKED_AT)]
    first_ns = next((stamp_ns for stamp_ns in stamps_ns if stamp_ns), None)
    if first_ns is None or (len(stamps_ns) > _FEW and len(set(stamps_ns)) == 1):
        return StampSource(from_header=False, before_first=-math.inf)
    return StampSource(from_header=True, before_first=0.0 if first_ns > _CLOCK_NS else -math.inf)
