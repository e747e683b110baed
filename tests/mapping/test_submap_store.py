"""What is put aside comes back as it was, and nothing is left behind."""

import numpy as np
import pytest

from lidarslam.mapping.global_map.global_map import VoxelMeans
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
