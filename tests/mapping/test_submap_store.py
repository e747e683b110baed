"""What is put aside comes back as it was, and nothing is left behind."""

import numpy as np
import pytest

from lidarslam.core.geometry import exp
from lidarslam.mapping.global_map.global_map import GlobalMap, VoxelMeans
from lidarslam.mapping.global_map.voxels import Layout
from lidarslam.mapping.pose_graph.keyframe_graph import SubmapStore


def test_submaps_come_back_in_any_order(rng, tmp_path):
    store = SubmapStore(tmp_path)
    layouts = [Layout(), Layout(intensity=True), Layout(), Layout(rgb=True, first=True)]
    kept = [
        VoxelMeans(rng.normal(size=(size, layout.width)).astype(np.float32), layout)
        for size, layout in zip((5, 0, 1000, 3), layouts, strict=True)
    ]
    for means in kept:
        store.append(means)
    assert len(store) == 4
    for index in (2, 0, 3, 1, 2):
        np.testing.assert_array_equal(store[index].rows, kept[index].rows)
        assert store[index].layout == kept[index].layout
    store.append(kept[0])  # reading in between does no harm
    np.testing.assert_array_equal(store[4].rows, kept[0].rows)
    assert not list(tmp_path.iterdir())  # the file has no name
    store.close()
    with pytest.raises(ValueError):
        store.append(kept[0])


def test_a_map_of_submaps_is_the_map_of_their_scans(rng):
    """Counts, means and sides seen from are those of the points, up to voxels that a submap's cut differently."""
    poses = [exp([0.0, 0.0, 0.0, x, 0.0, 0.0]) for x in (0.0, 2.0, 4.0)]  # whole voxels, so that they are cut alike
    scans = [rng.uniform(-3.0, 3.0, (4000, 3)) for _ in poses]
    direct, drawn = GlobalMap(0.25), GlobalMap(0.25)
    for points, pose in zip(scans, poses, strict=True):
        submap = GlobalMap(0.25)
        for half in (points[:2000], points[2000:]):
            submap.add(half, np.eye(4))
        drawn.add_means(submap.means(), pose)
        direct.add(points, pose)
    for hits in (1, 3):
        np.testing.assert_allclose(drawn.points(hits), direct.points(hits), atol=1e-5)
    np.testing.assert_allclose(drawn.cloud().normals, direct.cloud().normals, atol=1e-3)


def test_views_turn_with_the_submap():
    """A floor seen from above is seen from the side once the submap is tipped over."""
    grid = np.stack(np.meshgrid(np.arange(0.05, 3.0, 0.1), np.arange(0.05, 3.0, 0.1), [-1.0]), axis=-1).reshape(-1, 3)
    submap = GlobalMap(0.1)
    submap.add(grid, np.eye(4))
    for tip, expected in ((0.0, [0.0, 0.0, 1.0]), (0.5 * np.pi, [0.0, -1.0, 0.0])):
        drawn = GlobalMap(0.1)
        drawn.add_means(submap.means(), exp([tip, 0.0, 0.0, 0.0, 0.0, 0.0]))
        np.testing.assert_allclose(drawn.cloud().normals.mean(axis=0), expected, atol=1e-6)
