"""The merged map: averages, normals, and memory that follows the area."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from lidarslam.core.errors import OutputError
from lidarslam.core.geometry import exp
from lidarslam.mapping.global_map import global_map as module
from lidarslam.mapping.global_map.global_map import GlobalMap, voxel_size_for
from lidarslam.mapping.global_map.point_cloud import PointCloud, write_cloud


def test_a_voxel_holds_the_mean_of_its_points() -> None:
    grid = GlobalMap(1.0)
    grid.add(np.array([[0.25, 0.5, 0.5], [-0.5, -0.5, -0.5]]), np.eye(4))
    grid.add(np.array([[0.75, 0.5, 0.25]]), np.eye(4))
    points = grid.points()
    np.testing.assert_allclose(points[points[:, 0].argsort()], [[-0.5, -0.5, -0.5], [0.5, 0.5, 0.375]], atol=1e-6)
    np.testing.assert_allclose(grid.points(min_hits=2), [[0.5, 0.5, 0.375]], atol=1e-6)


def test_equals_a_dictionary_of_voxels(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MIN_PENDING", 500)  # so that merging happens many times
    grid, voxels = GlobalMap(0.3), {}
    for _ in range(40):
        points, T = rng.normal(0.0, 2.0, (200, 3)), exp(rng.normal(0.0, 1.0, 6))
        grid.add(points, T)
        for point in points @ T[:3, :3].T + T[:3, 3]:
            voxels.setdefault(tuple(np.floor(point / 0.3).astype(int)), []).append(point)
    expected = np.array(sorted(tuple(np.mean(points, axis=0)) for points in voxels.values()))
    found = grid.points()
    np.testing.assert_allclose(found[np.lexsort(found.T[::-1])], expected, atol=1e-5)


def test_precision_does_not_suffer_far_from_the_origin() -> None:
    grid = GlobalMap(0.1)
    far = np.array([[12_345.678, -9_876.543, 210.987]])
    grid.add(far, np.eye(4))
    np.testing.assert_allclose(grid.points(), far, atol=1e-6)


def test_memory_follows_the_area_not_the_scans(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MIN_PENDING", 5_000)
    grid = GlobalMap(0.5)
    sizes = []
    for _ in range(300):
        grid.add(rng.uniform(-5.0, 5.0, (2_000, 3)), np.eye(4))
        sizes.append(len(grid._merged.keys) + grid._pending_size)
    assert len(grid.points()) == 20**3
    assert max(sizes) < 20**3 * 1.5 + 5_000 + 2_000


def test_normals_face_the_sensor(rng: np.random.Generator) -> None:
    grid = GlobalMap(0.2)
    wall = np.column_stack([np.full(4_000, 3.0), rng.uniform(-2.0, 2.0, (4_000, 2))])
    floor = np.column_stack([rng.uniform(-2.0, 2.0, (4_000, 2)), np.full(4_000, -1.0)])
    grid.add(np.concatenate([wall, floor]), np.eye(4))
    cloud = grid.cloud()
    on_wall = cloud.points[:, 0] > 2.9
    inner = (np.abs(cloud.points[:, 1]) < 1.5) & (on_wall | (np.abs(cloud.points[:, 0]) < 1.5))
    np.testing.assert_allclose(cloud.normals[on_wall & inner] @ [-1.0, 0.0, 0.0], 1.0, atol=1e-3)
    np.testing.assert_allclose(cloud.normals[~on_wall & inner] @ [0.0, 0.0, 1.0], 1.0, atol=1e-3)


def test_an_empty_map_has_no_points() -> None:
    grid = GlobalMap(0.2)
    grid.add(np.empty((0, 3)), np.eye(4))
    assert len(grid.cloud()) == 0


@pytest.mark.parametrize(("half_size", "voxel"), [(1.0, 0.05), (5.0, 0.12), (60.0, 0.25)])
def test_the_voxel_size_follows_the_scene(rng: np.random.Generator, half_size: float, voxel: float) -> None:
    directions = rng.normal(size=(2_000, 3))
    sphere = 1.2 * half_size * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    assert voxel_size_for(sphere) == pytest.approx(voxel)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_other_programs_read_the_file(tmp_path: Path, rng: np.random.Generator, suffix: str) -> None:
    points = rng.normal(0.0, 30.0, (500, 3))
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    path = tmp_path / f"käfig {suffix}"
    write_cloud(path, PointCloud(points, normals))
    back = o3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(back.points), points, atol=1e-5)
    np.testing.assert_allclose(np.asarray(back.normals), normals, atol=1e-6)
    assert path.stat().st_size < 500 * 6 * 4 + 500, "binary"


def test_a_map_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written there"):
        write_cloud(tmp_path / "absent" / "map.ply", PointCloud(np.ones((1, 3)), np.ones((1, 3))))
