"""sensor_msgs/PointCloud2: bytes laid out as the message itself says -> NumPy arrays."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointField as PointFieldMessage

from lidarslam.core.errors import InputError
from lidarslam.datasets.folders.point_table import PointField, RawCloud, find_time_field, raw_cloud

# sensor_msgs/PointField, constants INT8 to FLOAT64.
_TYPES = {1: "int8", 2: "uint8", 3: "int16", 4: "uint16", 5: "int32", 6: "uint32", 7: "float32", 8: "float64"}


def decode_point_cloud2(message: PointCloud2, time_field: str | None = None) -> RawCloud:
    """Copy the points out of a message, organised or not, of either byte order, with any padding.

    Args:
        message: of ROS 1 or ROS 2.
        time_field: field with the per-point time; None: found by its name.
    """
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
    """Why a field cannot be read."""
    if field.datatype not in _TYPES:
        return f"has the unknown datatype {field.datatype}; known are 1 to 8"
    if field.offset + np.dtype(_TYPES[field.datatype]).itemsize > point_step:
        return f"reaches beyond the {point_step} bytes of a point"
    return None


def _type_name(field: PointFieldMessage) -> str:
    name = _TYPES.get(field.datatype, f"datatype {field.datatype}")
    return name if field.count <= 1 else f"{name}[{field.count}]"
