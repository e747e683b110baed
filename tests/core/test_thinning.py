"""Thinning against the same hash written with arrays."""

import numpy as np
import pytest
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.thinning import central_per_cell, one_per_cell


def slots_of(points: FloatArray, cell_m: float) -> NDArray[np.int32]:
    """Integers of 32 bits wrap around, as a hash may."""
    cells = np.floor(points.astype(np.float32) * np.float32(1.0 / cell_m)).astype(np.int32)
    slots = (cells * np.array([73_856_093, 19_349_669, 83_492_791], dtype=np.int32)).sum(axis=1, dtype=np.int32)
    return np.asarray(slots & ((1 << 20) - 1), dtype=np.int32)


def by_arrays(points: FloatArray, cell_m: float) -> NDArray[np.intp]:
    """The last comer of every slot."""
    last = {int(slot): n for n, slot in enumerate(slots_of(points, cell_m))}
    return np.array(sorted(last.values()), dtype=np.intp)


@pytest.mark.parametrize("cell_m", [0.05, 0.7, 10.0])
def test_equals_the_hash_with_arrays(rng, cell_m):
    points = rng.normal(0.0, 15.0, (30_000, 3))
    np.testing.assert_array_equal(one_per_cell(points, cell_m), by_arrays(points, cell_m))
    # The slots of the scan before are still there.
    np.testing.assert_array_equal(one_per_cell(points[::7], cell_m), by_arrays(points[::7], cell_m))


def test_nearly_every_cell_keeps_one(rng):
    points = rng.uniform(-10.0, 10.0, (20_000, 3))
    cells = np.floor(points)
    kept = one_per_cell(points, 1.0)
    assert len(np.unique(cells[kept], axis=0)) == len(kept)
    assert len(kept) > 0.98 * len(np.unique(cells, axis=0))


def test_what_is_no_place_does_no_harm():
    points = np.array([[np.nan, 0.0, 0.0], [np.inf, 1e300, -np.inf], [1e30, 1e30, 1e30], [5.0, 5.0, 5.0]])
    with np.errstate(over="ignore"):
        assert 3 in one_per_cell(points, 0.1)
    assert len(one_per_cell(np.empty((0, 3)), 0.1)) == len(central_per_cell(np.empty((0, 3)), 0.1)) == 0


def assert_central(points: FloatArray, cell_m: float) -> None:
    """One in each slot, and no other in it is nearer to the mean of all."""
    kept, slots = central_per_cell(points, cell_m), slots_of(points, cell_m)
    assert (np.diff(kept) > 0).all()
    np.testing.assert_array_equal(np.sort(slots[kept]), np.unique(slots))
    for n in kept:
        together = points[slots == slots[n]]
        off = np.linalg.norm(together - together.mean(axis=0), axis=1)
        assert np.linalg.norm(points[n] - together.mean(axis=0)) <= off.min() + 1e-5


@pytest.mark.parametrize("cell_m", [0.7, 3.0, 100.0])
def test_the_most_central_point_is_the_nearest_to_the_mean_of_its_cell(rng, cell_m):
    points = rng.normal(0.0, 2.0, (2_000, 3))
    assert_central(points, cell_m)
    assert_central(points[::7], cell_m)  # the slots of the scan before are still there
    one_per_cell(points, cell_m)  # and of other uses
    assert_central(points[::3], cell_m)


def test_the_most_central_points_are_the_same_whichever_way_the_sensor_goes_round(rng):
    points = rng.uniform(-3.0, 3.0, (30_000, 3))
    forwards, backwards = central_per_cell(points, 0.7), len(points) - 1 - central_per_cell(points[::-1], 0.7)
    assert len(forwards) == len(backwards)
    assert len(np.intersect1d(forwards, backwards)) > 0.98 * len(forwards)  # a few cells at the border have two points
    last = len(points) - 1 - one_per_cell(points[::-1], 0.7)
    assert len(np.intersect1d(one_per_cell(points, 0.7), last)) < 0.1 * len(last)
