"""The merged map: averages, normals, and memory that follows the area."""

import numpy as np
import pytest

from lidarslam.mapping.global_map.global_map import GlobalMap, voxel_size_for


def test_precision_does_not_suffer_far_from_the_origin():
    grid = GlobalMap(0.1)
    far = np.array([[12_345.678, -9_876.543, 210.987]])
    grid.add(far, np.eye(4))
    np.testing.assert_allclose(grid.points(), far, atol=1e-6)


def test_normals_face_the_sensor(rng):
    grid = GlobalMap(0.2)
    wall = np.column_stack([np.full(4_000, 3.0), rng.uniform(-2.0, 2.0, (4_000, 2))])
    floor = np.column_stack([rng.uniform(-2.0, 2.0, (4_000, 2)), np.full(4_000, -1.0)])
    grid.add(np.concatenate([wall, floor]), np.eye(4))
    cloud = grid.cloud()
    on_wall = cloud.points[:, 0] > 2.9
    inner = (np.abs(cloud.points[:, 1]) < 1.5) & (on_wall | (np.abs(cloud.points[:, 0]) < 1.5))
    np.testing.assert_allclose(cloud.normals[on_wall & inner] @ [-1.0, 0.0, 0.0], 1.0, atol=1e-3)
    np.testing.assert_allclose(cloud.normals[~on_wall & inner] @ [0.0, 0.0, 1.0], 1.0, atol=1e-3)


@pytest.mark.parametrize(("half_size", "voxel"), [(1.0, 0.05), (5.0, 0.12), (60.0, 0.25)])
def test_the_voxel_size_follows_the_scene(rng, half_size, voxel):
    directions = rng.normal(size=(2_000, 3))
    sphere = 1.2 * half_size * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    assert voxel_size_for(sphere) == pytest.approx(voxel)
