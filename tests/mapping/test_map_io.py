"""Maps on disk."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from lidarslam.core.errors import OutputError
from lidarslam.mapping.global_map.global_map import PointCloud
from lidarslam.mapping.global_map.map_io import write_cloud


@pytest.mark.parametrize("name", ["map.ply", "map.pcd"])
def test_a_map_is_read_back(tmp_path: Path, name: str) -> None:
    write_cloud(tmp_path / name, PointCloud(np.eye(3), np.eye(3)))
    np.testing.assert_array_equal(np.asarray(o3d.io.read_point_cloud(str(tmp_path / name)).points), np.eye(3))


def test_a_failure_names_the_folder_and_no_partial_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"none: the \.ply map cannot be written") as caught:
        write_cloud(tmp_path / "none" / ".partial-1-map.ply", PointCloud(np.eye(3), np.eye(3)))
    assert ".partial" not in str(caught.value)


def test_an_empty_map_is_no_full_disk(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="a map without points"):
        write_cloud(tmp_path / "map.ply", PointCloud(np.empty((0, 3)), np.empty((0, 3))))
