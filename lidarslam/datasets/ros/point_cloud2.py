"""sensor_msgs/PointCloud2: bytes laid out as the message itself says -> NumPy arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointField as PointFieldMessage

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import NO_POINT_TIME, Faults
from lidarslam.datasets.folders.point_table import (
    coordinates,
    find_colour_fields,
    find_intensity_field,
    read_colours,
    read_intensities,
)
from lidarslam.datasets.recording import PointField
from lidarslam.datasets.times.azimuth import Sweep
from lidarslam.datasets.times.point_time import PointTimeModel, TimedCloud, find_ring_field, find_time_field, is_return

# sensor_msgs/PointField, constants INT8 to FLOAT64.
_TYPES = {1: "int8", 2: "uint8", 3: "int16", 4: "uint16", 5: "int32", 6: "uint32", 7: "float32", 8: "float64"}


@dataclass(frozen=True, eq=False)
class DecodedCloud:
    """The points of one message, invalid ones included, in the order of the message."""

    points: FloatArray  # (N, 3) float64, metres, in the LiDAR frame
    time_field: str | None  # name of the field the times come from; None without per-point time
    times: NDArray[np.generic] | None  # (N,) as stored, None without per-point time
    rings: NDArray[np.generic] | None  # (N,) as stored, None when the points do not carry the number of their laser
    fields: tuple[PointField, ...]  # all fields of the message
    intensities: NDArray[np.float32] | None = None  # (N,) as stored, None when the points have none
    colours: NDArray[np.uint8] | None = None  # (N, 3) red, green, blue, None when the points have none

    @property
    def sweep(self) -> Sweep:
        """The points with their lasers."""
        return Sweep(self.points, self.rings)

    def timed(self, stamp: float) -> TimedCloud:
        """The times of the returns."""
        times = None if self.times is None else self.times[is_return(self.points)]
        return TimedCloud(self.time_field, times, stamp)

    def offsets(self, model: PointTimeModel, stamp: float) -> FloatArray | None:
        """Seconds (N,) from the stamp by the time field of the model; None where this cloud lacks it."""
        return None if self.times is None or self.time_field != model.field else model.offsets(self.times, stamp)

    def scan(self, stamp: float, offsets: FloatArray | None, expects_times: bool, faults: Faults) -> Scan:
        """The valid points; a scan without usable point times, where others have them, is counted."""
        scan = Scan.from_raw(self.points, stamp, offsets, self.rings, self.intensities, self.colours)
        if expects_times and scan.time_offsets is None and len(scan):
            faults.note(NO_POINT_TIME, f"{stamp:.9f}")
        return scan


def decode_point_cloud2(message: PointCloud2, time_field: str | None = None) -> DecodedCloud:
    """Copy the used fields of the points out of a message, organised or not, of either byte order, with any padding.

    Args:
        message: of ROS 1 or ROS 2.
        time_field: field with the per-point time; None: found by its name.

    Raises:
        InputError: the message has no x, y and z, not the given time field, or fewer bytes than it declares.
    """
    fields = {field.name: field for field in message.fields}
    names = list(fields)
    if missing := [axis for axis in "xyz" if axis not in fields]:
        raise InputError(f"points need the fields x, y and z, {missing[0]} is missing; they have: {', '.join(names)}")
    time_field, ring_field = find_time_field(names, time_field), find_ring_field(names)
    extras = [name for name in _attribute_fields(names) if _flaw(fields[name], message.point_step) is None]
    wanted = [fields[name] for name in names if name in ("x", "y", "z", time_field, ring_field, *extras)]
    cloud = _view(message, wanted)
    return DecodedCloud(
        coordinates(cloud),
        time_field,
        None if time_field is None else _column(cloud[time_field]),
        None if ring_field is None else _column(cloud[ring_field]),
        tuple(PointField(field.name, _type_name(field)) for field in message.fields),
        read_intensities(cloud, extras),
        read_colours(cloud, extras),
    )


def _attribute_fields(names: Sequence[str]) -> list[str]:
    intensity = find_intensity_field(names)
    return [*([] if intensity is None else [intensity]), *find_colour_fields(names)]


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
    for field in wanted:
        if flaw := _flaw(field, point_step):
            raise InputError(f"point field {field.name!r} {flaw}")
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


def _column(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """A flat copy in the machine's own byte order."""
    return values.astype(values.dtype.newbyteorder("=")).reshape(-1)


def _type_name(field: PointFieldMessage) -> str:
    name = _TYPES.get(field.datatype, f"datatype {field.datatype}")
    return name if field.count <= 1 else f"{name}[{field.count}]"
