"""Fields of points in a structured array."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

# In the order of preference; compared without regard to case. CloudCompare writes scalar_Intensity.
_INTENSITY = (
    "intensity", "intensities", "scalar_intensity", "reflectivity", "reflectance", "remission", "remissions", "i",
)  # fmt: skip
_COLOUR_CHANNELS = (("red", "green", "blue"), ("r", "g", "b"))
# One number with the bytes 0xAARRGGBB, often kept as a float32 with the same bits.
_PACKED_COLOURS = ("rgb", "rgba")


def scalar_fields(table: NDArray[np.void]) -> tuple[str, ...]:
    """The names of the fields with one number per point."""
    plain = (name for name in table.dtype.names or () if not table.dtype[name].shape)
    return tuple(name for name in plain if table.dtype[name].kind in "fiu")


def coordinates(table: NDArray[np.void]) -> FloatArray:
    """The fields x, y and z of a table (...) as (N, 3) float64.

    Raises:
        ValueError: a field is missing or is no number.
    """
    names = scalar_fields(table)
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"expected the point fields x, y and z, each one number, got {', '.join(names)}")
    points = np.empty((*table.shape, 3))
    with np.errstate(invalid="ignore", over="ignore"):  # damaged bytes may be signalling NaN
        for column, name in enumerate("xyz"):
            points[..., column] = table[name]
    return points.reshape(-1, 3)


def find_intensity_field(names: Sequence[str]) -> str | None:
    """The field with the intensity; None without any."""
    present = {name.lower(): name for name in reversed(names)}
    return next((present[name] for name in _INTENSITY if name in present), None)


def find_colour_fields(names: Sequence[str]) -> tuple[str, ...]:
    """The fields with the colour: three channels, or one that packs them; empty without any."""
    present = {name.lower(): name for name in reversed(names)}
    for channels in _COLOUR_CHANNELS:
        if set(channels) <= set(present):
            return tuple(present[name] for name in channels)
    return tuple(present[name] for name in _PACKED_COLOURS if name in present)[:1]


def read_intensities(table: NDArray[np.void], names: Sequence[str]) -> NDArray[np.float32] | None:
    """The intensities (N,) of records with these readable fields, on the scale they are recorded in."""
    field = find_intensity_field(names)
    if field is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # damaged bytes may be any number
        return table[field].reshape(-1).astype(np.float32)


def read_colours(table: NDArray[np.void], names: Sequence[str]) -> NDArray[np.uint8] | None:
    """The colours (N, 3) of records with these readable fields; None without any, or of an unknown type."""
    fields = find_colour_fields(names)
    if len(fields) == 1:
        return _unpacked(table[fields[0]].reshape(-1))
    columns = [_as_bytes(table[field].reshape(-1)) for field in fields]
    return np.column_stack(columns) if columns else None


def _unpacked(values: NDArray[np.generic]) -> NDArray[np.uint8] | None:
    if values.dtype.kind not in "fiu" or values.dtype.itemsize != 4:
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
