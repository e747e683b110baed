"""Intensity and colour come out of every reader as they were recorded."""

from functools import partial

import numpy as np
import pytest

from lidarslam.datasets.point_table import read_colours, read_intensities
from lidarslam.datasets.registry import open_recording
from lidarslam.datasets.ros.bag_message import decode_custom_message, decode_point_cloud2

from .conftest import STAMP_NS, point_table, stamps_ns

RGB = np.array([[255, 128, 0], [1, 2, 3], [0, 0, 255], [255, 255, 255]], dtype=np.uint8)
PACKED = (RGB.astype(np.uint32) << np.array([16, 8, 0], dtype=np.uint32)).sum(axis=1, dtype=np.uint32)


table = partial(point_table, np.ones((4, 3)))  # four points with further columns


@pytest.mark.parametrize(
    ("names", "field"),
    [
        (["reflectivity", "Intensity"], "Intensity"),
        (["scalar_Intensity"], "scalar_Intensity"),
        (["reflectivity", "signal"], "reflectivity"),
        (["time", "ring"], None),
    ],
)
def test_the_field_of_intensity(names, field):
    read = read_intensities(table(**{name: np.full(4, place, "f4") for place, name in enumerate(names)}))
    assert (read is None) if field is None else read[0] == names.index(field)


@pytest.mark.parametrize(
    ("names", "colour"),
    [
        (["red", "green", "blue", "alpha"], [0, 1, 2]),
        (["R", "G", "B"], [0, 1, 2]),
        (["rgba", "rgb"], [0, 0, 1]),
        (["red", "green"], None),
        (["rgba", "intensity"], [0, 0, 0]),
    ],
)
def test_the_fields_of_colour(names, colour):
    read = read_colours(table(**{name: np.full(4, place, "u4") for place, name in enumerate(names)}))
    assert (read is None) if colour is None else read[0].tolist() == colour


@pytest.mark.parametrize("kind", ["u1", "u2", "u4", "i4", "f4", "f8"])
@pytest.mark.parametrize("highest", [1, 255])
def test_intensities_keep_their_scale(kind, highest):
    recorded = (np.array([0.0, 0.25, 0.5, 1.0]) * highest).astype(kind)
    read = read_intensities(table(intensity=recorded))
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, recorded.astype(np.float32))


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


def test_a_packed_colour_of_another_size_is_none():
    assert read_colours(table(rgb=PACKED.astype(np.uint64))) is None


@pytest.mark.parametrize("columns", COLOURS.values(), ids=list(COLOURS))
def test_point_cloud2(ros2_kit, columns):
    records = table(**columns, intensity=np.arange(4, dtype=np.uint16) * 20_000).reshape(2, 2)
    if any(values.dtype.byteorder == ">" for values in columns.values()):
        records = records.astype(records.dtype.newbyteorder(">"))
    cloud = decode_point_cloud2(
        ros2_kit.cloud(records, STAMP_NS, row_padding=5, is_bigendian=records["x"].dtype.byteorder == ">")
    )
    np.testing.assert_array_equal(cloud.colours, RGB)
    assert cloud.intensities.tolist() == [0.0, 20_000.0, 40_000.0, 60_000.0]


def test_fields_that_cannot_be_read_are_no_attributes(ros2_kit):
    message = ros2_kit.cloud(table(intensity=np.ones(4, dtype="f4"), rgb=PACKED).reshape(1, 4), STAMP_NS)
    message.fields[3].datatype, message.fields[4].offset = 99, 1000
    cloud = decode_point_cloud2(message)
    assert len(cloud.points) == 4
    assert cloud.intensities is cloud.colours is None


def test_a_bag_in_which_some_scans_have_a_field(bag_kit):
    with_field = table(intensity=np.arange(4, dtype="f4")).reshape(1, 4)
    records = with_field, table().reshape(1, 4), with_field
    messages = [(ns, bag_kit.cloud(one, ns)) for ns, one in zip(stamps_ns(3), records, strict=True)]
    scans = list(open_recording(bag_kit.write({"/points": messages})).scans())
    assert [None if scan.intensities is None else scan.intensities.tolist() for scan in scans] == [
        [0.0, 1.0, 2.0, 3.0], None, [0.0, 1.0, 2.0, 3.0],
    ]  # fmt: skip


def test_livox(bag_kit):
    message = bag_kit.livox(np.ones((3, 3)), np.arange(3), np.zeros(3), STAMP_NS, STAMP_NS, "livox_ros_driver2")
    for number, point in enumerate(message.points):
        point.reflectivity = 100 * number
    cloud = decode_custom_message(bag_kit.serialize(message), bag_kit.ros2)
    assert cloud.intensities.tolist() == [0.0, 100.0, 200.0]


@pytest.mark.parametrize("suffix", ["bin", "npy", "columns.npy", "pcd", "ply"])
def test_folders(tmp_path, suffix):
    intensity = np.array([0.0, 0.25, 0.5, 1.0], dtype=np.float32)
    points = table(intensity=intensity, **COLOURS["bytes"])
    numbers = np.column_stack([points[name] for name in ("x", "y", "z", "intensity")])
    file = tmp_path / f"000000.{suffix.rpartition('.')[2]}"
    if suffix == "bin":
        numbers.tofile(file)
    elif suffix == "columns.npy":
        np.save(file, numbers)
    elif suffix == "npy":
        np.save(file, points)
    else:
        o3d = pytest.importorskip("open3d")
        cloud = o3d.t.geometry.PointCloud(numbers[:, :3].copy())
        cloud.point.colors, cloud.point.intensity = RGB, intensity[:, None]
        assert o3d.t.io.write_point_cloud(str(file), cloud)
    (scan,) = open_recording(tmp_path).scans()
    np.testing.assert_array_equal(scan.intensities, intensity)
    if suffix in ("bin", "columns.npy"):
        assert scan.colours is None
    else:
        np.testing.assert_array_equal(scan.colours, RGB)
