"""Maps on disk."""

import laspy
import numpy as np
import open3d as o3d
import pytest

from lidarslam.core.errors import OutputError
from lidarslam.core.scan import PointAttributes
from lidarslam.mapping.global_map import point_cloud
from lidarslam.mapping.global_map.point_cloud import PointCloud, require_format, write_cloud
from lidarslam.storage.finished_run import load_map

from .shapes import attributes

FORMATS = ["map.ply", "map.pcd", "map.laz", "map.e57"]


@pytest.fixture
def cloud(rng: np.random.Generator) -> PointCloud:
    """Points with all attributes; one has no intensity, one no ring."""
    normals, known = rng.normal(size=(500, 3)), attributes(rng, 500)
    known.intensity[3], known.ring[4] = np.nan, -1
    points = rng.normal(0.0, 30.0, (500, 3)).astype(np.float32).astype(np.float64)
    return PointCloud(points, normals / np.linalg.norm(normals, axis=1, keepdims=True), known)


@pytest.mark.parametrize("name", ["map.ply", "map.pcd"])
def test_open3d_and_this_program_read_every_attribute(tmp_path, cloud, name, monkeypatch):
    monkeypatch.setattr(point_cloud, "_POINTS_AT_A_TIME", 200)
    write_cloud(tmp_path / name, cloud)
    read = o3d.t.io.read_point_cloud(str(tmp_path / name)).point
    np.testing.assert_array_equal(read.positions.numpy(), cloud.points)
    np.testing.assert_array_equal(read.normals.numpy(), cloud.normals.astype(np.float32))
    np.testing.assert_array_equal(read.colors.numpy(), cloud.attributes.rgb)
    for attribute in ("intensity", "ring", "time"):
        np.testing.assert_array_equal(read[attribute].numpy()[:, 0], getattr(cloud.attributes, attribute))
    back = load_map(tmp_path / name)
    np.testing.assert_array_equal(back.points, cloud.points)
    expected = dict(cloud.attributes.present())
    for attribute, values in back.attributes.present():
        np.testing.assert_array_equal(values, expected.pop(attribute))
    assert not expected


def test_laspy_reads_laz(tmp_path, cloud):
    write_cloud(tmp_path / "map.laz", cloud)
    read, known = laspy.read(tmp_path / "map.laz"), cloud.attributes
    assert read.header.are_points_compressed
    np.testing.assert_allclose(read.xyz, cloud.points, atol=0.51e-4)
    np.testing.assert_array_equal(read.NormalZ, cloud.normals[:, 2].astype(np.float32))
    np.testing.assert_allclose(read.intensity, np.nan_to_num(known.intensity), atol=0.5)
    np.testing.assert_array_equal(read.ring, known.ring)
    np.testing.assert_array_equal(read.gps_time, known.time)
    np.testing.assert_array_equal(np.column_stack([read.red, read.green, read.blue]) // 257, known.rgb)
    assert set(read.return_number) == set(read.number_of_returns) == {1}


@pytest.mark.parametrize(
    ("brightest", "expected"), [(None, [0, 39321, 65535]), (1.0, [0, 39321, 65535]), (255.0, [0, 1, 1])]
)
def test_intensities_up_to_one_fill_the_bits_of_laz(tmp_path, brightest, expected):
    """A tile's are on the scale of its map."""
    dark = PointCloud(np.eye(3), np.eye(3), PointAttributes(intensity=np.array([0.0, 0.6, 1.0], dtype=np.float32)))
    write_cloud(tmp_path / "0_0.laz", dark, brightest)
    assert laspy.read(tmp_path / "0_0.laz").intensity.tolist() == expected


def test_pye57_reads_e57(tmp_path, cloud):
    pye57 = pytest.importorskip("pye57")
    write_cloud(tmp_path / "map.e57", cloud)
    file = pye57.E57(str(tmp_path / "map.e57"))
    read, known = file.read_scan(0, intensity=True, colors=True), cloud.attributes
    file.close()
    for column, axis in enumerate("XYZ"):
        np.testing.assert_allclose(read[f"cartesian{axis}"], cloud.points[:, column], atol=1e-5)
    np.testing.assert_array_equal(read["intensity"], np.nan_to_num(known.intensity))
    for column, colour in enumerate(("Red", "Green", "Blue")):
        np.testing.assert_array_equal(read[f"color{colour}"], known.rgb[:, column])


@pytest.mark.parametrize("name", FORMATS)
def test_a_map_is_written_in_every_format_or_the_folder_is_named(tmp_path, name):
    if name.endswith("e57"):
        pytest.importorskip("pye57")
    write_cloud(tmp_path / name, PointCloud(np.eye(3), np.eye(3)))
    assert (tmp_path / name).stat().st_size > 100
    suffix = name.removeprefix("map")
    with pytest.raises(OutputError, match=rf"none: the \{suffix} map cannot be written there \(.+\)$") as caught:
        write_cloud(tmp_path / "none" / f".partial-1-{name}", PointCloud(np.eye(3), np.eye(3)))
    assert ".partial" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_written_is_refused(tmp_path, monkeypatch):
    with pytest.raises(OutputError, match="a map without points"):
        write_cloud(tmp_path / "map.ply", PointCloud(np.empty((0, 3)), np.empty((0, 3))))
    with pytest.raises(OutputError, match=r"map\.xyz: expected a name that ends in \.ply, \.pcd, \.laz, \.e57"):
        PointCloud(np.eye(3), np.eye(3)).save(str(tmp_path / "map.xyz"))
    monkeypatch.setattr(point_cloud, "find_spec", lambda _name: None)
    with pytest.raises(OutputError, match="E57 maps need pye57"):
        require_format("e57")
