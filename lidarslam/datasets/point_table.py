"""The points of a scan as stored: the fields of a structured array by their meaning."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan

# In the order of preference; compared without regard to case, and to the prefix of CloudCompare's scalar_Intensity.
TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "stamps", "offset_time", "time_offset", "time_stamp")
_RINGS = ("ring", "channel", "line", "laser_id", "laser", "ring_id", "beam_id", "beam")
_INTENSITIES = (
    "intensity", "intensities", "reflectivity", "reflectance", "remission", "remissions", "i",
)  # fmt: skip
_PREFIX = "scalar_"
_COLOUR_CHANNELS = (("red", "green", "blue"), ("r", "g", "b"))
# One number with the bytes 0xAARRGGBB, often kept as a float32 with the same bits.
_PACKED_COLOURS = ("rgb", "rgba")


@dataclass(frozen=True)
class PointField:
    """One field of the points as stored, such as `intensity`, `float32`."""

    name: str
    type_name: str


@dataclass(frozen=True, eq=False)
class RawCloud:
    """The points of one scan, invalid ones included, in the order in which they are stored."""

    points: FloatArray  # (N, 3) float64, metres, in the LiDAR frame
    time_field: str | None = None  # name of the field the times come from; None without per-point time
    times: NDArray[np.generic] | None = None  # (N,) as stored
    rings: NDArray[np.generic] | None = None  # (N,) as stored, the number of each point's laser
    fields: tuple[PointField, ...] = ()  # all that are stored
    intensities: NDArray[np.float32] | None = None  # (N,) on the scale of the recording
    colours: NDArray[np.uint8] | None = None  # (N, 3) red, green, blue

    @property
    def returns(self) -> NDArray[np.bool_]:
        """Mask (N,) of the points that are returns of the laser; drivers leave any time in the others."""
        return np.asarray(np.isfinite(self.points).all(axis=1) & self.points.any(axis=1))

    def scan(self, stamp: float, offsets: FloatArray | None) -> Scan:
        """The valid points, with the seconds (N,) from the stamp at which they were measured."""
        return Scan.from_raw(self.points, stamp, offsets, self.rings, self.intensities, self.colours)


def raw_cloud(
    table: NDArray[np.void], time_field: str | None = None, fields: tuple[PointField, ...] | None = None
) -> RawCloud:
    """The points of a table (...) of any byte order, copied; the time field is found by its name unless it is given."""
    names = scalar_fields(table)
    time_field, ring_field = find_time_field(names, time_field), _first(names, _RINGS)
    try:
        points = coordinates(table)
    except ValueError as error:
        raise InputError(str(error)) from None
    return RawCloud(
        points,
        time_field,
        None if time_field is None else _column(table[time_field]),
        None if ring_field is None else _column(table[ring_field]),
        fields_of(table) if fields is None else fields,
        read_intensities(table),
        read_colours(table),
    )


def fields_of(table: NDArray[np.void]) -> tuple[PointField, ...]:
    """The names and types of a table's fields."""
    types = ((name, table.dtype[name].base.newbyteorder("=")) for name in table.dtype.names or ())
    return tuple(PointField(name, str(kind)) for name, kind in types)


def scalar_fields(table: NDArray[np.void]) -> tuple[str, ...]:
    """The names of the fields with one number per point."""
    plain = (name for name in table.dtype.names or () if not table.dtype[name].shape)
    return tuple(name for name in plain if table.dtype[name].kind in "fiu")


def find_time_field(names: Sequence[str], wanted: str | None = None) -> str | None:
    """The field with the per-point time: the wanted one, which has to be there, else the first of `TIME_FIELDS`."""
    if wanted is None:
        return _first(names, TIME_FIELDS)
    if wanted not in names:
        raise InputError(f"the points have no time field {wanted!r}; their fields are: {', '.join(names)}")
    return wanted


def _first(names: Sequence[str], wanted: Sequence[str]) -> str | None:
    present = {name.lower().removeprefix(_PREFIX): name for name in reversed(names)}
    return next((present[name] for name in wanted if name in present), None)


def coordinates(table: NDArray[np.void]) -> FloatArray:
    """The fields x, y and z of a table (...) as (N, 3) float64; ValueError where one is missing or no number."""
    present = {name.lower(): name for name in reversed(scalar_fields(table))}
    if not {"x", "y", "z"} <= set(present):
        names = ", ".join(scalar_fields(table))
        raise ValueError(f"expected the point fields x, y and z, each one number, got {names}")
    points = np.empty((*table.shape, 3))
    with np.errstate(invalid="ignore", over="ignore"):  # damaged bytes may be signalling NaN
        for column, name in enumerate("xyz"):
            points[..., column] = table[present[name]]
    return points.reshape(-1, 3)


def _column(values: NDArray[np.generic]) -> NDArray[np.generic]:
    return values.astype(values.dtype.newbyteorder("=")).reshape(-1)


def read_intensities(table: NDArray[np.void]) -> NDArray[np.float32] | None:
    """The intensities (N,) of a table, on the scale they are recorded in; None without any."""
    field = _first(scalar_fields(table), _INTENSITIES)
    if field is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # damaged bytes may be any number
        return table[field].reshape(-1).astype(np.float32)


def read_colours(table: NDArray[np.void]) -> NDArray[np.uint8] | None:
    """The colours (N, 3) of a table: of three channels, or of one that packs them; None without any."""
    present = {name.lower(): name for name in reversed(scalar_fields(table))}
    for channels in _COLOUR_CHANNELS:
        if set(channels) <= set(present):
            return np.column_stack([_as_bytes(table[present[name]].reshape(-1)) for name in channels])
    packed = next((present[name] for name in _PACKED_COLOURS if name in present), None)
    return None if packed is None else _unpacked(table[packed].reshape(-1))


def _unpacked(values: NDArray[np.generic]) -> NDArray[np.uint8] | None:
    if values.dtype.itemsize != 4:
        return None
    bits = values.astype(values.dtype.newbyteorder("=")).view(np.uint32)
    return np.column_stack([(bits >> shift).astype(np.uint8) for shift in (16, 8, 0)])


def _as_bytes(values: NDArray[np.generic]) -> NDArray[np.uint8]:
    """A channel from 0 to 255: 16 bits lose their lower half, floats up to 1 are taken as shares."""
    if values.dtype.kind in "iu" and values.dtype.itemsize == 2:
        return (values.astype(np.uint16) >> 8).astype(np.uint8)
    channel = np.nan_to_num(values.astype(np.float64), posinf=0.0, neginf=0.0)
    if values.dtype.kind == "f" and len(channel) and channel.max() <= 1.0:
        channel = 255.0 * channel
    return np.round(np.clip(channel, 0.0, 255.0)).astype(np.uint8)
