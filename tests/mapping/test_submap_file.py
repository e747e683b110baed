"""Sparse submaps come back from their file as they were."""

from dataclasses import fields

import numpy as np
import pytest

from lidarslam.mapping.loops.sparse_submap import SparseSubmap, SubmapFile


def submap(points: int, seed: int) -> SparseSubmap:
    """The walls of a room, as a sensor in it sees them."""
    rng = np.random.default_rng(seed)
    walls = rng.uniform(-6.0, 6.0, (points, 3))
    walls[np.arange(points), rng.integers(3, size=points)] = rng.choice([-6.0, 6.0], points)
    return SparseSubmap.of(walls, 100.0)


def test_submaps_are_the_same_to_the_last_bit(tmp_path):
    kept = SubmapFile(tmp_path)
    given = [submap(points, seed) for seed, points in enumerate((2001, 0, 7, 900))]
    for one in given:
        kept.append(one)
        assert len(kept[-1]) == len(one)
    assert len(kept) == len(given)
    assert not list(tmp_path.iterdir())
    for one, other in zip(kept, given, strict=True):
        for field in fields(SparseSubmap):
            a, b = np.asarray(getattr(one, field.name)), np.asarray(getattr(other, field.name))
            assert a.dtype == b.dtype, field.name
            assert np.array_equal(a, b), field.name
    with pytest.raises(IndexError):
        kept[len(given)]
