"""Every driver's cloud comes out of its bytes as it went in."""

from functools import partial

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.datasets.point_table import PointField, read_colours, read_intensities
from lidarslam.datasets.ros.bag_message import decode_custom_message, decode_point_cloud2

from .conftest import STAMP_NS, point_table


def test_padded_rows_and_big_endian(driver, make_sweep, ros2_kit):
    sweep = make_sweep(driver, STAMP_NS)
    swapped = sweep.records.astype(sweep.records.dtype.newbyteorder(">"))
    message = ros2_kit.cloud(swapped, STAMP_NS, row_padding=13, is_bigendian=True)
    cloud = decode_point_cloud2(message)
    message.data[:] = 0  # the cloud has its own copy
    for name in ("points", "times", "rings"):
        np.testing.assert_array_equal(getattr(cloud, name), getattr(sweep, name))
    assert cloud.times.dtype.isnative
    assert cloud.rings.dtype.isnative


def test_fields_with_a_count(ros2_kit, make_sweep):
    sweep = make_sweep("velodyne", STAMP_NS)
    message = ros2_kit.cloud(sweep.records, STAMP_NS)
    message.fields[0].count = 0  # as some simulators write it
    message.fields[3].count = 3
    cloud = decode_point_cloud2(message)
    np.testing.assert_array_equal(cloud.points, sweep.points)
    assert cloud.fields[0] == PointField("x", "float32")
    assert cloud.fields[3] == PointField("intensity", "float32[3]")


@pytest.mark.parametrize("shape", [(0, 0), (1, 0), (0, 5)])
def test_empty_cloud(ros2_kit, make_sweep, shape):
    records = np.zeros(shape, make_sweep("ouster", STAMP_NS).records.dtype)
    cloud = decode_point_cloud2(ros2_kit.cloud(records, STAMP_NS))
    assert cloud.points.shape == (0, 3)
    assert len(cloud.times) == len(cloud.rings) == 0


def test_wanted_time_field(ros2_kit, make_sweep):
    sweep = make_sweep("ouster", STAMP_NS)
    message = ros2_kit.cloud(sweep.records, STAMP_NS)
    cloud = decode_point_cloud2(message, "range")
    assert cloud.time_field == "range"
    np.testing.assert_array_equal(cloud.times, sweep.records["range"].reshape(-1))
    with pytest.raises(InputError, match="'stamp'"):
        decode_point_cloud2(message, "stamp")


@pytest.mark.parametrize("count", [0, 1, 2, 97])
@pytest.mark.parametrize("frame_id", ["", "l", "livox", "livox_frame_7"])  # moves what follows the header
def test_livox_custom_message(bag_kit, rng, count, frame_id):
    points = rng.normal(size=(count, 3)).astype("f4")
    offsets = np.sort(rng.integers(0, 10**8, count))
    lines = rng.integers(0, 6, count)
    message = bag_kit.livox(points, offsets, lines, STAMP_NS, timebase=STAMP_NS + 3, package="livox_ros_driver2")
    message.header.frame_id = frame_id
    raw = bag_kit.serialize(message)
    decoded = [decode_custom_message(raw, bag_kit.ros2)]
    if bag_kit.ros2:
        message_type = "livox_ros_driver2/msg/CustomMsg"
        big_endian = bytes(bag_kit.store.serialize_cdr(message, message_type, little_endian=False))
        decoded += [decode_custom_message(raw + b"\0", True), decode_custom_message(big_endian, True)]
    for cloud in decoded:
        np.testing.assert_array_equal(cloud.points, points.astype("f8"))
        np.testing.assert_array_equal(cloud.times, (STAMP_NS + 3 + offsets).astype("u8"))
        np.testing.assert_array_equal(cloud.rings, lines)
        assert cloud.time_field == "offset_time"


def test_livox_custom_message_cut_anywhere(bag_kit, rng):
    points = rng.normal(size=(5, 3))
    raw = bag_kit.serialize(bag_kit.livox(points, np.arange(5), np.zeros(5), STAMP_NS, STAMP_NS, "livox_ros_driver"))
    for length in range(4, len(raw) - 1):
        with pytest.raises(InputError, match="Livox CustomMsg"):
            decode_custom_message(raw[:length], bag_kit.ros2)


RGB = np.array([[255, 128, 0], [1, 2, 3], [0, 0, 255], [255, 255, 255]], dtype=np.uint8)
PACKED = (RGB.astype(np.uint32) << np.array([16, 8, 0], dtype=np.uint32)).sum(axis=1, dtype=np.uint32)


table = partial(point_table, np.ones((4, 3)))  # four points with further columns


@pytest.mark.parametrize(("names", "field"), [
    (["reflectivity", "Intensity"], "Intensity"), (["scalar_Intensity"], "scalar_Intensity"),
    (["reflectivity", "signal"], "reflectivity"), (["time", "ring"], None),
])  # fmt: skip
def test_the_field_of_intensity(names, field):
    read = read_intensities(table(**{name: np.full(4, place, "f4") for place, name in enumerate(names)}))
    assert (read is None) if field is None else read[0] == names.index(field)


@pytest.mark.parametrize(("names", "colour"), [
    (["red", "green", "blue", "alpha"], [0, 1, 2]), (["R", "G", "B"], [0, 1, 2]), (["rgba", "rgb"], [0, 0, 1]),
    (["red", "green"], None), (["rgba", "intensity"], [0, 0, 0]),
])  # fmt: skip
def test_the_fields_of_colour(names, colour):
    read = read_colours(table(**{name: np.full(4, place, "u4") for place, name in enumerate(names)}))
    assert (read is None) if colour is None else read[0].tolist() == colour


ALPHA = np.uint32(0xFF000000)  # with it the bits of a float are those of NaN
COLOURS = {
    "bytes": {"red": RGB[:, 0], "green": RGB[:, 1], "blue": RGB[:, 2]},
    "16 bits": dict(zip("rgb", RGB.T.astype(np.uint16) * 257, strict=True)),
    "shares": dict(zip("rgb", RGB.T.astype(np.float32) / 255.0, strict=True)),
    "floats to 255": dict(zip("rgb", RGB.T.astype(np.float64), strict=True)),
    "packed": {"rgb": PACKED},
    "packed float": {"rgb": PACKED.view(np.float32)},
    "packed float with alpha": {"rgba": (PACKED | ALPHA).view(np.float32)},
    "packed int": {"rgba": (PACKED | ALPHA).view(np.int32)},
    "big endian": {"rgb": PACKED.astype(">u4")},
    "big endian float": {"rgb": PACKED.view(np.float32).astype(">f4")},
}


@pytest.mark.parametrize("columns", COLOURS.values(), ids=list(COLOURS))
def test_point_cloud2(ros2_kit, columns):
    records = table(**columns, intensity=np.arange(4, dtype=np.uint16) * 20_000).reshape(2, 2)
    if any(values.dtype.byteorder == ">" for values in columns.values()):
        records = records.astype(records.dtype.newbyteorder(">"))
    is_big = records["x"].dtype.byteorder == ">"
    cloud = decode_point_cloud2(ros2_kit.cloud(records, STAMP_NS, row_padding=5, is_bigendian=is_big))
    np.testing.assert_array_equal(cloud.colours, RGB)
    assert cloud.intensities.tolist() == [0.0, 20_000.0, 40_000.0, 60_000.0]


def test_fields_that_cannot_be_read_matter_only_where_they_are_needed(ros2_kit):
    message = ros2_kit.cloud(table(intensity=np.ones(4, dtype="f4"), rgb=PACKED).reshape(1, 4), STAMP_NS)
    message.fields[3].datatype, message.fields[4].offset = 99, 1000
    cloud = decode_point_cloud2(message)
    np.testing.assert_array_equal(cloud.points, np.ones((4, 3)))
    assert cloud.intensities is cloud.colours is None
    message.fields[0].datatype = 11
    with pytest.raises(InputError, match="'x' has the unknown datatype 11"):
        decode_point_cloud2(message)
